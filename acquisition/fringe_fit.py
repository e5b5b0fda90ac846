"""Fits of fringes to frames that arrive one by one, whole pictures or samples of them.

No more than four frames of a fringe, and its first, are held at a time; a fringe of more steps is
folded into five sums per pixel, four frames at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from acquisition.frame_files import Samples
from acquisition.fringe_kernels import SUMS, fit_fringe, fold_steps
from acquisition.fringe_models import FringeModel, SampleModel
from acquisition.fringes import STEPS_AT_ONCE, Fringe

NO_CORRECTION = np.zeros((0, 3), np.float32)
_FITTED = 5


@dataclass(frozen=True)
class FoldedFringe:
    """A fringe whose steps have arrived: its sums, and the last four frames not yet in them.

    Attributes
    ----------
    fringe : Fringe
    frames : tuple of four (pixels,) uint8 or uint16 arrays
    weights : (3, 4) float32 array
        Of those frames.
    reference : (pixels,) uint8 or uint16 array
        First frame.
    sums : (5, pixels) float32 array
        (5, 0) where there are no more than four steps.
    """

    fringe: Fringe
    frames: tuple[Samples, Samples, Samples, Samples]
    weights: NDArray[np.float32]
    reference: Samples
    sums: NDArray[np.float32]


@dataclass(frozen=True)
class FittedFringe:
    """A fringe's fit; float32 arrays of (pixels,) in one.

    Attributes
    ----------
    planes : (5, pixels) float32 array
        Phase in turns, its variance, modulation, mean level, sum of squared residuals.
    flags : (pixels,) uint16 array
        Rejection bits.
    """

    planes: NDArray[np.float32]
    flags: NDArray[np.uint16]

    @property
    def turns(self) -> NDArray[np.float32]:
        """Phase in turns, from 0 to 1."""
        return self.planes[0]

    @property
    def variance(self) -> NDArray[np.float32]:
        """Variance of the phase in squared turns."""
        return self.planes[1]

    @property
    def modulation(self) -> NDArray[np.float32]:
        """Amplitude B in sensor numbers."""
        return self.planes[2]

    @property
    def ambient(self) -> NDArray[np.float32]:
        """Mean level A in sensor numbers."""
        return self.planes[3]

    @property
    def squares(self) -> NDArray[np.float32]:
        """Sum of squared residuals."""
        return self.planes[4]


def fold_fringe(fringe: Fringe, frames: Iterable[Samples]) -> FoldedFringe:
    """Take in the frames of a fringe as they come.

    Parameters
    ----------
    fringe : Fringe
    frames : iterable of (pixels,) uint8 or uint16 arrays
        In the order of the fringe's steps.
    """
    weights = fringe.fit.step_weights
    coming = iter(frames)
    group = _next_four(coming)
    reference = group[0]
    sums = np.empty((SUMS, 0), np.float32)
    for number in range(len(weights)):
        filled = (*group, *[reference] * (STEPS_AT_ONCE - len(group)))
        four = (filled[0], filled[1], filled[2], filled[3])
        if number == len(weights) - 1:
            break
        out = sums if sums.size else np.empty((SUMS, reference.size), np.float32)
        fold_steps(four, weights[number], reference, sums, out)
        sums = out
        group = _next_four(coming)
    return FoldedFringe(fringe, four, weights[-1], reference, sums)


def _next_four(coming: Iterator[Samples]) -> list[Samples]:
    return list(islice(coming, STEPS_AT_ONCE))


def model_fringe(
    fringe: Fringe,
    *,
    squares_limit: float = float("inf"),
    harmonics: float = 0.0,
    correction: NDArray[np.float32] = NO_CORRECTION,
) -> FringeModel:
    """What the kernels need to know of a fringe."""
    return FringeModel(
        np.float32(fringe.origin_rad / (2 * np.pi)),
        fringe.fit.isotropic,
        fringe.fit.variance_moments,
        fringe.fit.gram,
        np.float32(squares_limit),
        np.float32(harmonics),
        np.ascontiguousarray(correction, np.float32),
    )


def fit_folded(folded: FoldedFringe, model: FringeModel, sample: SampleModel) -> FittedFringe:
    """Fit a fringe."""
    pixels = folded.reference.size
    planes = np.empty((_FITTED, pixels), np.float32)
    flags = np.empty(pixels, np.uint16)
    fit_fringe(
        folded.frames,
        folded.weights,
        folded.reference,
        folded.sums,
        model,
        sample,
        planes,
        flags,
    )
    return FittedFringe(planes, flags)


def fit_samples(
    fringe: Fringe, stack: Samples, model: FringeModel, sample: SampleModel
) -> FittedFringe:
    """Fit a fringe to a stack (steps, ...) of its frames, or of parts of them."""
    frames = np.ascontiguousarray(stack).reshape(len(stack), -1)
    return fit_folded(fold_fringe(fringe, iter(frames)), model, sample)
