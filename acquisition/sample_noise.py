"""Noise of one camera sample, estimated from the fringes themselves.

A linear sensor's noise grows with the light (photon transfer): ``variance = read + gain * level``
in squared sensor numbers. Where a calibrated sensor model exists it is used; a foreign capture has
none, but its fringes are redundant, and what the fringe model leaves unexplained holds the noise,
beside harmonics of the projector that are smooth in space and no noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from acquisition.frame_files import Samples
from acquisition.fringes import Fringe

QUANTISATION_VARIANCE = 1 / 12
# Standard error of a variance from the median of squares, over that from their mean.
_MEDIAN_EXCESS = 1.3
# Standard errors of a slope that is told from none.
_SIGNIFICANT = 3.0
# Samples that an estimate needs.
_ENOUGH = 100


@dataclass(frozen=True)
class SampleNoise:
    """Variance of a sample as a function of its level.

    Attributes
    ----------
    read_variance : float
        Variance in the dark, squared sensor numbers.
    gain : float
        Growth of the variance per sensor number.
    origin : str
        How it was found, for reports.
    """

    read_variance: float
    gain: float
    origin: str

    def variance(self, level: NDArray[np.floating]) -> NDArray[np.float64]:
        """Variance of samples at the given levels, same shape, squared sensor numbers."""
        return self.read_variance + self.gain * np.maximum(level, 0.0)


def fit_sample_noise(
    level: NDArray[np.floating],
    residual_sum: NDArray[np.floating],
    *,
    degrees_of_freedom: int,
    origin: str,
    bins: int = 16,
    quantile: float = 0.5,
) -> SampleNoise:
    """Fit ``read + gain * level`` to sums of squared residuals.

    Quantiles per bin of level keep pixels out that the fringe model does not describe (edges,
    highlights, shadows); that of a chi-square variable is then brought back to its mean.

    Parameters
    ----------
    level, residual_sum : (n,) arrays
        Mean level of each pixel, and its sum of squared residuals.
    degrees_of_freedom : int
        Of each sum.
    origin : str
        Kept in the result.
    bins : int
        Number of bins of equal population.
    quantile : float
        The median is the most robust. Where the terms of a sum have unequal variances, as photon
        noise gives them, it understates the mean, by up to 9 % in variance for five steps and more;
        a quantile of 0.7 then does by 1 to 5 %.

    Returns
    -------
    SampleNoise
    """
    groups = max(1, min(bins, len(level) // 50))
    each = len(level) // groups
    order = np.argsort(level)[: groups * each].reshape(groups, each)
    levels = level[order].mean(axis=1)
    place = int(quantile * (each - 1))
    variances = np.partition(residual_sum[order], place, axis=1)[:, place]
    variances = variances / stats.chi2.ppf(quantile, degrees_of_freedom)
    floor = QUANTISATION_VARIANCE
    if groups < 3 or np.ptp(levels) < 1e-3 * max(1.0, abs(levels).max()):
        return SampleNoise(max(floor, float(np.median(variances))), 0.0, origin)
    # Relative errors of the bins are alike, so weight by the inverse of the fitted variance.
    expected = np.full_like(variances, np.median(variances))
    design = np.stack([np.ones_like(levels), levels], axis=1)
    for _ in range(4):
        weight = 1 / np.maximum(expected, floor)
        weighted = design * weight[:, np.newaxis]
        read, gain = np.linalg.lstsq(weighted, variances * weight, rcond=None)[0]
        expected = design @ [read, gain]
    scatter = _MEDIAN_EXCESS * np.sqrt(2 / (degrees_of_freedom * each))
    gain_error = scatter * np.sqrt(np.linalg.pinv(weighted.T @ weighted)[1, 1])
    if gain < _SIGNIFICANT * gain_error:
        # Over levels this much alike a slope would be noise, and would spread the variances.
        read, gain = float(np.average(variances, weights=weight)), 0.0
    if gain > 0 and read < floor:
        read = floor
        gain = float(np.median(np.maximum(variances - floor, 0) / np.maximum(levels, 1e-6)))
    return SampleNoise(max(floor, float(read)), float(gain), origin)


def estimate_noise(
    fringes: Sequence[tuple[Fringe, Samples]], *, saturation: int | None = None
) -> SampleNoise:
    """Noise of a sample from the redundancy of fringes.

    With four steps or more, the white part of each fringe's own residual; with three, the white
    part of what the means of several fringes disagree by; with a single three-step fringe, the
    differences of neighbouring pixels, which also hold texture, so that the noise is overestimated.

    Parameters
    ----------
    fringes : sequence of (Fringe, (steps, rows, cols) array)
        Fringes with their frames, or some rows of them.
    saturation : int, optional
        Level at which a sample saturates; pixels that reach it are left out.

    Returns
    -------
    SampleNoise
    """
    redundant = [(fringe, stack) for fringe, stack in fringes if fringe.steps > 3]
    if redundant:
        freedom = redundant[0][0].steps - 3
        alike = [pair for pair in redundant if pair[0].steps - 3 == freedom]
        found = [_white_residual(fringe, stack, saturation) for fringe, stack in alike]
        if sum(len(level) for level, _ in found) > _ENOUGH:
            return fit_sample_noise(
                np.concatenate([level for level, _ in found]),
                np.concatenate([squares for _, squares in found]),
                degrees_of_freedom=freedom,
                quantile=0.5 if freedom == 1 else 0.7,
                origin=f"white part of the residual of {freedom + 3} phase steps",
            )
    if len(fringes) > 1:
        level, squares = _white_disagreement([stack for _, stack in fringes], saturation)
        if len(level) > _ENOUGH:
            return fit_sample_noise(
                level,
                squares,
                degrees_of_freedom=len(fringes) - 1,
                origin=f"agreement of the means of {len(fringes)} fringes",
            )
    frame = fringes[0][1][0].astype(np.float64)
    second = _second_differences(frame)
    unsaturated = _unsaturated(fringes[0][1][:1], saturation)
    if not unsaturated.any():
        return SampleNoise(QUANTISATION_VARIANCE, 0.0, "quantisation: too little to tell more from")
    return fit_sample_noise(
        frame[:, 1:-1][unsaturated],
        second[unsaturated] ** 2,
        degrees_of_freedom=1,
        origin="differences of neighbouring pixels (includes texture)",
    )


def _second_differences(images: NDArray[np.float64]) -> NDArray[np.float64]:
    """White part of pictures (..., rows, cols): second differences along rows, of their variance.

    What is smooth along a row (harmonics of the projector, steps of its grey levels) drops out.
    """
    return (images[..., 2:] - 2 * images[..., 1:-1] + images[..., :-2]) / np.sqrt(6)


def _unsaturated(stack: Samples, saturation: int | None) -> NDArray[np.bool_]:
    """(rows, cols - 2) mask of pixels that, like their neighbours, stay below the ceiling."""
    rows, cols = stack.shape[1:]
    if saturation is None or cols < 3:
        return np.ones((rows, max(0, cols - 2)), np.bool_)
    below = (stack < saturation).all(axis=0)
    return below[:, 2:] & below[:, 1:-1] & below[:, :-2]


def _white_residual(
    fringe: Fringe, stack: Samples, saturation: int | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Level, and sum of squares of the white part of the fringe fit's residual, where lit."""
    samples = stack.astype(np.float64)
    parameters = np.tensordot(fringe.fit.solution, samples, axes=1)
    residual = samples - np.tensordot(fringe.fit.design, parameters, axes=1)
    squares = (_second_differences(residual) ** 2).sum(axis=0)
    level, modulation = parameters[0, :, 1:-1], np.hypot(parameters[1], parameters[2])[:, 1:-1]
    total = (residual[:, :, 1:-1] ** 2).sum(axis=0)
    lit = modulation > 2 * np.sqrt(total / (fringe.steps - 3))
    lit &= _unsaturated(stack, saturation)
    return level[lit], squares[lit]


def _white_disagreement(
    stacks: Sequence[Samples], saturation: int | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Level, and sum of squares of what the means of several fringes disagree by, per sample."""
    steps = len(stacks[0])
    same = [stack for stack in stacks if len(stack) == steps]
    means = np.stack([stack.mean(axis=0, dtype=np.float64) for stack in same])
    # Means of whole numbers are multiples of 1/steps, and medians of them would be too.
    means += np.random.default_rng(0).uniform(-0.5, 0.5, means.shape) / steps
    level = means.mean(axis=0)
    squares = steps * (_second_differences(means - level) ** 2).sum(axis=0)
    good = np.logical_and.reduce([_unsaturated(stack, saturation) for stack in same])
    return level[:, 1:-1][good], squares[good]
