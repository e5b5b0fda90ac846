"""Noise of one camera sample, estimated from the fringes themselves.

A linear sensor's noise grows with the light (photon transfer): ``variance = read + gain * level``
in squared sensor numbers. Where a calibrated sensor model exists it is used; a foreign capture has
none, but its fringes are redundant, and what the fringe model leaves unexplained holds the noise,
beside harmonics of the projector that are smooth in space and no noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

QUANTISATION_VARIANCE = 1 / 12


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
) -> SampleNoise:
    """Fit ``read + gain * level`` to sums of squared residuals.

    Medians per bin of level keep pixels out that the fringe model does not describe (edges,
    highlights, shadows); the median of a chi-square variable is then brought back to its mean.

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

    Returns
    -------
    SampleNoise
    """
    order = np.argsort(level)
    groups = np.array_split(order, min(bins, max(1, len(order) // 50)))
    levels = np.array([np.median(level[g]) for g in groups])
    variances = np.array([np.median(residual_sum[g]) for g in groups])
    variances = variances / stats.chi2.median(degrees_of_freedom)
    floor = QUANTISATION_VARIANCE
    if len(groups) < 3 or np.ptp(levels) < 1e-3 * max(1.0, abs(levels).max()):
        return SampleNoise(max(floor, float(np.median(variances))), 0.0, origin)
    # Relative errors of the bins are alike, so weight by the inverse of the fitted variance.
    expected = np.full_like(variances, np.median(variances))
    for _ in range(4):
        weight = 1 / np.maximum(expected, floor)
        design = np.stack([np.ones_like(levels), levels], axis=1)
        read, gain = np.linalg.lstsq(
            design * weight[:, np.newaxis], variances * weight, rcond=None
        )[0]
        expected = design @ [read, gain]
    if gain < 0:
        read, gain = float(np.median(variances)), 0.0
    elif read < floor:
        read = floor
        gain = float(np.median(np.maximum(variances - floor, 0) / np.maximum(levels, 1e-6)))
    return SampleNoise(max(floor, float(read)), float(gain), origin)
