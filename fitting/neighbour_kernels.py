"""Compiled loops over the neighbourhoods of range images and height fields.

Each has a plain NumPy reference in ``tests/fitting``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


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
