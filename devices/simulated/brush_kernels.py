"""Compiled laying of brush strokes on a height map.

A stroke is a strip along a circular arc. Across it, bristles leave furrows and push paint into a
ridge at either edge; along it, the paint starts full, runs out into the furrows' crests, and
stands up in a bead where the brush is lifted. A stroke rides on what lies below it to a share, and
ploughs through the rest. Everything random is read from a table at a place that depends on seed and
stroke alone, so that bands of rows can be painted side by side.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

BRUSH_STROKE = np.dtype(
    [
        ("x", "f4"),  # start, mm
        ("y", "f4"),
        ("angle", "f4"),  # direction at the start, rad
        ("curvature", "f4"),  # 1/mm
        ("length", "f4"),
        ("width", "f4"),
        ("thickness", "f4"),
        ("load", "f4"),  # share of the length for which the paint lasts
        ("ride", "f4"),  # share of the relief below that shows through
        ("streak", "f4"),  # contrast of the streaks, 0 to 1
        ("red", "f4"),  # of the paint and of its streaks, coded as in the albedo map
        ("green", "f4"),
        ("blue", "f4"),
        ("streak_red", "f4"),
        ("streak_green", "f4"),
        ("streak_blue", "f4"),
        ("roughness", "f4"),  # coded as in the roughness map
    ]
)

_BAND = 64
# Cells of the table of noise, and samples of each.
_CELLS = 64
_SAMPLES = 32


@njit(inline="always")
def _start(key: int, n: int, use: int) -> int:
    """Where a stroke begins to read the noise, for one use (mixing of MurmurHash3)."""
    h = np.uint32(key) * np.uint32(0xCC9E2D51) ^ np.uint32(n) * np.uint32(0x1B873593)
    h = np.uint32(h ^ np.uint32(use) * np.uint32(0x9E3779B1))
    h = np.uint32(np.uint32(h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B))
    h = np.uint32(np.uint32(h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35))
    return int(h ^ (h >> np.uint32(16)))


@njit(inline="always")
def _step(low: float, high: float, x: float) -> float:
    """A smooth step from 0 at ``low`` to 1 at ``high``."""
    u = min(max((x - low) / (high - low), 0.0), 1.0)
    return u * u * (3 - 2 * u)


@njit(inline="always")
def _noise(table: NDArray[np.float32], start: int, x: float, y: float) -> float:
    """Noise of unit cells from 0 to 1: the nearest sample along x, interpolated along y."""
    y += start & 31
    j = math.floor(y)
    v = y - j
    i = (math.floor(x * _SAMPLES) + (start >> 5)) & (_CELLS * _SAMPLES - 1)
    one = table[j & (_CELLS - 1), i]
    return one + (v * v * (3 - 2 * v)) * (table[(j + 1) & (_CELLS - 1), i] - one)


@njit(inline="always")
def _wave(table: NDArray[np.float32], start: int, x: float) -> float:
    """Noise of unit cells from 0 to 1 along a line."""
    i = (math.floor(x * _SAMPLES) + (start >> 5)) & (_CELLS * _SAMPLES - 1)
    return table[start & 31, i]


def noise_table(random: np.random.Generator) -> NDArray[np.float32]:
    """Periodic noise from 0 to 1: independent values, smooth along each row."""
    value = random.uniform(size=(_CELLS, _CELLS + 1)).astype(np.float32)
    value[:, -1] = value[:, 0]
    at = np.arange(_SAMPLES, dtype=np.float32) / _SAMPLES
    blend = at * at * (3 - 2 * at)
    steps = value[:, :-1, np.newaxis] + blend * np.diff(value, axis=1)[:, :, np.newaxis]
    return np.ascontiguousarray(steps.reshape(_CELLS, -1), np.float32)


@njit(parallel=True, cache=True, fastmath=True)
def lay_strokes(
    height: NDArray[np.float32],
    base: NDArray[np.float32],
    albedo: NDArray[np.uint8],
    roughness: NDArray[np.uint8],
    strokes: NDArray[np.void],
    boxes: NDArray[np.int64],
    table: NDArray[np.float32],
    pitch: float,
    bristle_mm: float,
    key: int,
) -> None:
    """Lay strokes one over the other, in place.

    Parameters
    ----------
    height : (rows, cols) float32 array
        Row 0 at the top; the origin of x and y is its centre.
    base : (rows, cols) float32 array
        Smooth level on which this layer's paint rests.
    albedo : (rows, cols, 3) uint8 array
    roughness : (rows, cols) uint8 array
    strokes : (n,) structured array
        Of ``BRUSH_STROKE``, in order of laying.
    boxes : (n, 4) int64 array
        First and end row, first and end column that each may touch.
    table : (cells, cells * samples) float32 array
        Of :func:`noise_table`.
    pitch : float
        Spacing of the grid, mm.
    bristle_mm : float
        Spacing of the furrows.
    key : int
        Of everything random.
    """
    rows, cols = height.shape
    for band in prange((rows + _BAND - 1) // _BAND):
        first = band * _BAND
        end = min(rows, first + _BAND)
        for n in range(len(strokes)):
            r0 = max(first, boxes[n, 0])
            r1 = min(end, boxes[n, 1])
            if r0 >= r1:
                continue
            stroke = strokes[n]
            c = math.cos(stroke.angle)
            s = math.sin(stroke.angle)
            bend = stroke.curvature
            half = 0.5 * stroke.width
            thickness = stroke.thickness
            edge = max(0.3, 0.35 * thickness)
            s1, s2, s3 = _start(key, n, 1), _start(key, n, 2), _start(key, n, 3)
            s4, s5, s6 = _start(key, n, 4), _start(key, n, 5), _start(key, n, 6)
            length = stroke.length
            ride = stroke.ride
            lasting = 1 / (stroke.load * length)
            contrast = stroke.streak
            gloss = stroke.roughness
            paint = (stroke.red, stroke.green, stroke.blue)
            other = (stroke.streak_red, stroke.streak_green, stroke.streak_blue)
            across_bristle = 1 / bristle_mm
            for row in range(r0, r1):
                y = ((rows - 1) * 0.5 - row) * pitch - stroke.y
                for col in range(boxes[n, 2], boxes[n, 3]):
                    x = (col - (cols - 1) * 0.5) * pitch - stroke.x
                    along = c * x + s * y
                    across = c * y - s * x
                    if along < -1.5 - stroke.width or along > length + 1.5:
                        continue
                    # The arc's parabola tells cheaply what lies far from it.
                    aside = 0.5 * bend * along * along
                    if abs(across - aside) > half + edge + 0.3 * abs(aside):
                        continue
                    if abs(bend) > 1e-6:
                        toward = 1 / bend - across
                        reach = math.sqrt(along * along + toward * toward)
                        sign = 1.0 if bend > 0 else -1.0
                        across = 1 / bend - sign * reach
                        if abs(across) > half + edge:
                            continue
                        # Strokes bend by less than a radian: a few terms of the arc tangent do.
                        turn = along / (sign * toward)
                        square = turn * turn
                        series = 1 - square * (1 / 3 - square * (0.2 - square * 0.111))
                        along = turn * series / abs(bend)
                    if abs(across) > half + edge or along < -1.5 or along > length + 1.5:
                        continue
                    # Furrows wander along the stroke, and each begins and ends at its own place.
                    wander = across + 0.5 * (_wave(table, s1, along / 9) - 0.5)
                    ragged = _wave(table, s4, wander * 1.25 * across_bristle) - 0.5
                    rounding = 0.45 * across * across / half
                    waver = 0.5 * edge * (_wave(table, s5, along / 1.7) - 0.5)
                    cover = 1 - _step(half - 0.7 * edge, half + 0.3 * edge, abs(across) + waver)
                    cover *= _step(-0.4, 0.5, along - rounding + 1.2 * ragged)
                    left = length - along - rounding + min(0.3 * half, 1.0) * 3.2 * ragged
                    cover *= _step(-0.6, 0.5, left)
                    if cover <= 0:
                        continue
                    furrow = _noise(table, s2, wander * across_bristle, along * 0.045)
                    fine = _noise(table, s3, wander * 2.2 * across_bristle, along * 0.12)
                    used = along * lasting
                    dry = _step(0.7, 1.5, used)
                    crest = 0.65 * furrow + 0.35 * fine
                    cover *= 1 - dry * _step(0.25, 0.6, 1 - crest)
                    at_edge = (abs(across) - (half - 1.1 * edge)) / (0.55 * edge)
                    ridge = math.exp(-at_edge * at_edge) * _wave(table, s6, along / 2.5)
                    lifted = (left - 1.2) / 0.9
                    bead = math.exp(-lifted * lifted) * (1 - dry)
                    body = (0.62 + 0.38 * crest) * (1 - 0.35 * used) + 0.45 * ridge + 0.22 * bead
                    level = base[row, col]
                    below = height[row, col]
                    # An open furrow of a dry brush lets the surface below show.
                    target = level + ride * (below - level) + thickness * body
                    height[row, col] = below + cover * (target - below)
                    streak = contrast * _wave(table, s3, wander * 1.1)
                    opaque = min(1.0, 1.6 * cover)
                    for i in range(3):
                        mixed = paint[i] + streak * (other[i] - paint[i])
                        old = float(albedo[row, col, i])
                        albedo[row, col, i] = np.uint8(old + opaque * (mixed - old) + 0.5)
                    old = float(roughness[row, col])
                    roughness[row, col] = np.uint8(old + opaque * (gloss - old) + 0.5)
