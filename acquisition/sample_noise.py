"""Noise of one camera sample, estimated from the fringes themselves.

A linear sensor's noise grows with the light (photon transfer): ``variance = read + gain * level``
in squared sensor numbers. Where a calibrated sensor model exists it is used; a foreign capture has
none, but its fringes are redundant, and what the fringe model leaves unexplained holds the noise,
beside harmonics of the projector that are no noise. Where the fringe is many pixels long they are
smooth in space; where it is not, they are told by following its phase, and taken out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from acquisition.frame_files import Samples
from acquisition.fringes import Fringe
from acquisition.harmonics import steep_harmonics

QUANTISATION_VARIANCE = 1 / 12
# Standard error of a variance from the median of squares, over that from their mean.
_MEDIAN_EXCESS = 1.3
# Standard errors of a slope that is told from none.
_SIGNIFICANT = 3.0
# Samples that an estimate needs.
_ENOUGH = 100
# Pixels over which levels are averaged.
_LEVEL_PX = 31
# Distances along rows at which neighbours are compared; 0 compares none.
_LAGS = (1, 2, 0)


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
    black_level : float
        Level above which the variance grows: no more than the sensor's level in the dark.
    """

    read_variance: float
    gain: float
    origin: str
    black_level: float = 0.0

    def variance(self, level: NDArray[np.floating]) -> NDArray[np.float64]:
        """Variance of samples at the given levels, same shape, squared sensor numbers."""
        return self.read_variance + self.gain * np.maximum(level - self.black_level, 0.0)


def fit_sample_noise(
    level: NDArray[np.floating],
    residual_sum: NDArray[np.floating],
    *,
    degrees_of_freedom: int,
    origin: str,
    bins: int = 16,
    quantile: float = 0.5,
) -> SampleNoise:
    """Fit a straight line of variance over level to sums of squared residuals.

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
    variances = variances / special.chdtri(degrees_of_freedom, 1 - quantile)
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
    black_level = 0.0
    if gain > 0 and read < floor:
        least = float(levels.min())
        if least - (floor - read) / gain < np.ptp(levels):
            # A sensor that says more than nothing in the dark. What is darker than all that tells
            # of the noise is not taken to be free of it.
            black_level, read = least, read + gain * least
        else:
            # Levels far from where the line would end do not tell where that is.
            black_level, read = 0.0, floor
            gain = float(np.median(np.maximum(variances - floor, 0) / np.maximum(levels, 1e-6)))
    return SampleNoise(max(floor, float(read)), float(gain), origin, black_level)


def estimate_noise(
    fringes: Sequence[tuple[Fringe, Samples]], *, saturation: int | None = None
) -> SampleNoise:
    """Noise of a sample from the redundancy of fringes.

    With four steps or more, the white part of each fringe's own residual; with three, the white
    part of what the means of several fringes disagree by; with a single three-step fringe, the
    differences of its mean at neighbouring pixels, which also hold texture, so that the noise is
    overestimated.

    What is white shows in the differences of neighbours along rows; of every second one where too
    few have good neighbours, as where one colour of a mosaic is saturated; and in a picture too
    small for either all that a fringe leaves counts as noise.

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
        steps = redundant[0][0].steps
        alike = [pair for pair in redundant if pair[0].steps == steps]
        return _first_found(
            partial(_white_residuals, alike, saturation),
            degrees_of_freedom=steps - 3,
            quantile=0.5 if steps == 4 else 0.7,
            origin=f"white part of the residual of {steps} phase steps",
        )
    steps = fringes[0][0].steps
    alike = [pair for pair in fringes if pair[0].steps == steps]
    if len(alike) > 1:
        return _first_found(
            partial(_white_disagreement, alike, saturation),
            degrees_of_freedom=len(alike) - 1,
            origin=f"agreement of the means of {len(alike)} fringes",
        )
    return _first_found(
        partial(_white_means, alike[0], saturation),
        degrees_of_freedom=1,
        origin="differences of neighbouring pixels (includes texture)",
    )


_Squares = tuple[NDArray[np.float64], NDArray[np.float64]]


def _first_found(
    at_lag: Callable[[int], _Squares],
    *,
    degrees_of_freedom: int,
    origin: str,
    quantile: float = 0.5,
) -> SampleNoise:
    """Noise from levels and squares at the first lag that tells enough of them."""
    for lag in _LAGS:
        level, squares = at_lag(lag)
        if len(level) > (_ENOUGH if lag else 0):
            return fit_sample_noise(
                level,
                squares,
                degrees_of_freedom=degrees_of_freedom,
                quantile=quantile,
                origin=origin if lag else f"{origin}, of {len(level)} pixels as they are",
            )
    return SampleNoise(QUANTISATION_VARIANCE, 0.0, "quantisation: too little to tell more from")


