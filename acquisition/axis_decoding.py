"""One axis of a scan, fringe by fringe from coarse to fine.

Every fringe is fitted and unwrapped in one pass over the picture, as soon as its last frame has
arrived. What that pass must know beforehand (the noise of a sample, the harmonics of the
projector, by how much fringes disagree) comes from some lines of the picture, which are kept of
every frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import PhaseHarmonic
from acquisition.errors import DecodingError
from acquisition.fringe_fit import FittedFringe, FoldedFringe, fit_folded
from acquisition.fringe_kernels import advance, advance_fitted, merge_exposures
from acquisition.fringe_models import AxisState, UnwrapStep
from acquisition.fringe_sampling import BAD_LIGHT, FringeReport, FringeSampler, Lines
from acquisition.fringe_statistics import disagreement_limit, systematic_disagreement
from acquisition.fringes import Fringe
from acquisition.gray_decoding import GrayCode, cell_coordinates, needs_level, read_words
from acquisition.harmonics import error_orders, series_of_coarse
from acquisition.patterns import BLACK, WHITE
from acquisition.rejection_kernels import subtract_series
from acquisition.unwrapping import certainty_sigmas

_SAME = 1e-6
_NO_COORDINATE, _NO_MODULATION = np.empty(0, np.float64), np.empty(0, np.float32)


@dataclass
class SharedPictures:
    """What all axes add to; arrays of (pixels,).

    Attributes
    ----------
    ambient : float32 array
        Sum of the mean levels of ``terms`` fringes, the finest of each axis.
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


