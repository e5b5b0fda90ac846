"""A piece that has everything that is hard to digitise side by side.

Burnished gilding reflects like a mirror, carbon black hardly at all; white outshines both. A
palette knife has left slabs with vertical edges 6 mm high; the canvas has a hole through which the
wall shows.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from devices.simulated.canvas_ground import (
    WALL_MM,
    Canvas,
    frame_and_wall,
    smooth_noise,
    stretch_canvas,
    varnish_patches,
)
from devices.simulated.surface import Surface, code_albedo

GOLD = (0.93, 0.66, 0.28)
GILDING_ROUGHNESS = 0.08
CARBON_BLACK = 0.02
TITANIUM_WHITE = 0.93
CLIFF_MM = 6.0


def make_torture_piece(
    *, seed: int = 0, canvas_mm: tuple[float, float] = (240.0, 180.0), pitch_mm: float = 0.1
) -> Surface:
    """The piece: gilding on the left, black and white above each other, slabs right, a hole below.

    Parameters
    ----------
    seed : int
        Of everything.
    canvas_mm : (float, float)
        Width and height of the canvas.
    pitch_mm : float
        Spacing of the grid.
    """
    random = np.random.default_rng(seed)
    canvas = stretch_canvas(
        canvas_mm=canvas_mm, pitch_mm=pitch_mm, moulding_mm=25.0, random=random, weave_mm=0.12
    )
    wide, high = canvas_mm
    varnish_patches(canvas, share=0.4, random=random)
    _fill(canvas, (-0.18 * wide, 0.14 * wide), (0.0, 0.46 * high), CARBON_BLACK, 0.5)
    _fill(canvas, (-0.18 * wide, 0.14 * wide), (-0.46 * high, -0.04 * high), TITANIUM_WHITE, 0.4)
    _gild(canvas, (-0.47 * wide, -0.20 * wide), (-0.46 * high, 0.46 * high), random)
    for level in np.linspace(-0.38, 0.38, 7):
        for side in (0.22, 0.38):
            place = side + random.uniform(-0.03, 0.03), level + random.uniform(-0.04, 0.04)
            _knife_slab(canvas, (place[0] * wide, place[1] * high), random)
    _tear(canvas, (0.02 * wide, -0.24 * high), 9.0, random)
    frame_and_wall(canvas, frame_mm=20.0, albedo=GOLD, roughness=0.15, metal=1.0)
    return canvas.finish()


def _window(canvas: Canvas, x: tuple[float, float], y: tuple[float, float]) -> tuple[slice, slice]:
    cols = np.flatnonzero((canvas.x >= x[0]) & (canvas.x <= x[1]))
    rows = np.flatnonzero((canvas.y >= y[0]) & (canvas.y <= y[1]))
    return slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)


def _fill(
    canvas: Canvas,
    x: tuple[float, float],
    y: tuple[float, float],
    albedo: float,
    roughness: float,
) -> None:
    """Paint a rectangle flat."""
    here = _window(canvas, x, y)
    canvas.albedo[here] = code_albedo(albedo)
    canvas.roughness[here] = round(255 * roughness)


def _gild(
    canvas: Canvas, x: tuple[float, float], y: tuple[float, float], random: np.random.Generator
) -> None:
    """Lay gold leaf on smooth bole, burnish it, and punch rows of dots into it."""
    here = _window(canvas, x, y)
    shape = here[0].stop - here[0].start, here[1].stop - here[1].start
    level = np.array(cv2.GaussianBlur(canvas.height[here], (0, 0), 1.5 / canvas.pitch_mm), "f4")
    level += 0.5 + 0.02 * smooth_noise(shape, 8 / canvas.pitch_mm, random)
    gx, gy = np.meshgrid(canvas.x[here[1]], canvas.y[here[0]])
    pitch = 6.0
    dx = gx - pitch * np.round(gx / pitch)
    dy = gy - pitch * np.round(gy / pitch)
    ring = (np.abs(gy - (y[0] + y[1]) / 2) > 0.36 * (y[1] - y[0])).astype(np.float32)
    level -= 0.35 * ring * np.exp(-(dx**2 + dy**2) / (2 * 0.7**2))
    canvas.height[here] = level
    canvas.albedo[here] = [code_albedo(channel) for channel in GOLD]
    canvas.roughness[here] = round(255 * GILDING_ROUGHNESS)
    canvas.metal[here] = 255
    canvas.varnish[here] = 0


def _knife_slab(canvas: Canvas, at: tuple[float, float], random: np.random.Generator) -> None:
    """Set a slab of paint: it rises along its length and ends in a cliff on three sides."""
    length, width = random.uniform(14, 30), random.uniform(7, 13)
    angle = random.uniform(0, 2 * np.pi)
    reach = 0.5 * float(np.hypot(length, width)) + 1
    here = _window(canvas, (at[0] - reach, at[0] + reach), (at[1] - reach, at[1] + reach))
    dx = canvas.x[here[1]][np.newaxis] - at[0]
    dy = canvas.y[here[0]][:, np.newaxis] - at[1]
    along = (np.cos(angle) * dx + np.sin(angle) * dy) / length + 0.5
    across = (np.cos(angle) * dy - np.sin(angle) * dx) / width
    inside = (along > 0) & (along < 1) & (np.abs(across) < 0.5)
    top = random.uniform(0.6, 1.0) * CLIFF_MM * np.clip(along, 0, 1) ** 0.7
    # The blade's nicks leave lines; its chatter, waves.
    nicks = np.interp(across * width, np.linspace(-8, 8, 60), 0.02 * random.normal(size=60))
    top = top + nicks + 0.04 * np.sin(2 * np.pi * (along * length / 4 + 0.3 * across))
    slab = np.maximum(canvas.height[here], np.minimum(top, CLIFF_MM))
    canvas.height[here] = np.where(inside, slab, canvas.height[here])
    paint = random.uniform(0.05, 0.8, 3)
    canvas.albedo[here][inside] = [code_albedo(channel) for channel in paint]
    canvas.roughness[here][inside] = round(255 * random.uniform(0.2, 0.4))


def _tear(
    canvas: Canvas, at: tuple[float, float], radius: float, random: np.random.Generator
) -> None:
    """Tear a hole through the canvas; its edge curls up."""
    here = _window(canvas, (at[0] - 16, at[0] + 16), (at[1] - 16, at[1] + 16))
    dx = canvas.x[here[1]][np.newaxis] - at[0]
    dy = canvas.y[here[0]][:, np.newaxis] - at[1]
    turn = np.arctan2(dy, dx)
    edge = radius * np.ones_like(turn)
    for n in range(2, 7):
        edge += radius * 0.35 / n * np.cos(n * turn + random.uniform(0, 2 * np.pi))
    beyond: NDArray[np.float64] = np.hypot(dx, dy) - edge
    curled = canvas.height[here] + 0.9 * np.exp(-np.maximum(beyond, 0) / 1.5)
    canvas.height[here] = np.where(beyond < 0, WALL_MM, curled)
    hole = beyond < 0
    canvas.albedo[here][hole] = code_albedo(0.6)
    canvas.roughness[here][hole] = round(255 * 0.9)
    canvas.varnish[here][hole] = 0
