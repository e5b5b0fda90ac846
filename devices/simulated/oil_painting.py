"""Oil paintings made by code: an evening field, laid stroke by stroke.

A layer is a list of strokes that follow the motif: their direction is that of what they depict
(the sky turns about the sun, the field runs to its vanishing point), their colour is mixed from a
few pigments. Thin layers show the weave; the accents stand up by millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from devices.simulated.brush_kernels import BRUSH_STROKE, lay_strokes, noise_table
from devices.simulated.canvas_ground import (
    Canvas,
    frame_and_wall,
    stretch_canvas,
    varnish_patches,
)
from devices.simulated.surface import Surface

Colours = NDArray[np.float64]

# Linear reflectances of pigments in oil, red, green, blue: sRGB values read off paint charts.
LEAD_WHITE = (0.82, 0.80, 0.74)
CHROME_YELLOW = (0.80, 0.52, 0.04)
YELLOW_OCHRE = (0.52, 0.31, 0.09)
VERMILION = (0.58, 0.07, 0.03)
BURNT_UMBER = (0.09, 0.05, 0.03)
VIRIDIAN = (0.03, 0.20, 0.12)
SAP_GREEN = (0.13, 0.21, 0.05)
ULTRAMARINE = (0.04, 0.07, 0.36)
CERULEAN = (0.14, 0.36, 0.50)
ROSE_MADDER = (0.48, 0.13, 0.19)


@dataclass(frozen=True)
class _Motif:
    """What is depicted at a place: (n,) directions and (n, 3) paints, linear."""

    angle: NDArray[np.float64]
    paint: Colours
    other: Colours
    part: NDArray[np.int64]  # 0 sky, 1 sun, 2 hills, 3 field, 4 cypress


@dataclass(frozen=True, kw_only=True)
class _Layer:
    """How a layer is brushed: sizes in mm, each a range."""

    spacing: float
    length: tuple[float, float]
    width: tuple[float, float]
    thickness: tuple[float, float]
    ride: float
    load: tuple[float, float]
    streak: float = 0.5
    wander: float = 0.25


def paint_oil(
    *,
    seed: int = 0,
    canvas_mm: tuple[float, float] = (400.0, 300.0),
    pitch_mm: float = 0.1,
    relief_mm: float = 3.0,
    frame_mm: float = 18.0,
) -> Surface:
    """An oil painting with weave, brush strokes, patchy varnish and a frame, before a wall.

    Parameters
    ----------
    seed : int
        Of everything.
    canvas_mm : (float, float)
        Width and height of the canvas.
    pitch_mm : float
        Spacing of the grid.
    relief_mm : float
        Height of the thickest strokes.
    frame_mm : float
        Height of the frame's moulding; 0 leaves frame and wall out.
    """
    layers = (
        _Layer(
            spacing=15.0,
            length=(35, 70),
            width=(12, 20),
            thickness=(0.02, 0.05),
            ride=0.95,
            load=(0.5, 1.1),
            streak=0.9,
        ),
        _Layer(
            spacing=6.6,
            length=(12, 38),
            width=(4, 8.5),
            thickness=(0.06, 0.22),
            ride=0.45,
            load=(0.45, 1.1),
            streak=0.9,
        ),
        _Layer(
            spacing=7.5,
            length=(8, 24),
            width=(2.5, 6),
            thickness=(0.12, 0.45),
            ride=0.4,
            load=(0.6, 1.3),
            streak=0.8,
        ),
    )
    return _paint(
        seed=seed,
        canvas_mm=canvas_mm,
        pitch_mm=pitch_mm,
        relief_mm=relief_mm,
        frame_mm=frame_mm,
        layers=layers,
        accents=_Layer(
            spacing=14.0,
            length=(5, 15),
            width=(3, 6.5),
            thickness=(0.2, 0.7),
            ride=0.3,
            load=(1.0, 1.6),
        ),
        bristle_mm=0.8,
        level_mm=0.12,
        moulding_mm=30.0,
        varnished=0.45,
    )


def paint_small_oil(
    *,
    seed: int,
    canvas_mm: tuple[float, float] = (120.0, 90.0),
    pitch_mm: float = 0.1,
    relief_mm: float = 2.0,
    frame_mm: float = 14.0,
) -> Surface:
    """A small, unvarnished oil sketch in smooth, thick paint, in a frame before a wall.

    Parameters
    ----------
    seed, canvas_mm, pitch_mm, relief_mm, frame_mm
        As of :func:`paint_oil`.
    """
    layers = (
        _Layer(
            spacing=6.0,
            length=(20, 40),
            width=(8, 13),
            thickness=(0.02, 0.05),
            ride=0.95,
            load=(0.8, 1.4),
            streak=0.7,
        ),
        _Layer(
            spacing=4.6,
            length=(10, 24),
            width=(4, 7),
            thickness=(0.08, 0.3),
            ride=0.5,
            load=(0.9, 1.6),
        ),
    )
    return _paint(
        seed=seed,
        canvas_mm=canvas_mm,
        pitch_mm=pitch_mm,
        relief_mm=relief_mm,
        frame_mm=frame_mm,
        layers=layers,
        accents=_Layer(
            spacing=13.0,
            length=(6, 14),
            width=(4, 7),
            thickness=(0.25, 0.7),
            ride=0.3,
            load=(1.2, 1.8),
        ),
        bristle_mm=1.3,
        level_mm=0.35,
        moulding_mm=20.0,
        varnished=0.0,
    )


def _paint(
    *,
    seed: int,
    canvas_mm: tuple[float, float],
    pitch_mm: float,
    relief_mm: float,
    frame_mm: float,
    layers: tuple[_Layer, ...],
    accents: _Layer,
    bristle_mm: float,
    level_mm: float,
    moulding_mm: float,
    varnished: float,
) -> Surface:
    random = np.random.default_rng(seed)
    canvas = stretch_canvas(
        canvas_mm=canvas_mm, pitch_mm=pitch_mm, moulding_mm=moulding_mm, random=random
    )
    for number, layer in enumerate(layers):
        strokes = _cover(canvas, layer, random)
        _brush(canvas, strokes, bristle_mm, seed * 64 + number)
    thick = _accentuate(canvas, accents, relief_mm, random)
    _brush(canvas, thick, bristle_mm, seed * 64 + len(layers))
    # Paint levels under its surface tension before it dries.
    cv2.GaussianBlur(canvas.height, (0, 0), level_mm / pitch_mm, dst=canvas.height)
    _limit(canvas, relief_mm)
    if varnished > 0:
        varnish_patches(canvas, share=varnished, random=random)
    if frame_mm > 0:
        frame_and_wall(canvas, frame_mm=frame_mm)
    return canvas.finish()


def _motif(x: NDArray[np.float64], y: NDArray[np.float64], random: np.random.Generator) -> _Motif:
    """What is depicted at canvas coordinates from -1 to 1, and how the brush goes there."""
    noise = random.normal(size=(len(x), 3))
    horizon = -0.12 + 0.05 * np.sin(2.2 * x + 0.5)
    ridge = horizon + 0.20 + 0.10 * np.sin(3.1 * x + 1.0) + 0.05 * np.sin(7.3 * x)
    sun_x, sun_y = 0.42, 0.46
    dx, dy = x - sun_x, 0.75 * (y - sun_y)
    radius = np.hypot(dx, dy)
    flame = 0.13 * np.clip(1.05 - (y + 0.75) / 1.5, 0, 1) ** 0.6 * (1 + 0.25 * np.sin(14 * y))
    cypress = (np.abs(x + 0.62 - 0.03 * np.sin(6 * y)) < flame) & (y > -0.75) & (y < 0.78)
    field = ~cypress & (y < horizon)
    hills = ~cypress & (y >= horizon) & (y < ridge)
    sun = ~cypress & ~hills & ~field & (radius < 0.13)
    part = np.select([cypress, sun, hills, field], [4, 1, 2, 3], 0)
    swirl = np.exp(-((radius / 0.5) ** 2))
    around = np.arctan2(dx, -dy)
    waves = 0.5 * np.sin(3 * x + 4 * y) + 0.35 * np.sin(6 * y - 2 * x)
    sky = np.arctan2(
        swirl * np.sin(around) + (1 - swirl) * np.sin(waves),
        swirl * np.cos(around) + (1 - swirl) * np.cos(waves),
    )
    slope = np.arctan(0.75 * (0.31 * np.cos(3.1 * x + 1.0) + 0.36 * np.cos(7.3 * x)))
    furrow = np.arctan2(0.75 * (y - 0.02), x + 0.15)
    angle = np.select(
        [part == 4, part == 1, part == 2, part == 3],
        [np.pi / 2 + 0.5 * np.sin(9 * y), around, slope, furrow],
        sky,
    )
    bands = 0.5 + 0.5 * np.sin(22 * np.arctan2(y - 0.02, x + 0.15) + 0.8 * noise[:, 0])
    rings = 0.5 + 0.5 * np.sin(38 * radius + 0.7 * noise[:, 0])
    low = np.clip(1 - (y - ridge) / 0.5, 0, 1)
    light = np.clip(0.75 * swirl * rings + 0.45 * low + 0.08 * noise[:, 1], 0, 1)
    blue = _mix(ULTRAMARINE, CERULEAN, np.clip(0.45 + 0.35 * np.sin(5 * y + 3 * x), 0, 1))
    sky_paint = _mix(blue, _mix(LEAD_WHITE, CHROME_YELLOW, np.clip(swirl, 0, 1) * 0.5), light)
    hill_paint = _mix(
        _mix(VIRIDIAN, ULTRAMARINE, np.clip(0.5 + 0.4 * noise[:, 1], 0, 1)), LEAD_WHITE, 0.18
    )
    field_paint = _mix(_mix(YELLOW_OCHRE, CHROME_YELLOW, 0.4), SAP_GREEN, bands)
    tree_paint = _mix(VIRIDIAN, BURNT_UMBER, np.clip(0.5 + 0.3 * noise[:, 1], 0, 1))
    sun_paint = _mix(CHROME_YELLOW, LEAD_WHITE, np.clip(1 - radius / 0.1, 0, 1))
    every = [tree_paint, sun_paint, hill_paint, field_paint, sky_paint]
    choice = np.select([part == 4, part == 1, part == 2, part == 3], [0, 1, 2, 3], 4)
    paint = np.stack(every)[choice, np.arange(len(x))]
    paint = paint * np.clip(1 + 0.10 * noise[:, 2:3], 0.6, 1.4)
    streaks = np.array([SAP_GREEN, LEAD_WHITE, CERULEAN, VERMILION, LEAD_WHITE])[choice]
    return _Motif(angle, np.clip(paint, 0.015, 0.85), streaks, part)


def _mix(one: object, other: object, share: object) -> Colours:
    """Paints (n, 3) mixed by share (n,), in the manner of pigments: darker than light would."""
    a, b = np.atleast_2d(np.asarray(one, float)), np.atleast_2d(np.asarray(other, float))
    t = np.atleast_1d(np.asarray(share, float))[:, np.newaxis]
    return np.asarray(np.exp((1 - t) * np.log(a) + t * np.log(b)) * 0.5 + 0.5 * (a + t * (b - a)))


def _cover(canvas: Canvas, layer: _Layer, random: np.random.Generator) -> NDArray[np.void]:
    """Strokes all over the canvas, on a jittered grid, in random order."""
    wide, high = canvas.canvas_mm
    nx, ny = (max(2, round(size / layer.spacing)) for size in (wide, high))
    x, y = np.meshgrid(np.arange(nx) + 0.5, np.arange(ny) + 0.5)
    x = (x.ravel() + random.uniform(-0.5, 0.5, nx * ny)) / nx * wide - wide / 2
    y = (y.ravel() + random.uniform(-0.5, 0.5, nx * ny)) / ny * high - high / 2
    order = random.permutation(nx * ny)
    x, y = x[order], y[order]
    motif = _motif(2 * x / wide, 2 * y / high, random)
    # Far parts first: the sky, then hills and field, then what stands before them.
    depth = np.argsort(np.array([0, 1, 2, 3, 4])[motif.part], kind="stable")
    return _strokes(x, y, motif, layer, random)[depth]


def _accentuate(
    canvas: Canvas, layer: _Layer, relief_mm: float, random: np.random.Generator
) -> NDArray[np.void]:
    """Thick dabs: the sun and its rings, crests of the sky, flowers of the field."""
    wide, high = canvas.canvas_mm
    count = round(wide * high / layer.spacing**2)
    x = random.uniform(-0.47, 0.47, 6 * count) * wide
    y = random.uniform(-0.47, 0.47, 6 * count) * high
    motif = _motif(2 * x / wide, 2 * y / high, random)
    near_sun = np.hypot(2 * x / wide - 0.42, 0.75 * (2 * y / high - 0.46))
    sky_light = (motif.part == 0) & (motif.paint[:, 0] > 0.32)
    wanted = np.select(
        [motif.part == 1, sky_light, motif.part == 3, motif.part == 4],
        [1.0, 0.28, 0.22, 0.12],
        0.02,
    )
    keep = np.flatnonzero(random.uniform(size=len(x)) < wanted)[: 2 * count]
    x, y, near_sun = x[keep], y[keep], near_sun[keep]
    motif = _Motif(*(getattr(motif, f)[keep] for f in ("angle", "paint", "other", "part")))
    flower = random.integers(0, 3, len(x))
    flowers = np.array([VERMILION, LEAD_WHITE, ROSE_MADDER])[flower]
    paint = np.where((motif.part == 3)[:, np.newaxis], flowers, motif.paint)
    bright = (motif.part < 2)[:, np.newaxis]
    paint = np.where(bright, _mix(paint, LEAD_WHITE, 0.45), paint)
    motif = _Motif(motif.angle, paint, motif.other, motif.part)
    strokes = _strokes(x, y, motif, layer, random)
    strokes["thickness"] *= relief_mm * np.where(near_sun < 0.16, 1.15, 1.0)
    dab = motif.part == 3
    strokes["length"] = np.where(dab, 0.6 * strokes["length"], strokes["length"])
    return strokes


def _strokes(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    motif: _Motif,
    layer: _Layer,
    random: np.random.Generator,
) -> NDArray[np.void]:
    """Strokes centred at (x, y), brushed as the layer says."""
    count = len(x)
    strokes = np.zeros(count, BRUSH_STROKE)
    for name in ("length", "width", "thickness", "load"):
        low, high = getattr(layer, name)
        strokes[name] = low + (high - low) * random.uniform(size=count)
    angle = motif.angle + layer.wander * random.normal(size=count)
    strokes["angle"] = angle
    strokes["curvature"] = random.normal(size=count) * 0.25 / strokes["length"]
    strokes["x"] = x - 0.5 * strokes["length"] * np.cos(angle)
    strokes["y"] = y - 0.5 * strokes["length"] * np.sin(angle)
    strokes["ride"] = layer.ride
    strokes["streak"] = layer.streak * random.uniform(0.4, 1.0, count)
    for number, name in enumerate(("red", "green", "blue")):
        strokes[name] = 255 * np.sqrt(motif.paint[:, number])
        strokes[f"streak_{name}"] = 255 * np.sqrt(
            0.6 * motif.paint[:, number] + 0.4 * motif.other[:, number]
        )
    # Lean paint dries matt, paint rich in oil glossy.
    strokes["roughness"] = 255 * random.uniform(0.25, 0.55, count)
    return strokes


def _brush(canvas: Canvas, strokes: NDArray[np.void], bristle_mm: float, key: int) -> None:
    rows, cols = canvas.height.shape
    # Places along the path, a little beyond both ends; the arc's heading turns evenly.
    along = np.linspace(-2.0, strokes["length"] + 2.0, 9)
    heading = strokes["angle"] + 0.5 * strokes["curvature"] * along
    around = 0.5 * strokes["width"] + np.maximum(1.0, strokes["thickness"])
    col = (strokes["x"] + along * np.cos(heading)) / canvas.pitch_mm + (cols - 1) / 2
    row = (rows - 1) / 2 - (strokes["y"] + along * np.sin(heading)) / canvas.pitch_mm
    margin = around / canvas.pitch_mm
    boxes = np.empty((len(strokes), 4), np.int64)
    for start, at, size in ((0, row, rows), (2, col, cols)):
        boxes[:, start] = np.clip(np.floor(at.min(axis=0) - margin), 0, size)
        boxes[:, start + 1] = np.clip(np.ceil(at.max(axis=0) + margin) + 1, 0, size)
    small = cv2.resize(canvas.height, (max(8, cols // 8), max(8, rows // 8)), interpolation=3)
    small = cv2.GaussianBlur(small, (0, 0), 2.0 / (8 * canvas.pitch_mm))
    base = cv2.resize(small, (cols, rows), interpolation=cv2.INTER_LINEAR).astype(np.float32)
    lay_strokes(
        canvas.height,
        base,
        canvas.albedo,
        canvas.roughness,
        strokes,
        boxes,
        noise_table(np.random.default_rng(key)),
        canvas.pitch_mm,
        bristle_mm,
        key,
    )


def _limit(canvas: Canvas, relief_mm: float) -> None:
    """Press down what stands higher than the thickest strokes may; the rest stays as it is."""
    knee = 0.8 * relief_mm
    over = canvas.height > knee
    room = relief_mm - knee
    canvas.height[over] = knee + room * np.tanh((canvas.height[over] - knee) / room)