@dataclass
class FringeDecoder:
    """Decodes the fringes of a plan, axis by axis.

    Attributes
    ----------
    sampler : FringeSampler
    shared : SharedPictures
    """

    sampler: FringeSampler
    shared: SharedPictures
    _near: NDArray[np.float32] = field(init=False)  # of one axis after the other

    def __post_init__(self) -> None:
        self._near = np.empty(len(self.shared.rejection), np.float32)

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
        if code is not None and code.step_px > (1 + _SAME) * coarsest.period_px:
            raise DecodingError(
                f"the Gray code of the {coarsest.axis}s has cells of {code.step_px:g} px, which do "
                f"not tell the orders of fringes of {coarsest.period_px:g} px; cells of half a "
                "period are best"
            )
        if code is None and coarsest.period_px < extent - 1:
            raise DecodingError(
                f"nothing tells the fringe order of the {coarsest.axis}s: the longest period is "
                f"{coarsest.period_px:g} px, the projector has {extent}; add Gray code or a "
                "fringe of one period"
            )
        for fringe in (fringe for group in groups for fringe in group):
            _ = fringe.fit  # refuse what cannot be decoded before anything is read
        pixels = len(self.shared.rejection)
        near, variance = self._near, np.empty(pixels, np.float32)
        if code is not None:
            variance.fill(0.0)
        if code is not None and not needs_level(code):
            cell_coordinates(code, read_words(code, self.sampler.stream), near)
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
    ) -> FringeReport:
        """Fit one fringe and unwrap it by what came before."""
        by_level = isinstance(coarse, GrayCode) and needs_level(coarse)
        if len(group) == 1 and not by_level:
            folded, lines = self.sampler.read(group[0])
            model, sampled, report = self.sampler.model(group[0], lines)
            step = self._step(group[0], coarse, extent, sampled, state)
            parts = (folded.frames, folded.weights, folded.reference, folded.sums)
            advance(*parts, model, self.sampler.sample_model(group[0]), step, state)
            return report
        fitted, report = self._fit_exposures(group)
        if by_level and isinstance(coarse, GrayCode):
            words = read_words(coarse, self.sampler.stream, self._level_at(fitted, group[0]))
            cell_coordinates(coarse, words, state.near)
        thin = FittedFringe(self.sampler.thin(fitted.planes), self.sampler.thin(fitted.flags))
        step = self._step(group[0], coarse, extent, thin, state)
        advance_fitted(fitted.planes, fitted.flags, step, state)
        return report

    def _fit_exposures(self, group: tuple[Fringe, ...]) -> tuple[FittedFringe, FringeReport]:
        """Fit a fringe at all of its exposures, the longest first, and join the fits."""
        joined: FittedFringe | None = None
        coming: Iterable[tuple[FoldedFringe, Lines]] = map(self.sampler.read, group)
        if self.sampler.noise is None:
            # Levels of all exposures tell how the noise grows with the light.
            coming = list(coming)
            rows = [lines.rows for _, lines in coming]
            self.sampler.learn_noise(list(zip(group, rows, strict=True)))
        for folded, lines in coming:
            fringe = folded.fringe
            model, _, latest = self.sampler.model(fringe, lines)
            fitted = fit_folded(folded, model, self.sampler.sample_model(fringe))
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
        """Takes an exposure to the mean level of the fringe at it, below the ceiling.

        At other exposures than the fringe's that is the mean of white and black, where they were
        taken: levels hold the sensor's black level, and so are not in proportion to the exposures.
        """
        stream = self.sampler.stream
        ceiling = np.float32(stream.plan.saturation_level - 0.5)
        flats = {(frame.pattern, frame.exposure_s): frame.id for frame in stream.plan.frames}

        @cache
        def level_at(exposure_s: float | None) -> NDArray[np.float32]:
            white, black = flats.get((WHITE, exposure_s)), flats.get((BLACK, exposure_s))
            if exposure_s != longest.exposure_s and white is not None and black is not None:
                both = stream.take(white).astype(np.float32) + stream.take(black)
                return np.minimum(both / 2, ceiling)
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
        half_width, reach, mixed, systematic = period / 2, *[float("inf")] * 3
        if isinstance(coarse, GrayCode):
            # Half a cell, and room for blurred edges and harmonics, but less than half a period, at
            # which nothing would contradict anything. Cells of a period leave it to the neighbours.
            if coarse.step_px < 0.75 * period:
                half_width = min(0.5 * coarse.step_px + period / 8, 0.45 * period)
            reach = max(period / 2 - coarse.step_px / 2, period / 8)
        elif coarse is not None:
            if self.sampler.options.compensate_harmonics:
                self._straighten(fringe, coarse, sampled, state)
            apart, variance = self._disagreement(fringe, sampled, state)
            half_width = systematic_disagreement(apart, variance, largest=period / 2)
            reach = period / 2 - half_width
            systematic = half_width**2 / 2
            mixed = disagreement_limit(fringe, self.sampler.alarm)
        return UnwrapStep(
            float(period),
            coarse is None,
            np.float32((extent - 1) / 2),
            *(
                np.float32(value)
                for value in (
                    half_width,
                    self.sampler.options.order_sigmas,
                    mixed,
                    certainty_sigmas(self.sampler.options.wrong_order_probability),
                    certainty_sigmas(self.sampler.options.borne_out_probability),
                    reach,
                    systematic,
                    extent,
                )
            ),
        )

    def _disagreement(
        self, fringe: Fringe, sampled: FittedFringe, state: AxisState
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Fine less coarse coordinate of sampled pixels in good light, and its variance, px."""
        rejection = self.sampler.thin(state.rejection)
        good = ((sampled.flags | rejection) & BAD_LIGHT) == 0
        period = fringe.period_px
        near = self.sampler.thin(state.near)[good].astype(np.float64)
        apart = sampled.turns[good] - near / period
        apart -= np.round(apart)
        variance = period**2 * sampled.variance[good] + self.sampler.thin(state.variance)[good]
        return period * apart, variance

    def _straighten(
        self, fringe: Fringe, coarse: Fringe, sampled: FittedFringe, state: AxisState
    ) -> None:
        """Subtract the coarse fringe's phase error, as the finer fringe shows it."""
        good = ((sampled.flags | self.sampler.thin(state.rejection)) & BAD_LIGHT) == 0
        apart, _ = self._disagreement(fringe, sampled, state)
        near = self.sampler.thin(state.near)[good]
        origin = coarse.origin_rad / (2 * np.pi)
        turns = near / coarse.period_px + origin
        error = -apart / coarse.period_px
        series = series_of_coarse(turns, error, error_orders(coarse)[:2])
        if series is not None:
            left = np.median(np.abs(error - series.error(turns)))
            if left < np.median(np.abs(error)):
                subtract_series(state.near, coarse.period_px, origin, series.rows)


def _ratio(exposure_s: float | None, other_s: float | None) -> float:
    """Ratio of two exposures; 1 where one is not known."""
    return exposure_s / other_s if exposure_s and other_s else 1.0
