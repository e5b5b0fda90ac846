"""One axis of a scan, fringe by fringe from coarse to fine.

Every fringe is fitted and unwrapped in one pass over the picture, as soon as its last frame has
arrived. What that pass must know beforehand (the noise of a sample, the harmonics of the
projector, by how much fringes disagree) comes from some lines of the picture, which are kept of
every frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import PhaseHarmonic, Rejection
from acquisition.decoding_options import DecodingOptions
from acquisition.errors import DecodingError
from acquisition.frame_files import Samples
from acquisition.frame_stream import FrameStream
from acquisition.fringe_fit import (
    NO_CORRECTION,
    FittedFringe,
    FoldedFringe,
    fit_folded,
    fit_samples,
    fold_fringe,
    model_fringe,
)
from acquisition.fringe_kernels import (
    AxisState,
    FringeModel,
    SampleModel,
    UnwrapStep,
    advance,
    advance_fitted,
    merge_exposures,
    subtract_series,
)
from acquisition.fringe_statistics import (
    residual_harmonics,
    squares_limit,
    systematic_disagreement,
)
from acquisition.fringes import Fringe
from acquisition.gray_decoding import (
    GrayCode,
    cell_coordinates,
    needs_level,
    read_words,
    sample_rows,
)
from acquisition.harmonics import error_orders, series_along_lines, series_of_coarse
from acquisition.sample_noise import SampleNoise, estimate_noise
from acquisition.unwrapping import certainty_sigmas

# Fringes whose frames may be looked at before their turn, to tell the noise of three steps.
_FRINGES_AHEAD = 4
_LEAST_UNSATURATED = 0.1
# Pixels from which medians are taken.
_FOR_MEDIANS = 8192
_BAD_LIGHT = np.uint16(Rejection.LOW_MODULATION | Rejection.SATURATED)
_NO_COORDINATE, _NO_MODULATION = np.empty(0, np.float64), np.empty(0, np.float32)


@dataclass
class SharedPictures:
    """What all axes add to; arrays of (pixels,).

    Attributes
    ----------
    ambient : float32 array
        Sum of the mean levels of ``terms`` fringes.
    rejection : uint16 array
    terms : int
    """

    ambient: NDArray[np.float32]
    rejection: NDArray[np.uint16]
    terms: int = 0


@dataclass(frozen=True)
class DecodedAxis:
    """An axis decoded pixel by pixel; arrays of (pixels,)."""

    coordinate: NDArray[np.float64]
    variance: NDArray[np.float32]
    modulation: NDArray[np.float32]
    period_px: float
    residual_rms: float
    harmonics: tuple[PhaseHarmonic, ...] = ()


@dataclass(frozen=True)
class _Lines:
    """Some rows of every frame of a fringe (steps, rows, cols), and some columns, transposed.

    The columns are there only where harmonics are compensated.
    """

    rows: Samples
    columns: Samples | None


@dataclass(frozen=True)
class _FringeReport:
    residual_rms: float
    harmonics: tuple[PhaseHarmonic, ...]


@dataclass
class FringeDecoder:
    """Decodes the fringes of a plan, axis by axis.

    Attributes
    ----------
    stream : FrameStream
    options : DecodingOptions
    groups : list of tuples of Fringe
        All fringes of the plan, those that differ in exposure only together.
    shared : SharedPictures
    noise : SampleNoise or None
        None until the first fringe has told it.
    """

    stream: FrameStream
    options: DecodingOptions
    groups: list[tuple[Fringe, ...]]
    shared: SharedPictures
    noise: SampleNoise | None = None
    _rows: NDArray[np.intp] = field(init=False)
    _every: int = field(init=False)
    _columns: NDArray[np.intp] = field(init=False)
    _alarm: float = field(init=False)
    _near: NDArray[np.float32] = field(init=False)  # of one axis after the other

    def __post_init__(self) -> None:
        rows, cols = self.stream.shape
        self._near = np.empty(rows * cols, np.float32)
        self._rows = sample_rows((rows, cols))
        self._every = max(1, len(self._rows) * cols // _FOR_MEDIANS)
        self._columns = sample_rows((cols, rows))
        redundant = sum(fringe.steps > 3 for group in self.groups for fringe in group)
        unwrapped = len(self.groups) - len({group[0].axis for group in self.groups})
        self._alarm = self.options.false_alarm / max(1, redundant + unwrapped)

    def decode(
        self, groups: list[tuple[Fringe, ...]], *, extent: int, code: GrayCode | None
    ) -> DecodedAxis:
        """Decode an axis that has fringes.

        Parameters
        ----------
        groups : list of tuples of Fringe
            The axis's, from coarse to fine.
        extent : int
            Pixels of the panel along it.
        code : GrayCode or None
            Gray code that tells the order of the coarsest fringe.

        Raises
        ------
        DecodingError
            Nothing tells the order of the coarsest fringe, or a fringe's steps do not determine a
            phase.
        """
        coarsest = groups[0][0]
        if code is None and coarsest.period_px < extent - 1:
            raise DecodingError(
                f"nothing tells the fringe order of the {coarsest.axis}s: the longest period is "
                f"{coarsest.period_px:g} px, the projector has {extent}; add Gray code or a "
                "fringe of one period"
            )
        for fringe in (fringe for group in groups for fringe in group):
            _ = fringe.solution  # refuse what cannot be decoded before anything is read
        pixels = len(self.shared.rejection)
        near = self._near
        near.fill((extent - 1) / 2)
        variance = np.zeros(pixels, np.float32)
        if code is not None and not needs_level(code):
            cell_coordinates(code, read_words(code, self.stream), near)
        coarse: Fringe | GrayCode | None = code
        for number, group in enumerate(groups):
            last = number == len(groups) - 1
            state = AxisState(
                near,
                variance,
                self.shared.ambient,
                self.shared.rejection,
                np.empty(pixels) if last else _NO_COORDINATE,
                np.empty(pixels, np.float32) if last else _NO_MODULATION,
            )
            report = self._advance(group, state, coarse, extent)
            coarse = group[0]
            self.shared.terms += 1
        return DecodedAxis(
            state.coordinate,
            variance,
            state.modulation,
            groups[-1][0].period_px,
            report.residual_rms,
            report.harmonics,
        )

    def _advance(
        self,
        group: tuple[Fringe, ...],
        state: AxisState,
        coarse: Fringe | GrayCode | None,
        extent: int,
    ) -> _FringeReport:
        """Fit one fringe and unwrap it by what came before."""
        by_level = isinstance(coarse, GrayCode) and needs_level(coarse)
        if len(group) == 1 and not by_level:
            folded, lines = self._read(group[0])
            model, sampled, report = self._model(group[0], lines)
            step = self._step(group[0], coarse, extent, sampled, state)
            parts = (folded.frames, folded.weights, folded.reference, folded.sums)
            advance(*parts, model, self._sample_model(), step, state)
            return report
        fitted, report = self._fit_exposures(group)
        if by_level and isinstance(coarse, GrayCode):
            words = read_words(coarse, self.stream, self._level_at(fitted, group[0]))
            cell_coordinates(coarse, words, state.near)
        thin = FittedFringe(self._thin(fitted.planes), self._thin(fitted.flags))
        step = self._step(group[0], coarse, extent, thin, state)
        advance_fitted(fitted.planes, fitted.flags, step, state)
        return report

    def _read(self, fringe: Fringe) -> tuple[FoldedFringe, _Lines]:
        """Fold the frames of a fringe as they come, and keep some lines of each."""
        rows: list[NDArray[np.integer]] = []
        columns: list[NDArray[np.integer]] = []

        def coming() -> Iterator[Samples]:
            for frame_id in fringe.frame_ids:
                frame = self.stream.take(frame_id)
                rows.append(self._lines_of(frame))
                if self.options.compensate_harmonics:
                    columns.append(frame.reshape(self.stream.shape)[:, self._columns].T)
                yield frame

        folded = fold_fringe(fringe, coming())
        return folded, _Lines(np.stack(rows), np.stack(columns) if columns else None)

    def _lines_of(self, frame: Samples) -> NDArray[np.integer]:
        return frame.reshape(self.stream.shape)[self._rows]

    def _thin(self, planes: NDArray[Any]) -> NDArray[Any]:
        """The sampled pixels of pictures (..., pixels), flat."""
        pictures = planes.reshape(*planes.shape[:-1], *self.stream.shape)
        return pictures[..., self._rows, :: self._every].reshape(*planes.shape[:-1], -1)

    def _sample_model(self) -> SampleModel:
        assert self.noise is not None  # told by the first fringe
        least = self.options.minimum_modulation
        contrast = self.options.minimum_contrast if least is None else 0.0
        return SampleModel(
            np.float32(self.noise.read_variance),
            np.float32(self.noise.gain),
            np.float32(self.stream.plan.saturation_level),
            np.float32(least or 0.0),
            np.float32(contrast),
        )

    def _learn_noise(self, fringe: Fringe, stack: Samples) -> None:
        """Noise of a sample, from the first fringe, and from those that follow if it must be."""
        known = [(fringe, stack)]
        ceiling = self.stream.plan.saturation_level
        unsaturated = np.mean((stack < ceiling).all(axis=0))
        if fringe.steps == 3 or unsaturated < _LEAST_UNSATURATED:
            others = [other for group in self.groups for other in group if other is not fringe]
            for other in others[: _FRINGES_AHEAD - 1]:
                frames = [self.stream.look_ahead(frame_id) for frame_id in other.frame_ids]
                known.append((other, np.stack([self._lines_of(frame) for frame in frames])))
        self.noise = estimate_noise(known, saturation=ceiling)

    def _model(
        self, fringe: Fringe, lines: _Lines
    ) -> tuple[FringeModel, FittedFringe, _FringeReport]:
        """What the sampled lines say of a fringe; their fit."""
        if self.noise is None:
            self._learn_noise(fringe, lines.rows)
        assert self.noise is not None
        correction = NO_CORRECTION
        harmonics: tuple[PhaseHarmonic, ...] = ()
        if lines.columns is not None:
            correction, harmonics = self._harmonics(fringe, lines)
        sample, freedom = self._sample_model(), fringe.steps - 3
        few = lines.rows[:, :, :: self._every]
        sampled = fit_samples(fringe, few, model_fringe(fringe, correction=correction), sample)
        good = (sampled.flags & _BAD_LIGHT) == 0
        squares, modulation = sampled.squares[good], sampled.modulation[good]
        residual = residual_harmonics(
            squares,
            modulation,
            self.noise.variance(sampled.ambient[good]),
            degrees_of_freedom=freedom,
        )
        model = model_fringe(
            fringe,
            squares_limit=squares_limit(fringe, self._alarm),
            harmonics=residual,
            correction=correction,
        )
        lit = squares < modulation**2 * max(1, freedom) / 4
        rms = float("nan")
        if freedom > 0 and lit.any():
            rms = float(np.sqrt(np.mean(squares[lit], dtype=np.float64) / freedom))
        return model, sampled, _FringeReport(rms, harmonics)

    def _harmonics(
        self, fringe: Fringe, lines: _Lines
    ) -> tuple[NDArray[np.float32], tuple[PhaseHarmonic, ...]]:
        """Correction of a fringe's phase, and what it leaves."""
        sample = self._sample_model()
        bare = model_fringe(fringe)._replace(origin_turns=np.float32(0.0))
        phases: list[NDArray[np.floating]] = []
        good: list[NDArray[np.bool_]] = []
        for stack in (lines.rows, lines.columns):
            assert stack is not None
            fit = fit_samples(fringe, stack, bare, sample)
            phases.append(fit.turns.reshape(stack.shape[1:]))
            good.append(((fit.flags & _BAD_LIGHT) == 0).reshape(stack.shape[1:]))
        orders = error_orders(fringe)
        series = series_along_lines(phases, good, orders)
        if series is None:
            return NO_CORRECTION, ()
        residual = _held_out_residual(phases, good, orders)
        return series.rows, tuple(
            PhaseHarmonic(order, float(found), float(left), float(2 * np.pi * sigma))
            for order, found, left, sigma in zip(
                orders, series.amplitudes_rad, residual, series.sigma, strict=True
            )
        )

    def _fit_exposures(self, group: tuple[Fringe, ...]) -> tuple[FittedFringe, _FringeReport]:
        """Fit a fringe at all of its exposures, the longest first, and join the fits."""
        joined: FittedFringe | None = None
        for fringe in group:
            folded, lines = self._read(fringe)
            model, _, latest = self._model(fringe, lines)
            fitted = fit_folded(folded, model, self._sample_model())
            if joined is None:
                joined, report = fitted, latest
                continue
            scale = _ratio(group[0].exposure_s, fringe.exposure_s)
            merge_exposures(
                joined.planes, joined.flags, fitted.planes, fitted.flags, np.float32(scale)
            )
        assert joined is not None
        return joined, report

    def _level_at(self, fitted: FittedFringe, longest: Fringe):  # type: ignore[no-untyped-def]
        """Takes an exposure to the mean level of the fringe at it, below the ceiling."""
        ceiling = np.float32(self.stream.plan.saturation_level - 0.5)

        def level_at(exposure_s: float | None) -> NDArray[np.float32]:
            scale = np.float32(_ratio(exposure_s, longest.exposure_s))
            return np.minimum(scale * fitted.ambient, ceiling)

        return level_at

    def _step(
        self,
        fringe: Fringe,
        coarse: Fringe | GrayCode | None,
        extent: int,
        sampled: FittedFringe,
        state: AxisState,
    ) -> UnwrapStep:
        """How far the fringe's coordinate may be from what came before."""
        period = fringe.period_px
        half_width, reach, mixed = period / 2, float("inf"), float("inf")
        if isinstance(coarse, GrayCode):
            # Half a cell, and room for blurred edges and harmonics, but less than half a period, at
            # which nothing would contradict anything.
            half_width = min(0.5 * coarse.step_px + period / 8, 0.45 * period)
            reach = max(period / 2 - coarse.step_px / 2, period / 8)
        elif coarse is not None:
            if self.options.compensate_harmonics:
                self._straighten(fringe, coarse, sampled, state)
            apart, variance = self._disagreement(fringe, sampled, state)
            half_width = systematic_disagreement(apart, variance, largest=period / 2)
            reach = period / 2 - half_width
            mixed = certainty_sigmas(self._alarm)
        return UnwrapStep(
            float(period),
            *(
                np.float32(value)
                for value in (
                    half_width,
                    self.options.order_sigmas,
                    mixed,
                    certainty_sigmas(self.options.wrong_order_probability),
                    certainty_sigmas(self.options.borne_out_probability),
                    reach,
                    extent,
                )
            ),
        )

    def _disagreement(
        self, fringe: Fringe, sampled: FittedFringe, state: AxisState
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Fine less coarse coordinate of sampled pixels in good light, and its variance, px."""
        rejection = self._thin(state.rejection)
        good = ((sampled.flags | rejection) & _BAD_LIGHT) == 0
        period = fringe.period_px
        near = self._thin(state.near)[good].astype(np.float64)
        apart = sampled.turns[good] - near / period
        apart -= np.round(apart)
        variance = period**2 * sampled.variance[good] + self._thin(state.variance)[good]
        return period * apart, variance

    def _straighten(
        self, fringe: Fringe, coarse: Fringe, sampled: FittedFringe, state: AxisState
    ) -> None:
        """Subtract the coarse fringe's phase error, as the finer fringe shows it."""
        good = ((sampled.flags | self._thin(state.rejection)) & _BAD_LIGHT) == 0
        apart, _ = self._disagreement(fringe, sampled, state)
        near = self._thin(state.near)[good]
        origin = coarse.origin_rad / (2 * np.pi)
        turns = near / coarse.period_px + origin
        error = -apart / coarse.period_px
        series = series_of_coarse(turns, error, error_orders(coarse)[:2])
        if series is not None:
            left = np.median(np.abs(error - series.error(turns)))
            if left < np.median(np.abs(error)):
                subtract_series(state.near, coarse.period_px, origin, series.rows)


def _held_out_residual(
    phases: list[NDArray[np.floating]], good: list[NDArray[np.bool_]], orders: tuple[int, ...]
) -> NDArray[np.float64]:
    """Amplitudes in every other line of what the lines between them would subtract, radians."""
    half = series_along_lines([p[::2] for p in phases], [g[::2] for g in good], orders)
    if half is None:
        return np.full(len(orders), np.nan)
    rest = [p[1::2] for p in phases]
    # The error is linear in its coefficients, so what would be left of it is the difference.
    left = series_along_lines(rest, [g[1::2] for g in good], orders)
    if left is None:
        return np.full(len(orders), np.nan)
    return 2 * np.pi * np.hypot(left.cosine - half.cosine, left.sine - half.sine)


def _ratio(exposure_s: float | None, other_s: float | None) -> float:
    """Ratio of two exposures; 1 where one is not known."""
    return exposure_s / other_s if exposure_s and other_s else 1.0
