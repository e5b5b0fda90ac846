"""Compiled triangulation: depth along viewing rays from projector coordinates.

The mathematics is that of :mod:`fitting.range_image`; its reference in the tests goes through
mrcal and plain NumPy.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from calibration.lens_kernels import distort

_ITERATIONS = 12
_CONVERGED = 1e-9
# The nearest first: on a smooth surface few of the neighbours are asked.
_RING = np.array(
    sorted(
        ((i, j) for i in range(-2, 3) for j in range(-2, 3) if (i, j) != (0, 0)),
        key=lambda step: math.hypot(*step),
    )
)
_DISTANCE = np.hypot(_RING[:, 0], _RING[:, 1])


@njit(inline="always")
def cubic(coefficients: NDArray[np.float64], x: float, y: float) -> float:
    """A cubic in x and y; ten coefficients ordered 1, y, y², y³, x, xy, xy², x², x²y, x³."""
    c = coefficients
    by_y = c[0] + y * (c[1] + y * (c[2] + y * c[3]))
    by_xy = c[4] + y * (c[5] + y * c[6])
    by_xxy = c[7] + y * c[8]
    return by_y + x * (by_xy + x * (by_xxy + x * c[9]))


@njit(parallel=True, cache=True, error_model="numpy")
def solve_depths(
    lens: NDArray[np.float64],
    rotation: NDArray[np.float64],
    shift: NDArray[np.float64],
    slopes: NDArray[np.float64],
    column: NDArray[np.float64],
    row: NDArray[np.float64],
    column_variance: NDArray[np.float32],
    row_variance: NDArray[np.float32],
    correction: NDArray[np.float64],
    across: int,
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Depth of n pixels, its variance, and the distance left on the panel in pixels.

    ``lens`` and the pose are the projector's; ``slopes`` (n, 2) are the viewing rays; an axis that
    was not decoded has empty arrays. To the coordinate number ``across`` (0 column, 1 row) the
    cubic ``correction`` of the ray is added. NaN depth where the iteration does not settle in
    front of both devices, or a coordinate is not finite.
    """
    count = len(slopes)
    depth = np.full(count, np.nan)
    variance = np.full(count, np.inf, np.float32)
    misfit = np.full(count, np.inf, np.float32)
    with_column = len(column) > 0
    with_row = len(row) > 0
    for n in prange(count):
        x = slopes[n, 0]
        y = slopes[n, 1]
        u = column[n] if with_column else 0.0
        v = row[n] if with_row else 0.0
        if not (math.isfinite(u) and math.isfinite(v) and math.isfinite(x)):
            continue
        if across == 0:
            u += cubic(correction, x, y)
        elif across == 1:
            v += cubic(correction, x, y)
        wu = 1.0 / column_variance[n] if with_column else 0.0
        wv = 1.0 / row_variance[n] if with_row else 0.0
        # Only the ratio matters until the end, and is safe at any unit.
        scale = max(wu, wv)
        wu /= scale
        wv /= scale
        tx = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]
        ty = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]
        tz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]
        # Without distortion x_proj = slope * z_proj is linear in the depth: the first guess.
        su = (u - lens[2]) / lens[0]
        sv = (v - lens[3]) / lens[1]
        au = tx - su * tz
        av = ty - sv * tz
        z = -(wu * au * (shift[0] - su * shift[2]) + wv * av * (shift[1] - sv * shift[2]))
        z /= wu * au * au + wv * av * av
        information = 0.0
        du = 0.0
        dv = 0.0
        settled = False
        for _ in range(_ITERATIONS):
            pz = z * tz + shift[2]
            if not (z > 0.0 and pz > 0.0):
                break
            inverse = 1.0 / pz
            px = (z * tx + shift[0]) * inverse
            py = (z * ty + shift[1]) * inverse
            up, vp, ux, uy, vx, vy = distort(lens, px, py)
            # Direction (px, py) moves by this per unit of depth.
            mx = (tx - px * tz) * inverse
            my = (ty - py * tz) * inverse
            u_slope = ux * mx + uy * my
            v_slope = vx * mx + vy * my
            du = u - up
            dv = v - vp
            information = wu * u_slope * u_slope + wv * v_slope * v_slope
            step = (wu * u_slope * du + wv * v_slope * dv) / information
            z += step
            if abs(step) <= _CONVERGED * z:
                settled = True
                # The remainder moved with the last step, to first order.
                du -= u_slope * step
                dv -= v_slope * step
                break
        if not settled:
            continue
        depth[n] = z
        variance[n] = 1.0 / (information * scale)
        off = (du * du if with_column else 0.0) + (dv * dv if with_row else 0.0)
        misfit[n] = math.sqrt(off)
    return depth, variance, misfit


@njit(parallel=True, cache=True)
def find_supported(
    depth: NDArray[np.float64],
    variance: NDArray[np.float32],
    valid: NDArray[np.bool_],
    slope_per_px: float,
    sigmas: float,
    least_share: float,
) -> NDArray[np.bool_]:
    """Valid pixels of which a share of the 5 × 5 neighbourhood may lie on the same surface.

    Two pixels agree if their depths differ by less than ``slope_per_px * depth`` per pixel of
    distance plus ``sigmas`` standard deviations. Invalid neighbours count as not agreeing, beyond
    the picture's edge as not there.
    """
    rows, cols = depth.shape
    supported = np.zeros((rows, cols), np.bool_)
    squared = sigmas * sigmas
    for i in prange(rows):
        for j in range(cols):
            if not valid[i, j]:
                continue
            here = depth[i, j]
            near = 24
            if i < 2 or j < 2 or i >= rows - 2 or j >= cols - 2:
                down = min(rows, i + 3) - max(0, i - 2)
                right = min(cols, j + 3) - max(0, j - 2)
                near = down * right - 1
            needed = least_share * near
            agree = 0
            for k in range(24):
                m = i + _RING[k, 0]
                n = j + _RING[k, 1]
                if m < 0 or n < 0 or m >= rows or n >= cols or not valid[m, n]:
                    continue
                over = abs(depth[m, n] - here) - slope_per_px * here * _DISTANCE[k]
                if over < 0.0 or over * over < squared * (variance[i, j] + variance[m, n]):
                    agree += 1
                    if agree >= needed:
                        break
            supported[i, j] = agree >= needed
    return supported


@njit(parallel=True, cache=True)
def place_points(
    slopes: NDArray[np.float64], depth: NDArray[np.float64], valid: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Points (rows, cols, 3) at their depth along the rays; NaN where not valid."""
    rows, cols = depth.shape
    points = np.empty((rows, cols, 3))
    for i in prange(rows):
        for j in range(cols):
            z = depth[i, j] if valid[i, j] else math.nan
            points[i, j, 0] = slopes[i, j, 0] * z
            points[i, j, 1] = slopes[i, j, 1] * z
            points[i, j, 2] = z
    return points
