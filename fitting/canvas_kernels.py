"""Compiled loops of the canvas extraction; each has a plain reference in the tests."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

# How many times the steepest slope a surface may be inclined to the viewing ray.
_EDGE_ON = 1.5


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


@njit(cache=True)
def _across(
    points: NDArray[np.float64],
    valid: NDArray[np.bool_],
    pixel: tuple[np.int64, np.int64],
    step: tuple[int, int],
) -> tuple[float, float, float]:
    """Point at plus minus point at minus a step; twice one side's where the other is missing."""
    rows, cols = valid.shape
    i, j = pixel
    i1, j1, i0, j0 = i + step[0], j + step[1], i - step[0], j - step[1]
    scale = 1.0
    if not (0 <= i1 < rows and 0 <= j1 < cols and valid[i1, j1]):
        i1, j1 = i, j
        scale = 2.0
    if not (0 <= i0 < rows and 0 <= j0 < cols and valid[i0, j0]):
        i0, j0 = i, j
        scale = 2.0
    return (
        scale * (points[i1, j1, 0] - points[i0, j0, 0]),
        scale * (points[i1, j1, 1] - points[i0, j0, 1]),
        scale * (points[i1, j1, 2] - points[i0, j0, 2]),
    )


@njit(cache=True)
def _sobel(
    straight: tuple[float, float, float],
    falling: tuple[float, float, float],
    rising: tuple[float, float, float],
    sign: float,
) -> tuple[float, float, float]:
    return (
        2.0 * straight[0] + falling[0] + sign * rising[0],
        2.0 * straight[1] + falling[1] + sign * rising[1],
        2.0 * straight[2] + falling[2] + sign * rising[2],
    )


@njit(parallel=True, cache=True)
def find_smooth(
    points: NDArray[np.float64],
    variance: NDArray[np.float32],
    valid: NDArray[np.bool_],
    normal: NDArray[np.float64],
    spacing: float,
    maximum_slope: float,
    sigmas: float,
) -> NDArray[np.bool_]:
    """Valid pixels whose surface is no steeper against a plane than a limit plus the noise.

    The surface's normal is the cross product of Sobel's operator on the points along rows and
    columns, so that a wall that the camera sees aslant is as steep as it is, however many pixels
    it covers. A surface all but along the viewing ray is none: there one hides another. Where
    noise alone reaches the limit nothing is known of the slope, and the pixel is not smooth.
    ``normal`` of the plane faces the camera; ``spacing`` is that of the points.
    """
    rows, cols = valid.shape
    smooth = np.zeros((rows, cols), np.bool_)
    # Sobel's weights sum to 8 spacings, and to a variance of 12.
    noise_share = sigmas * math.sqrt(12.0) / (8.0 * spacing)
    for i in prange(rows):
        for j in range(cols):
            if not valid[i, j]:
                continue
            noise = noise_share * math.sqrt(variance[i, j])
            if not noise < maximum_slope:
                continue
            # A parallel index is unsigned, and unsigned minus signed would be a float.
            at = (np.int64(i), np.int64(j))
            falling = _across(points, valid, at, (1, 1))
            rising = _across(points, valid, at, (1, -1))
            x = _sobel(_across(points, valid, at, (0, 1)), falling, rising, -1.0)
            y = _sobel(_across(points, valid, at, (1, 0)), falling, rising, 1.0)
            n0 = x[1] * y[2] - x[2] * y[1]
            n1 = x[2] * y[0] - x[0] * y[2]
            n2 = x[0] * y[1] - x[1] * y[0]
            # Columns run right and rows down: the product points away from the camera.
            facing = -(n0 * normal[0] + n1 * normal[1] + n2 * normal[2])
            square = n0 * n0 + n1 * n1 + n2 * n2
            limit = (maximum_slope + noise) * facing
            p = points[i, j]
            towards = n0 * p[0] + n1 * p[1] + n2 * p[2]
            towards /= math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
            edge_on = (_EDGE_ON * maximum_slope + noise) * towards
            smooth[i, j] = (
                facing > 0.0
                and square - facing * facing < limit * limit
                and towards > 0.0
                and square - towards * towards < edge_on * edge_on
            )
    return smooth