def _white(pictures: NDArray[np.float64], lag: int) -> NDArray[np.float64]:
    """White part of pictures (..., rows, cols): second differences along rows, of their variance.

    What is smooth along a row (harmonics of the projector, steps of its grey levels) drops out.
    """
    if lag == 0:
        return pictures
    outer = pictures[..., 2 * lag :] + pictures[..., : -2 * lag]
    return (outer - 2 * _inner(pictures, lag)) / np.sqrt(6)


def _inner(pictures: NDArray[np.floating], lag: int) -> NDArray[np.floating]:
    """The pixels of pictures (..., cols) that have neighbours at a lag."""
    return pictures[..., lag : pictures.shape[-1] - lag]


def _unsaturated(stack: Samples, saturation: int | None, lag: int) -> NDArray[np.bool_]:
    """(rows, cols - 2 lag) mask of pixels that, like their neighbours, stay below the ceiling."""
    cols = max(0, stack.shape[2] - 2 * lag)
    if saturation is None or cols == 0:
        return np.ones((stack.shape[1], cols), np.bool_)
    below = (stack < saturation).all(axis=0)
    alike = [below[:, first : first + cols] for first in (0, lag, 2 * lag)]
    return np.logical_and.reduce(alike)


def _fit(fringe: Fringe, samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, rows, cols) fit of A, c and s."""
    return np.tensordot(fringe.fit.solution, samples, axes=1)


def _white_residuals(
    fringes: Sequence[tuple[Fringe, Samples]], saturation: int | None, lag: int
) -> _Squares:
    """Level, and sum of squares of the white part of what the fits of fringes leave, where lit."""
    levels, squares = [], []
    for fringe, stack in fringes:
        samples = stack.astype(np.float64)
        parameters = _fit(fringe, samples)
        residual = samples - np.tensordot(fringe.fit.design, parameters, axes=1)
        phasor = parameters[1] + 1j * parameters[2]
        modulation = np.abs(phasor)
        below = _unsaturated(stack, saturation, 0)
        residual -= steep_harmonics(
            residual, phasor, light=modulation, use=below, orders=range(2, 7)
        )
        total = (residual**2).sum(axis=0)
        lit = modulation > 2 * np.sqrt(total / (fringe.steps - 3))
        lit = lit[:, lag : lit.shape[1] - lag] & _unsaturated(stack, saturation, lag)
        levels.append(_inner(parameters[0], lag)[lit])
        squares.append((_white(residual, lag) ** 2).sum(axis=0)[lit])
    return np.concatenate(levels), np.concatenate(squares)


def _plain_mean(fringe: Fringe, stack: Samples, saturation: int | None) -> NDArray[np.float64]:
    """Mean level of a fringe of three steps, without the harmonics that three steps fold onto it.

    They make the modulation ripple, so that it is the level that tells how much light there is.
    """
    mean, c, s = _fit(fringe, stack.astype(np.float64))
    light = ndimage.uniform_filter1d(mean, _LEVEL_PX, axis=1)
    orders = fringe.steps * np.arange(1, 5)
    below = _unsaturated(stack, saturation, 0)
    phasor = c + 1j * s
    return (
        mean - steep_harmonics(mean[np.newaxis], phasor, light=light, use=below, orders=orders)[0]
    )


def _white_disagreement(
    fringes: Sequence[tuple[Fringe, Samples]], saturation: int | None, lag: int
) -> _Squares:
    """Level, and sum of squares of what the means of fringes disagree by, per sample."""
    steps = fringes[0][0].steps
    random = np.random.default_rng(0)
    means = []
    for fringe, stack in fringes:
        mean = _plain_mean(fringe, stack, saturation)
        # Means of whole numbers are multiples of 1/steps, and medians of them would be too.
        means.append(mean + random.uniform(-0.5, 0.5, mean.shape) / steps)
    level = np.mean(means, axis=0)
    squares = steps * (_white(np.stack(means) - level, lag) ** 2).sum(axis=0)
    good = np.logical_and.reduce([_unsaturated(stack, saturation, lag) for _, stack in fringes])
    return _inner(level, lag)[good], squares[good]


def _white_means(
    fringe_and_stack: tuple[Fringe, Samples], saturation: int | None, lag: int
) -> _Squares:
    """Level, and square of what the mean of a fringe and its neighbours differ by, per sample."""
    fringe, stack = fringe_and_stack
    if lag == 0 or stack.shape[2] <= 2 * lag:
        # A level by itself tells nothing of its noise.
        return np.zeros(0), np.zeros(0)
    good = _unsaturated(stack, saturation, lag)
    mean = _plain_mean(fringe, stack, saturation)
    # A pixel's own level holds the noise that it is asked for.
    level = ndimage.uniform_filter1d(mean, _LEVEL_PX, axis=1)
    share = float((fringe.fit.solution[0] ** 2).sum())
    squares = (_white(mean, lag) ** 2 / share)[good]
    if lag == 1 and good.any():
        # Neighbours of a mosaic differ in colour; then every second pixel tells less.
        farther = _white_means(fringe_and_stack, saturation, 2)
        if len(farther[1]) > _ENOUGH and np.median(farther[1]) < np.median(squares):
            return farther
    return _inner(level, lag)[good], squares
