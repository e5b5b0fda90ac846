"""Compiled loops over the neighbourhoods of range images and height fields.

Each has a plain NumPy reference in ``tests/fitting``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


@njit(cache=True)
def accumulate_local_planes(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    variance: NDArray[np.float64],
    radius_x: float,
    radius_y: float,
    wanted: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32], NDArray[np.int32]]:
    """Sums for a weighted plane through the samples around every wanted texel.

    ``x`` and ``y`` are in texels (column and row of the grid), the weight is the inverse variance
    under a tent of the given half-widths. Returns the moments (rows, cols, 9) of weight: 1, x, y,
    xx, xy, yy, z, xz, yz; the moments (rows, cols, 6) of squared weight times variance: 1, x, y,
    xx, xy, yy; the distance to the nearest sample in units of the half-widths; and the number of
    samples.
    """
    rows, cols = wanted.shape
    moments = np.zeros((rows, cols, 9))
    noise = np.zeros((rows, cols, 6))
    nearest = np.full((rows, cols), np.inf, np.float32)
    count = np.zeros((rows, cols), np.int32)
    for n in range(len(x)):
        first_row = max(0, math.ceil(y[n] - radius_y))
        last_row = min(rows - 1, math.floor(y[n] + radius_y))
        first_col = max(0, math.ceil(x[n] - radius_x))
        last_col = min(cols - 1, math.floor(x[n] + radius_x))
        for row in range(first_row, last_row + 1):
            dy = y[n] - row
            tent_y = 1.0 - abs(dy) / radius_y
            for col in range(first_col, last_col + 1):
                if not wanted[row, col]:
                    continue
                dx = x[n] - col
                tent = tent_y * (1.0 - abs(dx) / radius_x)
                if tent <= 0.0:
                    continue
                weight = tent / variance[n]
                count[row, col] += 1
                reach = max(abs(dx) / radius_x, abs(dy) / radius_y)
                if reach < nearest[row, col]:
                    nearest[row, col] = reach
                m = moments[row, col]
                m[0] += weight
                m[1] += weight * dx
                m[2] += weight * dy
                m[3] += weight * dx * dx
                m[4] += weight * dx * dy
                m[5] += weight * dy * dy
                m[6] += weight * z[n]
                m[7] += weight * dx * z[n]
                m[8] += weight * dy * z[n]
                squared = weight * tent
                v = noise[row, col]
                v[0] += squared
                v[1] += squared * dx
                v[2] += squared * dy
                v[3] += squared * dx * dx
                v[4] += squared * dx * dy
                v[5] += squared * dy * dy
    return moments, noise, nearest, count


@njit(parallel=True, cache=True)
def triangle_normals(
    height: NDArray[np.float32],
    mask: NDArray[np.bool_],
    variance: NDArray[np.float32],
    pitch: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Normals from the up to eight triangles between a texel and its ring of neighbours.

    Returns n_x, n_y (rows, cols, 2) and the standard error of the slope (rows, cols), which takes
    the heights for independent. A texel without a whole triangle gets the canvas normal and an
    infinite error.
    """
    rows, cols = height.shape
    normal = np.zeros((rows, cols, 2), np.float32)
    sigma = np.zeros((rows, cols), np.float32)
    ring_row = np.array([0, -1, -1, -1, 0, 1, 1, 1])
    ring_col = np.array([1, 1, 0, -1, -1, -1, 0, 1])
    for row in prange(rows):
        there = np.zeros(8, np.bool_)
        dz = np.zeros(8)
        by_x = np.zeros(8)
        by_y = np.zeros(8)
        for col in range(cols):
            if not mask[row, col]:
                continue
            for k in range(8):
                i = row + ring_row[k]
                j = col + ring_col[k]
                there[k] = 0 <= i < rows and 0 <= j < cols and mask[i, j]
                dz[k] = height[i, j] - height[row, col] if there[k] else 0.0
                by_x[k] = 0.0
                by_y[k] = 0.0
            nx = 0.0
            ny = 0.0
            nz = 0.0
            for k in range(8):
                m = (k + 1) % 8
                if not (there[k] and there[m]):
                    continue
                # Cross product of the two edges; the ring runs counter-clockwise seen from +Z.
                xk = ring_col[k] * pitch
                yk = -ring_row[k] * pitch
                xm = ring_col[m] * pitch
                ym = -ring_row[m] * pitch
                nx += yk * dz[m] - dz[k] * ym
                ny += dz[k] * xm - xk * dz[m]
                nz += xk * ym - yk * xm
                by_x[m] += yk
                by_x[k] -= ym
                by_y[k] += xm
                by_y[m] -= xk
            if nz == 0.0:
                sigma[row, col] = np.inf
                continue
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            normal[row, col, 0] = nx / length
            normal[row, col, 1] = ny / length
            centre_x = 0.0
            centre_y = 0.0
            var_x = 0.0
            var_y = 0.0
            for k in range(8):
                if there[k]:
                    v = variance[row + ring_row[k], col + ring_col[k]]
                    var_x += by_x[k] * by_x[k] * v
                    var_y += by_y[k] * by_y[k] * v
                    centre_x -= by_x[k]
                    centre_y -= by_y[k]
            var_x += centre_x * centre_x * variance[row, col]
            var_y += centre_y * centre_y * variance[row, col]
            sigma[row, col] = math.sqrt(0.5 * (var_x + var_y)) / nz
    return normal, sigma
