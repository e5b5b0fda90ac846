"""Compiled ray casting on a height field through a pyramid of its minima and maxima.

The surface is the bilinear patch between four grid points. A node of the pyramid knows the lowest
and the highest point of a square of 2^L × 2^L patches: a ray above the highest passes it in one
step, a ray below the lowest has met the surface, and only what is between descends ("maximum
mipmaps": Tevs, Ihrke, Seidel, I3D 2008). In one patch the ray's height over the surface is a
quadratic of the way along it.

The local horizon of a point bounds the slope at which anything can stand before it, in sixteen
directions: from all nodes around it, nearer ones finer, as in a multipole scheme (Greengard and
Rokhlin 1987). A source above that bound is seen without a ray.

Positions are (column, row, height), heights and slopes in units of the grid's spacing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

SECTORS = 16
# What a ray found.
ABOVE_HORIZON = 0
CLEAR = 1
BLOCKED = 2
_EDGES = np.radians([0.0, 22.5, 45.0, 67.5, 90.0])
_TANGENTS = np.tan(_EDGES[:4])
_COSINES = np.cos(_EDGES)
_SINES = np.sin(_EDGES)
_PEAK = 1.0 / math.cos(math.radians(11.25))


class Pyramid(NamedTuple):
    """A height field with the minima and maxima of squares of its patches.

    Attributes
    ----------
    height : (rows, cols) float32 array
        Over the spacing; no gaps.
    lowest, highest : (n,) float32 arrays
        All levels from single patches upwards, row by row, one after the other.
    starts : (levels,) int64 array
        Where each level begins.
    shapes : (levels, 2) int64 array
        Rows and columns of each level.
    """

    height: NDArray[np.float32]
    lowest: NDArray[np.float32]
    highest: NDArray[np.float32]
    starts: NDArray[np.int64]
    shapes: NDArray[np.int64]


@njit(inline="always")
def _first_zero(f0: float, f1: float, f2: float, end: float) -> float:
    """Smallest s in [0, end] at which f0 + f1 s + f2 s² is not positive; -1 if there is none."""
    if f0 <= 0.0:
        return 0.0
    root = f1 * f1 - 4.0 * f0 * f2
    if root < 0.0:
        return -1.0
    q = -0.5 * (f1 + math.copysign(math.sqrt(root), f1))
    first = math.inf
    if q != 0.0 and f0 / q >= 0.0:
        first = f0 / q
    if f2 != 0.0 and 0.0 <= q / f2 < first:
        first = q / f2
    return first if first <= end else -1.0


@njit(cache=True)
def _meet(pyramid, px, py, pz, dx, dy, dz, start, end):  # type: ignore[no-untyped-def]
    """Smallest t in [start, end] at which p + t d is not above the surface; -1 if there is none."""
    height, lowest, highest, starts, shapes = pyramid
    for at, step, last in ((px, dx, height.shape[1] - 1.0), (py, dy, height.shape[0] - 1.0)):
        if step == 0.0:
            if not 0.0 <= at <= last:
                return -1.0
            continue
        one = -at / step
        other = (last - at) / step
        start = max(start, min(one, other))
        end = min(end, max(one, other))
    if not start <= end:
        return -1.0
    level = 0
    top = len(starts) - 1
    t = start
    col = min(max(math.floor(px + dx * t), 0), shapes[0, 1] - 1)
    row = min(max(math.floor(py + dy * t), 0), shapes[0, 0] - 1)
    while True:
        size = float(1 << level)
        to_col = math.inf
        to_row = math.inf
        if dx != 0.0:
            to_col = ((col + (1 if dx > 0.0 else 0)) * size - px) / dx
        if dy != 0.0:
            to_row = ((row + (1 if dy > 0.0 else 0)) * size - py) / dy
        leave = min(max(min(to_col, to_row), t), end)
        z_in = pz + dz * t
        z_out = pz + dz * leave
        node = starts[level] + row * shapes[level, 1] + col
        if min(z_in, z_out) <= highest[node]:
            if z_in <= lowest[node]:
                return t
            if level > 0:
                level -= 1
                half = 0.5 * size
                col = min(max(math.floor((px + dx * t) / half), 2 * col), 2 * col + 1)
                row = min(max(math.floor((py + dy * t) / half), 2 * row), 2 * row + 1)
                col = min(col, shapes[level, 1] - 1)
                row = min(row, shapes[level, 0] - 1)
                continue
            a = float(height[row, col])
            east = height[row, col + 1] - a
            south = height[row + 1, col] - a
            twist = height[row + 1, col + 1] - a - east - south
            u = px + dx * t - col
            v = py + dy * t - row
            s = _first_zero(
                z_in - (a + east * u + south * v + twist * u * v),
                dz - (east * dx + south * dy + twist * (u * dy + v * dx)),
                -twist * dx * dy,
                leave - t + 1e-12,
            )
            if s >= 0.0:
                return t + s
        if leave >= end:
            return -1.0
        t = leave
        # Into the next node, and one level up where it is the first of a pair.
        if to_col <= to_row:
            col += 1 if dx > 0.0 else -1
            if col < 0 or col >= shapes[level, 1]:
                return -1.0
            first_of_pair = (col & 1) == (0 if dx > 0.0 else 1)
        else:
            row += 1 if dy > 0.0 else -1
            if row < 0 or row >= shapes[level, 0]:
                return -1.0
            first_of_pair = (row & 1) == (0 if dy > 0.0 else 1)
        if first_of_pair and level < top:
            level += 1
            col >>= 1
            row >>= 1


@njit(inline="always")
def _sector(dx: float, dy: float) -> int:
    """Which of the sixteen directions (dx, dy) lies in."""
    quadrant = (0 if dx >= 0.0 else 1) + (0 if dy >= 0.0 else 2)
    x = abs(dx)
    y = abs(dy)
    part = 0
    for k in range(1, 4):
        if y >= _TANGENTS[k] * x:
            part = k
    return 4 * quadrant + part


@njit(inline="always")
def _raise_horizon(horizon, above, west, east, north, south):  # type: ignore[no-untyped-def]
    """Let a rectangle around the point, ``above`` it by at most so much, raise the horizon."""
    if above <= 0.0:
        return
    for quadrant in range(4):
        near_x, far_x = (west, east) if (quadrant & 1) == 0 else (-east, -west)
        near_y, far_y = (north, south) if (quadrant & 2) == 0 else (-south, -north)
        if far_x < 0.0 or far_y < 0.0:
            continue
        near_x = max(near_x, 0.0)
        near_y = max(near_y, 0.0)
        slope = above / max(math.sqrt(near_x * near_x + near_y * near_y), 1e-9)
        for k in range(4):
            # The part of the quadrant between two tangents of y over x.
            if far_y < _TANGENTS[k] * near_x:
                continue
            if k < 3 and near_y > _TANGENTS[k + 1] * far_x:
                continue
            place = 4 * quadrant + k
            if slope > horizon[place]:
                horizon[place] = slope


@njit(inline="always")
def _touching_patch(horizon, height, row, col, x, y, z):  # type: ignore[no-untyped-def]
    """Let the patch that a point is on, or touches, raise its horizon: by its steepest slopes."""
    a = height[row, col]
    b = height[row, col + 1]
    c = height[row + 1, col]
    d = height[row + 1, col + 1]
    if _patch_height(a, b, c, d, x - col, y - row) - z > 1e-4:
        horizon[:] = math.inf  # below the surface
        return
    for quadrant in range(4):
        right = (quadrant & 1) == 0
        down = (quadrant & 2) == 0
        if (col + 1.0 <= x if right else col >= x) or (row + 1.0 <= y if down else row >= y):
            continue
        along = max(b - a, d - c) if right else -min(b - a, d - c)
        across = max(c - a, d - b) if down else -min(c - a, d - b)
        before = along
        for k in range(4):
            after = along * _COSINES[k + 1] + across * _SINES[k + 1]
            # Between two directions the slope is a cosine that peaks by no more than this.
            steepest = max(before, after)
            if steepest > 0.0:
                steepest *= _PEAK
            before = after
            if steepest > horizon[4 * quadrant + k]:
                horizon[4 * quadrant + k] = steepest


@njit(inline="always")
def _patch_height(a: float, b: float, c: float, d: float, u: float, v: float) -> float:
    u = min(max(u, 0.0), 1.0)
    v = min(max(v, 0.0), 1.0)
    return (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)


@njit(parallel=True, cache=True)
def local_horizons(pyramid: Pyramid, points: NDArray[np.float64]) -> NDArray[np.float32]:
    """Bounds (n, 16) of the slope at which the surface rises before points (n, 3) that lie on it.

    Sector 4 q + k: quadrant q (1: to the left, 2: upwards in rows, 3: both), and k-th quarter of
    it, from along the row to along the column.
    """
    height, _, highest, starts, shapes = pyramid
    horizon = np.full((len(points), SECTORS), -np.inf, np.float32)
    top = len(starts) - 1
    summit = highest[starts[top]]
    for n in prange(len(points)):
        x, y, z = points[n]
        own_row = min(max(math.floor(y), 0), shapes[0, 0] - 1)
        own_col = min(max(math.floor(x), 0), shapes[0, 1] - 1)
        mine = horizon[n]
        for row in range(max(own_row - 1, 0), min(own_row + 2, shapes[0, 0])):
            for col in range(max(own_col - 1, 0), min(own_col + 2, shapes[0, 1])):
                if row <= y <= row + 1 and col <= x <= col + 1:
                    _touching_patch(mine, height, row, col, x, y, z)
                else:
                    node = starts[0] + row * shapes[0, 1] + col
                    _raise_horizon(
                        mine, highest[node] - z, col - x, col + 1.0 - x, row - y, row + 1.0 - y
                    )
        for level in range(top):
            size = float(1 << level)
            if summit - z <= size * mine.min():
                break
            r0 = own_row >> level
            c0 = own_col >> level
            # Children of the parent's neighbours, but for the nodes that touch the point's own.
            first_row = 2 * ((r0 >> 1) - 1)
            first_col = 2 * ((c0 >> 1) - 1)
            for row in range(max(first_row, 0), min(first_row + 6, shapes[level, 0])):
                for col in range(max(first_col, 0), min(first_col + 6, shapes[level, 1])):
                    if abs(row - r0) <= 1 and abs(col - c0) <= 1:
                        continue
                    above = highest[starts[level] + row * shapes[level, 1] + col] - z
                    west = col * size - x
                    north = row * size - y
                    _raise_horizon(mine, above, west, west + size, north, north + size)
    return horizon


@njit(parallel=True, cache=True)
def cast_to_source(
    pyramid: Pyramid,
    points: NDArray[np.float64],
    source: NDArray[np.float64],
    horizon: NDArray[np.float32],
    clearance: NDArray[np.float32],
) -> NDArray[np.uint8]:
    """What stands between points (n, 3) and a source (3,): one of the module's three findings.

    Parameters
    ----------
    horizon : (n, 16) array
        From :func:`local_horizons`; (0, 16) casts a ray from every point.
    clearance : (n,) array
        By which the surface must stand above a ray to block it.
    """
    found = np.empty(len(points), np.uint8)
    for n in prange(len(points)):
        x, y, z = points[n]
        dx = source[0] - x
        dy = source[1] - y
        dz = source[2] - z
        away = math.sqrt(dx * dx + dy * dy)
        if len(horizon) > 0 and dz > horizon[n, _sector(dx, dy)] * away:
            found[n] = ABOVE_HORIZON
            continue
        start = 1e-6 / max(away, 1.0)
        t = _meet(pyramid, x, y, z + clearance[n], dx, dy, dz, start, 1.0)
        found[n] = CLEAR if t < 0.0 else BLOCKED
    return found


@njit(parallel=True, cache=True)
def cast_from_eye(
    pyramid: Pyramid, eye: NDArray[np.float64], directions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where rays (n, 3) from an eye meet the surface, as a multiple of them; NaN where they miss.

    The surface has no sides: a ray that comes in below its edge misses.
    """
    height = pyramid.height
    found = np.full(len(directions), np.nan)
    for n in prange(len(directions)):
        dx, dy, dz = directions[n]
        if not dz < 0.0:
            continue
        t = _meet(pyramid, eye[0], eye[1], eye[2], dx, dy, dz, 0.0, np.inf)
        if t < 0.0:
            continue
        x = eye[0] + t * dx
        y = eye[1] + t * dy
        col = min(max(int(x), 0), height.shape[1] - 2)
        row = min(max(int(y), 0), height.shape[0] - 2)
        surface = _patch_height(
            height[row, col],
            height[row, col + 1],
            height[row + 1, col],
            height[row + 1, col + 1],
            x - col,
            y - row,
        )
        if abs(eye[2] + t * dz - surface) < 1e-3:
            found[n] = t
    return found
