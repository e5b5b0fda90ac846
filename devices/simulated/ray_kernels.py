"""Compiled ray casting on a height map, for the simulated rig."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


@njit(inline="always")
def _height(z: NDArray[np.float64], col: float, row: float) -> float:
    rows, cols = z.shape
    c = min(max(math.floor(col), 0), cols - 2)
    r = min(max(math.floor(row), 0), rows - 2)
    u = min(max(col - c, 0.0), 1.0)
    v = min(max(row - r, 0.0), 1.0)
    top = (1 - u) * z[r, c] + u * z[r, c + 1]
    bottom = (1 - u) * z[r + 1, c] + u * z[r + 1, c + 1]
    return (1 - v) * top + v * bottom


@njit(parallel=True, cache=True)
def cast_rays(
    z: NDArray[np.float64],
    pitch: float,
    origin: NDArray[np.float64],
    directions: NDArray[np.float64],
    low: float,
    high: float,
) -> NDArray[np.float64]:
    """Distance along each ray (n, 3) from ``origin`` to the height map; NaN where it misses.

    Rays are marched in steps of one grid cell between the heights ``high`` and ``low``, then
    bisected to a nanometre.
    """
    rows, cols = z.shape
    distance = np.full(len(directions), np.nan)
    for n in prange(len(directions)):
        dx, dy, dz = directions[n]
        if dz >= 0:
            continue
        start = max(0.0, (high - origin[2]) / dz)
        end = (low - origin[2]) / dz
        lateral = math.sqrt(dx * dx + dy * dy)
        # A flat scene leaves nothing between start and end: step a cell through it.
        step = min(pitch / max(lateral, 1e-9), max((end - start) / 8, pitch))
        before = start
        t = start
        while t < end + step:
            x = (origin[0] + t * dx) / pitch + (cols - 1) / 2
            y = (rows - 1) / 2 - (origin[1] + t * dy) / pitch
            if x < 0 or y < 0 or x > cols - 1 or y > rows - 1:
                before = t
                t += step
                continue
            if origin[2] + t * dz <= _height(z, x, y):
                a = before
                b = t
                for _ in range(40):
                    m = 0.5 * (a + b)
                    x = (origin[0] + m * dx) / pitch + (cols - 1) / 2
                    y = (rows - 1) / 2 - (origin[1] + m * dy) / pitch
                    if origin[2] + m * dz <= _height(z, x, y):
                        b = m
                    else:
                        a = m
                distance[n] = 0.5 * (a + b)
                break
            before = t
            t += step
    return distance


@njit(parallel=True, cache=True)
def lit_from(
    z: NDArray[np.float64],
    pitch: float,
    points: NDArray[np.float64],
    light: NDArray[np.float64],
    high: float,
    margin: float,
) -> NDArray[np.bool_]:
    """Whether each point (n, 3) sees ``light``; the surface hides it if it rises above the ray."""
    rows, cols = z.shape
    lit = np.ones(len(points), np.bool_)
    for n in prange(len(points)):
        dx = light[0] - points[n, 0]
        dy = light[1] - points[n, 1]
        dz = light[2] - points[n, 2]
        lateral = math.sqrt(dx * dx + dy * dy)
        if dz <= 0:
            lit[n] = False
            continue
        step = pitch / max(lateral, 1e-9)
        t = step
        while t < 1.0 and points[n, 2] + t * dz < high:
            x = (points[n, 0] + t * dx) / pitch + (cols - 1) / 2
            y = (rows - 1) / 2 - (points[n, 1] + t * dy) / pitch
            if x < 0 or y < 0 or x > cols - 1 or y > rows - 1:
                break
            if _height(z, x, y) > points[n, 2] + t * dz + margin:
                lit[n] = False
                break
            t += step
    return lit


@njit(parallel=True, cache=True)
def look_up(picture: NDArray[np.float32], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Picture values at (n, 2) columns and rows, bilinear, 0 outside.

    OpenCV's remap rounds coordinates to a 32nd of a pixel, which decoding would see.
    """
    rows, cols = picture.shape
    found = np.zeros(len(at))
    for n in prange(len(at)):
        col, row = at[n]
        if col < -0.5 or row < -0.5 or col > cols - 0.5 or row > rows - 0.5:
            continue
        c = min(max(math.floor(col), 0), cols - 2)
        r = min(max(math.floor(row), 0), rows - 2)
        u = min(max(col - c, 0.0), 1.0)
        v = min(max(row - r, 0.0), 1.0)
        top = (1 - u) * picture[r, c] + u * picture[r, c + 1]
        bottom = (1 - u) * picture[r + 1, c] + u * picture[r + 1, c + 1]
        found[n] = (1 - v) * top + v * bottom
    return found
