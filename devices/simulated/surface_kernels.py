"""Compiled sampling of a surface's maps: normals at points, reflectance averaged over pixels."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

# Places along either side of a pixel's footprint at which its reflectance is sampled, in pixels:
# the standard deviation of a square pixel behind a lens that blurs by a third of a pixel.
_PLACES = (-0.6, -0.2, 0.2, 0.6)


@njit(parallel=True, cache=True)
def sample_normals(
    z: NDArray[np.float32], pitch: float, points: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Unit normals (n, 3) at points (n, 3), bilinear between those of the grid.

    Slopes are central differences over two cells, one-sided at the border. Points beyond it take
    its values; those on the sides of the solid have the sides' normals.
    """
    rows, cols = z.shape
    normals = np.empty((len(points), 3), np.float32)
    for n in prange(len(points)):
        x = min(max(points[n, 0] / pitch + (cols - 1) * 0.5, 0.0), cols - 1.0)
        y = min(max((rows - 1) * 0.5 - points[n, 1] / pitch, 0.0), rows - 1.0)
        c = min(int(x), cols - 2)
        r = min(int(y), rows - 2)
        slope_x = 0.0
        slope_y = 0.0
        top = 0.0
        for j in range(r, r + 2):
            for i in range(c, c + 2):
                weight = (1 - abs(x - i)) * (1 - abs(y - j))
                top += weight * z[j, i]
                left, right = max(i - 1, 0), min(i + 1, cols - 1)
                above, below = max(j - 1, 0), min(j + 1, rows - 1)
                slope_x += weight * (float(z[j, right]) - z[j, left]) / ((right - left) * pitch)
                slope_y += weight * (float(z[above, i]) - z[below, i]) / ((below - above) * pitch)
        scale = 1 / math.sqrt(1 + slope_x * slope_x + slope_y * slope_y)
        normals[n, 0] = -slope_x * scale
        normals[n, 1] = -slope_y * scale
        normals[n, 2] = scale
        # How far beside the border; a point on a side is below the surface there.
        beside_x = min(x, cols - 1.0 - x)
        beside_y = min(y, rows - 1.0 - y)
        if min(beside_x, beside_y) < 1e-6 and points[n, 2] < top - 1e-4:
            normals[n] = 0.0
            if beside_x <= beside_y:
                normals[n, 0] = -1.0 if x < 0.5 * cols else 1.0
            else:
                normals[n, 1] = 1.0 if y < 0.5 * rows else -1.0
    return normals


@njit(parallel=True, cache=True)
def sample_finish(
    albedo: NDArray[np.uint8],
    roughness: NDArray[np.uint8],
    varnish: NDArray[np.uint8],
    metal: NDArray[np.uint8],
    pitch: float,
    points: NDArray[np.float64],
    footprints: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Albedo of red, green and blue, roughness, varnish and metal (n, 6), decoded and averaged.

    Each is the mean over a grid of places in the pixel's footprint, of bilinear values there.

    Parameters
    ----------
    albedo, roughness, varnish, metal : (rows, cols[, 3]) uint8 array
    pitch : float
    points : (n, 3) float64 array
    footprints : (n, 2, 2) float32 array
        X and Y by which the point moves from one pixel to the next along a row, and along a column;
        zero samples the point itself.
    """
    rows, cols = roughness.shape
    finish = np.empty((len(points), 6), np.float32)
    for n in prange(len(points)):
        total = np.zeros(6)
        count = 0
        moves = footprints[n]
        points_only = (
            moves[0, 0] == 0 and moves[0, 1] == 0 and moves[1, 0] == 0 and moves[1, 1] == 0
        )
        for place in range(1 if points_only else 16):
            a = _PLACES[place & 3]
            b = _PLACES[place >> 2]
            x = points[n, 0] + a * moves[0, 0] + b * moves[1, 0]
            y = points[n, 1] + a * moves[0, 1] + b * moves[1, 1]
            x = min(max(x / pitch + (cols - 1) * 0.5, 0.0), cols - 1.0)
            y = min(max((rows - 1) * 0.5 - y / pitch, 0.0), rows - 1.0)
            c = min(int(x), cols - 2)
            r = min(int(y), rows - 2)
            count += 1
            for j in range(r, r + 2):
                for i in range(c, c + 2):
                    weight = (1 - abs(x - i)) * (1 - abs(y - j))
                    for k in range(3):
                        code = albedo[j, i, k] / 255.0
                        total[k] += weight * code * code
                    total[3] += weight * roughness[j, i] / 255.0
                    total[4] += weight * varnish[j, i] / 255.0
                    total[5] += weight * metal[j, i] / 255.0
        for k in range(6):
            finish[n, k] = total[k] / count
    return finish
