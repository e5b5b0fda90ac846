"""Compiled projection through OpenCV's family of lens models.

With x, y the point over its depth and r² = x² + y², the model is

    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
         + 2 p1 x y + p2 (r² + 2 x²) + s1 r² + s2 r⁴

and likewise y' with p1 and p2 exchanged and s3, s4; pixels are f x' + c. The smaller models are
this one with zeros, so all of them go through one kernel. A lens is an array of sixteen numbers:
f_x, f_y, c_x, c_y, k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4. The formulas are those of
OpenCV's documentation of ``calib3d``; the tests hold the kernels against mrcal.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

PARAMETERS = 16
_NEWTON_STEPS = 30


@njit(inline="always")
def distort(
    lens: NDArray[np.float64], x: float, y: float
) -> tuple[float, float, float, float, float, float]:
    """Pixel of a direction (x, y, 1), and du/dx, du/dy, dv/dx, dv/dy."""
    r2 = x * x + y * y
    up = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    up_slope = lens[4] + r2 * (2.0 * lens[5] + r2 * 3.0 * lens[8])
    down = 1.0 + r2 * (lens[9] + r2 * (lens[10] + r2 * lens[11]))
    down_slope = lens[9] + r2 * (2.0 * lens[10] + r2 * 3.0 * lens[11])
    inverse = 1.0 / down
    radial = up * inverse
    # By r²; the chain rule's 2x and 2y follow.
    radial_slope = (up_slope - radial * down_slope) * inverse
    p1 = lens[6]
    p2 = lens[7]
    thin_x = lens[12] + 2.0 * lens[13] * r2
    thin_y = lens[14] + 2.0 * lens[15] * r2
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    xd += r2 * (lens[12] + r2 * lens[13])
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    yd += r2 * (lens[14] + r2 * lens[15])
    xx = radial + 2.0 * x * x * radial_slope + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * x * thin_x
    xy = 2.0 * x * y * radial_slope + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * y * thin_x
    yx = 2.0 * x * y * radial_slope + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * x * thin_y
    yy = radial + 2.0 * y * y * radial_slope + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * y * thin_y
    return (
        lens[0] * xd + lens[2],
        lens[1] * yd + lens[3],
        lens[0] * xx,
        lens[0] * xy,
        lens[1] * yx,
        lens[1] * yy,
    )


@njit(parallel=True, cache=True, error_model="numpy")
def project_points(
    lens: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (n, 2) of points (n, 3), and their derivatives (n, 2, 3) by the point."""
    pixels = np.empty((len(points), 2))
    gradient = np.empty((len(points), 2, 3))
    for n in prange(len(points)):
        inverse = 1.0 / points[n, 2]
        x = points[n, 0] * inverse
        y = points[n, 1] * inverse
        u, v, ux, uy, vx, vy = distort(lens, x, y)
        pixels[n, 0] = u
        pixels[n, 1] = v
        gradient[n, 0, 0] = ux * inverse
        gradient[n, 0, 1] = uy * inverse
        gradient[n, 0, 2] = -(ux * x + uy * y) * inverse
        gradient[n, 1, 0] = vx * inverse
        gradient[n, 1, 1] = vy * inverse
        gradient[n, 1, 2] = -(vx * x + vy * y) * inverse
    return pixels, gradient


@njit(inline="always")
def undistort(
    lens: NDArray[np.float64], u: float, v: float, x: float, y: float
) -> tuple[float, float]:
    """Direction (x, y, 1) of a pixel by Newton's method from a first guess.

    NaN where the model has no inverse.
    """
    for _ in range(_NEWTON_STEPS):
        up, vp, ux, uy, vx, vy = distort(lens, x, y)
        determinant = ux * vy - uy * vx
        # Beyond the fold of the distortion more than one direction lands on a pixel.
        if not determinant > 0.0:
            return math.nan, math.nan
        du = u - up
        dv = v - vp
        dx = (vy * du - uy * dv) / determinant
        dy = (ux * dv - vx * du) / determinant
        x += dx
        y += dy
        if dx * dx + dy * dy <= 1e-12 * (1e-4 + x * x + y * y):
            # The next step would be of the order of this one's square.
            return x, y
    return math.nan, math.nan


@njit(parallel=True, cache=True, error_model="numpy")
def unproject_pixels(lens: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions (n, 2), x/z and y/z, of pixels (n, 2)."""
    slopes = np.empty((len(pixels), 2))
    for n in prange(len(pixels)):
        u = pixels[n, 0]
        v = pixels[n, 1]
        x, y = undistort(lens, u, v, (u - lens[2]) / lens[0], (v - lens[3]) / lens[1])
        slopes[n, 0] = x
        slopes[n, 1] = y
    return slopes


@njit(parallel=True, cache=True, error_model="numpy")
def unproject_grid(
    lens: NDArray[np.float64], column: int, row: int, columns: int, rows: int
) -> NDArray[np.float64]:
    """Directions (rows, columns, 2) of every pixel of a crop that begins at (column, row)."""
    slopes = np.empty((rows, columns, 2))
    for i in prange(rows):
        v = float(row + i)
        x = math.nan
        y = math.nan
        for j in range(columns):
            u = float(column + j)
            if math.isnan(x):
                x = (u - lens[2]) / lens[0]
                y = (v - lens[3]) / lens[1]
            # The neighbour's direction is the better first guess.
            x, y = undistort(lens, u, v, x, y)
            slopes[i, j, 0] = x
            slopes[i, j, 1] = y
    return slopes
