"""Compiled ray casting on a height map through a pyramid of maxima.

A node of the pyramid holds the highest point of a square of cells; a ray that stays above it
passes the square in one step ("maximum mipmaps": Tevs, Ihrke, Seidel, I3D 2008). In a single cell
the surface is the bilinear patch between its four corners, which a ray meets where a quadratic
vanishes. Everything is in the grid's own frame: X right, Y up, Z towards the viewer, origin at its
centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


@dataclass(frozen=True)
class MaximumPyramid:
    """Maxima of squares of cells, level by level.

    Attributes
    ----------
    maxima : (n,) float32 array
        All levels from 2 × 2 cells upwards, row by row, one after the other.
    starts : (levels,) int64 array
        Where each level begins in ``maxima``.
    shapes : (levels, 2) int64 array
        Rows and columns of each level; the first is that of the cells themselves, which are not
        stored.
    """

    maxima: NDArray[np.float32]
    starts: NDArray[np.int64]
    shapes: NDArray[np.int64]

    @classmethod
    def of(cls, height: NDArray[np.float32]) -> MaximumPyramid:
        """Build the pyramid of a height map (rows, cols)."""
        shapes = [(height.shape[0] - 1, height.shape[1] - 1)]
        # A cell reaches to the vertices on its far side.
        top = np.maximum(height[:-1], height[1:])
        level = np.maximum(top[:, :-1], top[:, 1:])
        levels = []
        while max(level.shape) > 1:
            odd = level.shape[0] % 2, level.shape[1] % 2
            if any(odd):
                level = np.pad(level, ((0, odd[0]), (0, odd[1])), mode="edge")
            pairs = np.maximum(level[::2], level[1::2])
            level = np.maximum(pairs[:, ::2], pairs[:, 1::2])
            levels.append(level.ravel())
            shapes.append((level.shape[0], level.shape[1]))
        sizes = [0, 0, *(len(one) for one in levels)]
        flat = np.concatenate(levels) if levels else np.zeros(0)
        return cls(flat.astype(np.float32), np.cumsum(sizes[:-1]), np.array(shapes, np.int64))


@njit(inline="always")
def _clip_to(start: float, end: float, at: float, slope: float, low: float, high: float):  # type: ignore[no-untyped-def]
    """The part of a ray's [start, end] on which ``at + t slope`` lies between low and high."""
    if slope == 0:
        return (start, end) if low <= at <= high else (1.0, 0.0)
    one = (low - at) / slope
    other = (high - at) / slope
    return max(start, min(one, other)), min(end, max(one, other))


@njit(inline="always")
def _meet_patch(f0: float, f1: float, f2: float, reach: float) -> float:
    """Smallest s from 0 to ``reach`` with f0 + f1 s + f2 s² ≤ 0; -1 if there is none."""
    if f0 <= 0:
        return 0.0
    discriminant = f1 * f1 - 4 * f2 * f0
    if discriminant < 0:
        return -1.0
    q = -0.5 * (f1 + math.copysign(math.sqrt(discriminant), f1))
    best = -1.0
    slack = reach * (1 + 1e-9) + 1e-12
    if q != 0:
        s = f0 / q
        if 0 <= s <= slack:
            best = s
    if f2 != 0:
        s = q / f2
        if 0 <= s <= slack and (best < 0 or s < best):
            best = s
    return best


