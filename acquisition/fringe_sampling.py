"""What some lines of a picture tell of its fringes, before the whole of it is decoded.

Some rows are kept of every frame, spread over the picture. From them come the noise of a sample,
the size of what harmonics leave unexplained, and, where harmonics are to be compensated, the error
of the phase; for that, some columns are kept too.
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
    fit_samples,
    fold_fringe,
    model_fringe,
)
from acquisition.fringe_models import FringeModel, SampleModel
from acquisition.fringe_statistics import residual_harmonics, squares_limit, steps_contradict
from acquisition.fringes import Fringe
from acquisition.gray_decoding import sample_rows
from acquisition.harmonics import error_orders, held_out_residual, series_along_lines
from acquisition.patterns import Axis
from acquisition.sample_noise import SampleNoise, estimate_noise

# Fringes whose frames may be looked at before their turn, to tell the noise of three steps.
_FRINGES_AHEAD = 4
_LEAST_UNSATURATED = 0.1
# Pixels from which medians are taken.
_FOR_MEDIANS = 4096
BAD_LIGHT = np.uint16(Rejection.LOW_MODULATION | Rejection.SATURATED)


@dataclass(frozen=True)
class Lines:
    """Some lines of every frame of a fringe.

    Attributes
    ----------
    rows : (steps, rows, cols) array
    columns : (steps, cols, rows) array or None
        Columns, each as a line; only where harmonics are compensated.
    """

    rows: Samples
    columns: Samples | None


@dataclass(frozen=True)
class FringeReport:
    """What is reported of a fringe.

    Attributes
    ----------
    residual_rms : float
        NaN where there are no more steps than unknowns.
    harmonics : tuple of PhaseHarmonic
        What was compensated.
    """

    residual_rms: float
    harmonics: tuple[PhaseHarmonic, ...]


@dataclass
class FringeSampler:
    """Reads fringes and learns from some of their lines.

    Attributes
    ----------
    stream : FrameStream
    options : DecodingOptions
    groups : list of tuples of Fringe
        All fringes of the plan, those that differ in exposure only together.
    noise : SampleNoise or None
        None until the first fringe has told it.
    alarm : float
        Share of pixels that each test for mixed light may flag by chance.
    """

    stream: FrameStream
    options: DecodingOptions
    groups: list[tuple[Fringe, ...]]
    noise: SampleNoise | None = None
    alarm: float = field(init=False)
    _rows: NDArray[np.intp] = field(init=False)
    _every: int = field(init=False)
    _columns: NDArray[np.intp] = field(init=False)

    def __post_init__(self) -> None:
        rows, cols = self.stream.shape
        self._rows = sample_rows((rows, cols))
        self._every = max(1, len(self._rows) * cols // _FOR_MEDIANS)
        self._columns = sample_rows((cols, rows))
        redundant = sum(fringe.steps > 3 for group in self.groups for fringe in group)
        unwrapped = len(self.groups) - len({group[0].axis for group in self.groups})
        self.alarm = self.options.false_alarm / max(1, redundant + unwrapped)

    def read(self, fringe: Fringe) -> tuple[FoldedFringe, Lines]:
        """Fold the frames of a fringe as they come, and keep some lines of each."""
        rows: list[NDArray[np.integer]] = []
        columns: list[NDArray[np.integer]] = []

        def coming() -> Iterator[Samples]:
            for frame_id in fringe.frame_ids:
                frame = self.stream.take(frame_id)
                rows.append(self._rows_of(frame))
                if self.options.compensate_harmonics:
                    columns.append(self._columns_of(frame))
                yield frame

        folded = fold_fringe(fringe, coming())
        return folded, Lines(np.stack(rows), np.stack(columns) if columns else None)

    def thin(self, planes: NDArray[Any]) -> NDArray[Any]:
        """The sampled pixels of pictures (..., pixels), flat."""
        pictures = planes.reshape(*planes.shape[:-1], *self.stream.shape)
        return pictures[..., self._rows, :: self._every].reshape(*planes.shape[:-1], -1)

    def sample_model(self, fringe: Fringe) -> SampleModel:
        """Noise and limits of a sample of a fringe, as the kernels take them.

        Of steps that are not spread evenly, more contrast is asked.
        """
        assert self.noise is not None  # told by the first fringe
        least = self.options.minimum_modulation
        contrast = self.options.minimum_contrast if least is None else 0.0
        return SampleModel(
            np.float32(self.noise.read_variance),
            np.float32(self.noise.gain),
            np.float32(self.noise.black_level),
            np.float32(self.stream.plan.saturation_level),
            np.float32(least or 0.0),
            np.float32(contrast * fringe.fit.excess),
        )

    def model(self, fringe: Fringe, lines: Lines) -> tuple[FringeModel, FittedFringe, FringeReport]:
        """What the sampled lines say of a fringe; their fit."""
        if self.noise is None:
            self.learn_noise([(fringe, lines.rows)])
        assert self.noise is not None
        correction = NO_CORRECTION
        harmonics: tuple[PhaseHarmonic, ...] = ()
        if lines.columns is not None:
            correction, harmonics = self._harmonics(fringe, lines)
        sample, freedom = self.sample_model(fringe), fringe.steps - 3
        few = lines.rows[:, :, :: self._every]
        limit = squares_limit(fringe, self.alarm)
        model = model_fringe(fringe, squares_limit=limit, correction=correction)
        sampled = fit_samples(fringe, few, model, sample)
        good = (sampled.flags & BAD_LIGHT) == 0
        squares, modulation = sampled.squares[good], sampled.modulation[good]
        residual = residual_harmonics(
            squares,
            modulation,
            self.noise.variance(sampled.ambient[good]),
            degrees_of_freedom=freedom,
        )
        panel = self.stream.plan.projector
        extent = panel.width if fringe.axis is Axis.COLUMN else panel.height
        if steps_contradict(fringe, few.reshape(fringe.steps, -1)[:, good], residual, extent):
            raise DecodingError(
                f"the {fringe.steps} frames of the {fringe.axis} fringe of period "
                f"{fringe.period_px:g} px ({', '.join(fringe.frame_ids)}) are not the steps of one "
                "fringe: they were taken for one another, or one is dark; check their order and "
                "the shifts"
            )
        model = model._replace(harmonics=np.float32(residual))
        lit = squares < modulation**2 * max(1, freedom) / 4
        rms = float("nan")
        if freedom > 0 and lit.any():
            rms = float(np.sqrt(np.mean(squares[lit], dtype=np.float64) / freedom))
        return model, sampled, FringeReport(rms, harmonics)

    def _rows_of(self, frame: Samples) -> NDArray[np.integer]:
        return frame.reshape(self.stream.shape)[self._rows]

    def _columns_of(self, frame: Samples) -> NDArray[np.integer]:
        return frame.reshape(self.stream.shape)[:, self._columns].T

    def _look_ahead(self, fringe: Fringe) -> list[Samples]:
        return [self.stream.look_ahead(frame_id) for frame_id in fringe.frame_ids]

    def learn_noise(self, known: list[tuple[Fringe, Samples]]) -> None:
        """Noise of a sample from rows of fringes, and of those that follow if it must be."""
        ceiling = self.stream.plan.saturation_level
        taken = {fringe.frame_ids for fringe, _ in known}
        unsaturated = max(np.mean((stack < ceiling).all(axis=0)) for _, stack in known)
        if known[0][0].steps == 3 or unsaturated < _LEAST_UNSATURATED:
            others = [f for group in self.groups for f in group if f.frame_ids not in taken]
            for other in others[: _FRINGES_AHEAD - 1]:
                frames = self._look_ahead(other)
                known = [*known, (other, np.stack([self._rows_of(frame) for frame in frames]))]
        self.noise = estimate_noise(known, saturation=ceiling)

    def _harmonics(
        self, fringe: Fringe, lines: Lines
    ) -> tuple[NDArray[np.float32], tuple[PhaseHarmonic, ...]]:
        """Correction of a fringe's phase, and what it leaves.

        A fringe too coarse to show its own error is given that of the next finer one with the
        same steps: the response is the projector's.
        """
        found = self._harmonics_of(fringe, lines)
        finer = (
            other
            for group in self.groups
            for other in group
            if found is None
            and other.axis is fringe.axis
            and other.period_px < fringe.period_px
            and other.gamma == fringe.gamma
            and np.array_equal(other.shifts_rad, fringe.shifts_rad)
        )
        for other in finer:
            frames = self._look_ahead(other)
            ahead = Lines(
                np.stack([self._rows_of(frame) for frame in frames]),
                np.stack([self._columns_of(frame) for frame in frames]),
            )
            found = self._harmonics_of(other, ahead)
            if found is not None:
                break
        return (NO_CORRECTION, ()) if found is None else found

    def _harmonics_of(
        self, fringe: Fringe, lines: Lines
    ) -> tuple[NDArray[np.float32], tuple[PhaseHarmonic, ...]] | None:
        sample = self.sample_model(fringe)
        bare = model_fringe(fringe)._replace(origin_turns=np.float32(0.0))
        phases: list[NDArray[np.floating]] = []
        good: list[NDArray[np.bool_]] = []
        for stack in (lines.rows, lines.columns):
            assert stack is not None
            fit = fit_samples(fringe, stack, bare, sample)
            phases.append(fit.turns.reshape(stack.shape[1:]))
            good.append(((fit.flags & BAD_LIGHT) == 0).reshape(stack.shape[1:]))
        orders = error_orders(fringe)
        series = series_along_lines(phases, good, orders)
        if series is None:
            return None
        residual = held_out_residual(phases, good, orders)
        return series.rows, tuple(
            PhaseHarmonic(order, float(found), float(left), float(2 * np.pi * sigma))
            for order, found, left, sigma in zip(
                orders, series.amplitudes_rad, residual, series.sigma, strict=True
            )
        )
