"""Compiled loops of the canvas extraction; each has a plain reference in the tests."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


@njit(parallel=True, cache=True)
def heights_above_plane(
    points: NDArray[np.float64],
    valid: NDArray[np.bool_],
    centre: NDArray[np.float64],
    normal: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Distance of points (rows, cols, 3) from a plane along its unit normal; 0 where not valid."""
    rows, cols = valid.shape
    height = np.zeros((rows, cols), np.float32)
    for i in prange(rows):
        for j in range(cols):
            if valid[i, j]:
                height[i, j] = (
                    normal[0] * (points[i, j, 0] - centre[0])
                    + normal[1] * (points[i, j, 1] - centre[1])
                    + normal[2] * (points[i, j, 2] - centre[2])
                )
    return height


@njit(inline="always")
def _across(
    height: NDArray[np.float32], valid: NDArray[np.bool_], i: int, j: int, di: int, dj: int
) -> float:
    """Difference of the heights at plus and minus a step; twice one side's where one is missing."""
    rows, cols = valid.shape
    here = height[i, j]
    ahead = 0 <= i + di < rows and 0 <= j + dj < cols and valid[i + di, j + dj]
    behind = 0 <= i - di < rows and 0 <= j - dj < cols and valid[i - di, j - dj]
    if ahead and behind:
        return height[i + di, j + dj] - height[i - di, j - dj]
    if ahead:
        return 2.0 * (height[i + di, j + dj] - here)
    if behind:
        return 2.0 * (here - height[i - di, j - dj])
    return 0.0


@njit(parallel=True, cache=True)
def find_smooth(
    height: NDArray[np.float32],
    variance: NDArray[np.float32],
    valid: NDArray[np.bool_],
    spacing_x: float,
    spacing_y: float,
    maximum_slope: float,
    sigmas: float,
) -> NDArray[np.bool_]:
    """Valid pixels whose Sobel slope is no steeper than a limit plus its own noise.

    Where noise alone reaches the limit nothing is known of the slope, and the pixel is not smooth.
    ``variance`` is that of the height, ``spacing_x`` and ``spacing_y`` those of the columns' and
    rows' points on the plane.
    """
    rows, cols = valid.shape
    smooth = np.zeros((rows, cols), np.bool_)
    # Sobel's weights sum to 8 spacings, and to a variance of 12.
    per_x = 1.0 / (8.0 * spacing_x)
    per_y = 1.0 / (8.0 * spacing_y)
    noise_share = sigmas * math.sqrt(12.0) * max(per_x, per_y)
    for i in prange(rows):
        for j in range(cols):
            if not valid[i, j]:
                continue
            noise = noise_share * math.sqrt(variance[i, j])
            if not noise < maximum_slope:
                continue
            falling = _across(height, valid, i, j, 1, 1)
            rising = _across(height, valid, i, j, 1, -1)
            x = 2.0 * _across(height, valid, i, j, 0, 1) + falling - rising
            y = 2.0 * _across(height, valid, i, j, 1, 0) + falling + rising
            smooth[i, j] = math.hypot(x * per_x, y * per_y) < maximum_slope + noise
    return smooth