@njit(cache=True)
def _first_hit(z, maxima, starts, shapes, x, y, h, dx, dy, dh, start, end, margin):  # type: ignore[no-untyped-def]
    """Smallest t in [start, end] at which the ray is not ``margin`` below the surface; -1 if none.

    ``x, y`` are the column and row of the ray's origin, ``h`` its height, ``dx, dy, dh`` their
    change with t. With a positive margin the ray may touch the surface without being stopped.
    """
    start, end = _clip_to(start, end, x, dx, 0.0, z.shape[1] - 1.0)
    start, end = _clip_to(start, end, y, dy, 0.0, z.shape[0] - 1.0)
    if start > end:
        return -1.0
    top = len(starts) - 1
    level = min(3, top)
    size = 1 << level
    i = min(max(math.floor((x + dx * start) / size), 0), shapes[level, 1] - 1)
    j = min(max(math.floor((y + dy * start) / size), 0), shapes[level, 0] - 1)
    t = start
    while True:
        size = 1 << level
        tx = math.inf
        ty = math.inf
        if dx > 0:
            tx = ((i + 1) * size - x) / dx
        elif dx < 0:
            tx = (i * size - x) / dx
        if dy > 0:
            ty = ((j + 1) * size - y) / dy
        elif dy < 0:
            ty = (j * size - y) / dy
        leave = max(t, min(tx, ty, end))
        lowest = h + dh * (leave if dh < 0 else t) + margin
        if level > 0:
            if lowest <= maxima[starts[level] + j * shapes[level, 1] + i]:
                level -= 1
                half = size >> 1
                i = min(max(math.floor((x + dx * t) / half), 2 * i), 2 * i + 1)
                j = min(max(math.floor((y + dy * t) / half), 2 * j), 2 * j + 1)
                i = min(i, shapes[level, 1] - 1)
                j = min(j, shapes[level, 0] - 1)
                continue
        else:
            a = z[j, i]
            b = z[j, i + 1]
            c = z[j + 1, i]
            d = z[j + 1, i + 1]
            if lowest <= max(max(a, b), max(c, d)):
                u = x + dx * t - i
                v = y + dy * t - j
                along = float(b) - a
                down = float(c) - a
                twist = float(d) - c - along
                f0 = h + dh * t + margin - (a + along * u + down * v + twist * u * v)
                f1 = dh - (along * dx + down * dy + twist * (u * dy + v * dx))
                s = _meet_patch(f0, f1, -twist * dx * dy, leave - t)
                if s >= 0:
                    return t + s
        if leave >= end:
            return -1.0
        t = leave
        if tx <= ty:
            i += 1 if dx > 0 else -1
            over = (i & 1) == (0 if dx > 0 else 1)
        else:
            j += 1 if dy > 0 else -1
            over = (j & 1) == (0 if dy > 0 else 1)
        if i < 0 or j < 0 or i >= shapes[level, 1] or j >= shapes[level, 0]:
            return -1.0
        if over and level < top:
            level += 1
            i >>= 1
            j >>= 1


@njit(parallel=True, cache=True)
def cast_rays(
    z: NDArray[np.float32],
    maxima: NDArray[np.float32],
    starts: NDArray[np.int64],
    shapes: NDArray[np.int64],
    pitch: float,
    back: float,
    high: float,
    origin: NDArray[np.float64],
    directions: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Distance along each ray (n, 3) from ``origin`` to the surface; NaN where it misses.

    The surface is solid between its height and ``back``; nothing of it is above ``high``. It is
    seen from the front only: rays that do not come down miss.
    """
    rows, cols = z.shape
    found = np.full(len(directions), np.nan)
    x = origin[0] / pitch + (cols - 1) * 0.5
    y = (rows - 1) * 0.5 - origin[1] / pitch
    for n in prange(len(directions)):
        dh = directions[n, 2]
        if dh >= 0:
            continue
        start, end = _clip_to(0.0, np.inf, origin[2], dh, back, high)
        t = _first_hit(
            *(z, maxima, starts, shapes, x, y, origin[2]),
            *(directions[n, 0] / pitch, -directions[n, 1] / pitch, dh),
            *(start, end, 0.0),
        )
        if t >= 0:
            found[n] = t
    return found


@njit(parallel=True, cache=True)
def cast_shadows(
    z: NDArray[np.float32],
    maxima: NDArray[np.float32],
    starts: NDArray[np.int64],
    shapes: NDArray[np.int64],
    pitch: float,
    back: float,
    high: float,
    points: NDArray[np.float64],
    light: NDArray[np.float64],
    margin: float,
) -> NDArray[np.bool_]:
    """Whether the surface stands, by more than ``margin``, between points (n, 3) and ``light``."""
    rows, cols = z.shape
    hidden = np.zeros(len(points), np.bool_)
    for n in prange(len(points)):
        dx = (light[0] - points[n, 0]) / pitch
        dy = (points[n, 1] - light[1]) / pitch
        dh = light[2] - points[n, 2]
        # Points on the side of a solid are clear of it a little way out.
        length = math.sqrt((dx * dx + dy * dy) * pitch * pitch + dh * dh)
        start, end = _clip_to(1e-6 / length, 1.0, points[n, 2] + margin, dh, back, high)
        if start <= end:
            x = points[n, 0] / pitch + (cols - 1) * 0.5
            y = (rows - 1) * 0.5 - points[n, 1] / pitch
            t = _first_hit(
                z, maxima, starts, shapes, x, y, points[n, 2], dx, dy, dh, start, end, margin
            )
            hidden[n] = t >= 0
    return hidden
