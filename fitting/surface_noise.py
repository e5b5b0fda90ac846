"""White noise of a measured surface, observed and predicted.

Second differences along a row remove whatever is smooth over three pixels and keep the noise:
for independent errors of variance σ² they have the variance 6 σ².
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.lens import invert, transform
from fitting.canvas import Canvas
from fitting.range_image import RangeImage
from fitting.resampling import height_variance


@dataclass(frozen=True)
class SurfaceNoise:
    """Noise of heights, mm.

    Attributes
    ----------
    observed_mm : float
        Robust standard deviation from second differences.
    predicted_mm : float
        What the variances carried along say about the same differences.
    samples : int
        Number of differences.
    """

    observed_mm: float
    predicted_mm: float
    samples: int


def measure_surface_noise(range_image: RangeImage, canvas: Canvas) -> SurfaceNoise:
    """White noise of the heights of a range image over its canvas, along the picture's rows.

    Taken before resampling, where the errors of neighbours are independent.
    """
    mask = canvas.mask
    heights = np.full(mask.shape, np.nan)
    heights[mask] = transform(invert(canvas.rt_cam_canvas), range_image.points[mask])[:, 2]
    variance = np.where(mask, height_variance(range_image, canvas), np.nan)
    return second_difference_noise(heights, variance)


def second_difference_noise(
    heights: NDArray[np.float64], variance: NDArray[np.float64]
) -> SurfaceNoise:
    """Noise by second differences along rows of heights (rows, cols), NaN where not measured."""
    second = (heights[:, 2:] - 2 * heights[:, 1:-1] + heights[:, :-2]) / np.sqrt(6)
    expected = (variance[:, 2:] + 4 * variance[:, 1:-1] + variance[:, :-2]) / 6
    there = np.isfinite(second)
    second, expected = second[there], expected[there]
    if not len(second):
        return SurfaceNoise(float("nan"), float("nan"), 0)
    spread = 1.4826 * np.median(np.abs(second - np.median(second)))
    return SurfaceNoise(float(spread), float(np.sqrt(np.median(expected))), len(second))
