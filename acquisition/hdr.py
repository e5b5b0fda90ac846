r"""Merging an exposure bracket into one picture of radiance, with its variance.

A linear sensor that gives :math:`y_i = b + x\,t_i` at exposure :math:`t_i`, with variance
:math:`\sigma^2(x t_i) = \sigma_r^2 + g\,x t_i` (photon transfer), tells the radiance x with least
variance by the weights :math:`w_i = t_i^2 / \sigma^2(x t_i)`; the bound is
:math:`1 / \sum_i w_i`. Weights taken from the noisy samples themselves would pull the mean down, so
they come from an estimate of all of them, at first :math:`\sum y_i / \sum t_i`, which is best for
photon noise. One repetition takes out what read-out noise in that estimate leaves: bias in the dark
falls from 0.9 % to below what 60 000 repetitions can see.

A sample is left out where it is saturated itself. That truncates the noise just below the ceiling,
by 0.2 % at the most; leaving it out by what shorter exposures predict has no such bias, but up to
five times the variance there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from acquisition.errors import DecodingError
from acquisition.frame_files import Samples
from acquisition.sample_noise import QUANTISATION_VARIANCE, SampleNoise

# Estimates of the weights: the first is free of bias, the second sharp in the dark as well.
_ITERATIONS = 2


@dataclass(frozen=True)
class RadianceImage:
    """Radiance of every pixel, in sensor numbers per second.

    Attributes
    ----------
    radiance : (rows, cols) float32 array
        NaN where every exposure is saturated.
    variance : (rows, cols) float32 array
        Infinite there.
    samples : (rows, cols) uint8 array
        Exposures used.
    """

    radiance: NDArray[np.float32]
    variance: NDArray[np.float32]
    samples: NDArray[np.uint8]


def merge_bracket(
    frames: list[Samples],
    exposures_s: list[float] | NDArray[np.float64],
    *,
    noise: SampleNoise,
    black_level: float,
    saturation_level: int,
) -> RadianceImage:
    """Merge one bracket; pixels are merged each by itself, so a Bayer mosaic stays one.

    Parameters
    ----------
    frames : list of (rows, cols) uint8 or uint16 array
        The same scene at every exposure.
    exposures_s : list of float
        Exposure times as they truly were; see
        :func:`~acquisition.exposure_ratios.estimate_exposures`.
    noise : SampleNoise
        Variance of a sample by its level above black, squared sensor numbers.
    black_level : float
        Sensor number without light.
    saturation_level : int
        Sensor number at and above which a sample is saturated.

    Returns
    -------
    RadianceImage

    Raises
    ------
    DecodingError
        No frame, sizes that differ, or exposures that are not positive.
    """
    times = np.asarray(exposures_s, np.float64)
    if not frames or len(frames) != len(times):
        raise DecodingError(f"{len(frames)} frames cannot be merged at {len(times)} exposures")
    if not (np.isfinite(times) & (times > 0)).all():
        raise DecodingError(f"exposures must be positive times, not {times.tolist()}")
    shapes = {frame.shape for frame in frames}
    if len(shapes) > 1:
        raise DecodingError(f"frames of one bracket differ in size: {sorted(shapes)}")
    order = np.argsort(times, kind="stable")
    stack = np.stack([frames[i] for i in order])
    shape = stack.shape[1:]
    radiance, variance = np.empty(shape, np.float32), np.empty(shape, np.float32)
    samples = np.empty(shape, np.uint8)
    _merge(
        stack,
        times[order],
        # Samples are whole numbers.
        max(noise.read_variance, QUANTISATION_VARIANCE),
        noise.gain,
        black_level,
        float(saturation_level),
        radiance,
        variance,
        samples,
    )
    return RadianceImage(radiance, variance, samples)


def variance_bound(
    radiance: NDArray[np.floating] | float,
    exposures_s: list[float] | NDArray[np.float64],
    *,
    noise: SampleNoise,
    black_level: float,
    saturation_level: int,
) -> NDArray[np.float64]:
    """Least variance that an unbiased merge of a bracket can have.

    Parameters
    ----------
    radiance : (...) array
        True radiance, sensor numbers per second.
    exposures_s, noise, black_level, saturation_level
        As for :func:`merge_bracket`.

    Returns
    -------
    (...) float64 array
        Infinite where every exposure saturates.
    """
    level = np.multiply.outer(np.asarray(radiance, np.float64), np.asarray(exposures_s, np.float64))
    sigma2 = noise.variance(level)
    weight = np.asarray(exposures_s, np.float64) ** 2 / sigma2
    weight[level + black_level >= saturation_level] = 0.0
    with np.errstate(divide="ignore"):
        return np.asarray(1 / weight.sum(axis=-1))


@njit(parallel=True, cache=True)
def _merge(
    stack: NDArray[np.uint16],
    times: NDArray[np.float64],
    read_variance: float,
    gain: float,
    black: float,
    saturation: float,
    radiance: NDArray[np.float32],
    variance: NDArray[np.float32],
    samples: NDArray[np.uint8],
) -> None:
    """Merge every pixel of a stack (exposures rising, rows, cols)."""
    count, rows, cols = stack.shape
    for row in prange(rows):
        for col in range(cols):
            light = 0.0
            time = 0.0
            used = 0
            while used < count and stack[used, row, col] < saturation:
                light += stack[used, row, col] - black
                time += times[used]
                used += 1
            samples[row, col] = used
            if used == 0:
                radiance[row, col] = np.nan
                variance[row, col] = np.inf
                continue
            estimate = light / time
            weights = 0.0
            for _ in range(_ITERATIONS):
                photons = gain * max(estimate, 0.0)
                total = 0.0
                weights = 0.0
                for i in range(used):
                    weight = times[i] / (read_variance + photons * times[i])
                    total += weight * (stack[i, row, col] - black)
                    weights += weight * times[i]
                estimate = total / weights
            radiance[row, col] = estimate
            variance[row, col] = 1.0 / weights
