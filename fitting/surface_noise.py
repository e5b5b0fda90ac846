"""White noise of a measured surface, observed and predicted.

Second differences along a row remove whatever is smooth over three pixels and keep the noise:
for independent errors of variance σ² they have the variance 6 σ².
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import robust_spread
from fitting.canvas import Canvas
from fitting.height_field import CORRELATION_REACH
from fitting.range_image import RangeImage
from fitting.resampling import canvas_samples

_SAMPLES = 300_000


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
    rows = np.flatnonzero(canvas.mask.any(axis=1))
    # A median over some hundred thousand differences is known to half a per cent.
    rows = rows[:: max(1, int(canvas.mask.sum()) // _SAMPLES)]
    thin = replace(
        range_image,
        points=range_image.points[rows],
        depth_variance=range_image.depth_variance[rows],
        rejection=range_image.rejection[rows],
    )
    _, heights, variance = canvas_samples(thin, replace(canvas, mask=canvas.mask[rows]))
    return second_difference_noise(heights, variance)


def second_difference_noise(
    heights: NDArray[np.floating], variance: NDArray[np.floating]
) -> SurfaceNoise:
    """Noise by second differences along rows of heights (rows, cols), NaN where not measured."""
    second = (heights[:, 2:] - 2 * heights[:, 1:-1] + heights[:, :-2]) / np.sqrt(6)
    expected = (variance[:, 2:] + 4 * variance[:, 1:-1] + variance[:, :-2]) / 6
    there = np.isfinite(second)
    second, expected = second[there], expected[there]
    if not len(second):
        return SurfaceNoise(float("nan"), float("nan"), 0)
    return SurfaceNoise(robust_spread(second), float(np.sqrt(np.median(expected))), len(second))


def slope_error_ratio(correlation: NDArray[np.float64]) -> float:
    """Standard error of a triangle normal's slope over what independent heights would give it.

    The eight triangles around a texel weigh its neighbours as Sobel's operator does.

    Parameters
    ----------
    correlation : (7, 7) array
        Of the errors of neighbours; see :class:`~fitting.height_field.HeightField`.
    """
    sobel = np.outer([1.0, 2, 1], [-1.0, 0, 1])
    ratios = []
    for weights in (sobel, sobel.T):
        offsets = np.argwhere(weights)
        values = weights[tuple(offsets.T)]
        step = offsets[:, np.newaxis] - offsets + CORRELATION_REACH
        ratios.append(values @ correlation[step[..., 0], step[..., 1]] @ values / (values @ values))
    return float(np.sqrt(max(np.mean(ratios), 0.0)))
