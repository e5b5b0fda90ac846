"""What a painting is painted on and hung in: woven canvas, stretcher, varnish, frame and wall."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from devices.simulated.surface import Surface, code_albedo

WALL_MM = -15.0
_WALL_MARGIN_MM = 10.0


@dataclass
class Canvas:
    """The maps of a painting while it is being painted.

    Attributes
    ----------
    height : (rows, cols) float32 array
    albedo : (rows, cols, 3) uint8 array
    roughness, varnish, metal : (rows, cols) uint8 array
        As in :class:`~devices.simulated.surface.Surface`.
    x, y : (cols,) and (rows,) float32 array
        Coordinates, mm.
    pitch_mm : float
    canvas_mm : (float, float)
    moulding_mm : float
        Width of the frame around the canvas.
    """

    height: NDArray[np.float32]
    albedo: NDArray[np.uint8]
    roughness: NDArray[np.uint8]
    varnish: NDArray[np.uint8]
    metal: NDArray[np.uint8]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    pitch_mm: float
    canvas_mm: tuple[float, float]
    moulding_mm: float

    def finish(self) -> Surface:
        """The painting, done."""
        return Surface(
            self.height,
            self.albedo,
            self.roughness,
            self.varnish,
            self.metal,
            self.pitch_mm,
            self.canvas_mm,
            WALL_MM,
        )


def stretch_canvas(
    *,
    canvas_mm: tuple[float, float],
    pitch_mm: float,
    moulding_mm: float,
    random: np.random.Generator,
    bow_mm: float = 0.3,
    thread_mm: float = 0.8,
    weave_mm: float = 0.06,
    ground: tuple[float, float, float] = (0.42, 0.34, 0.24),
) -> Canvas:
    """A primed canvas on its stretcher, with room for a frame.

    Parameters
    ----------
    canvas_mm : (float, float)
        Width and height.
    pitch_mm : float
        Spacing of the grid.
    moulding_mm : float
        Width of the frame that will surround it.
    random : numpy.random.Generator
        Of thread and ground.
    bow_mm : float
        How far the middle stands out before the edges.
    thread_mm : float
        Spacing of the threads of a plain weave.
    weave_mm : float
        Height of its bumps.
    ground : (float, float, float)
        Reflectance of the imprimatura.
    """
    border = moulding_mm + _WALL_MARGIN_MM
    cols, rows = (round((size + 2 * border) / pitch_mm) + 1 for size in canvas_mm)
    x = ((np.arange(cols) - (cols - 1) / 2) * pitch_mm).astype(np.float32)
    y = (((rows - 1) / 2 - np.arange(rows)) * pitch_mm).astype(np.float32)
    # Threads wander by a part of their spacing.
    warp = np.pi * x / thread_mm + 2.0 * _smooth_line(cols, 12 / pitch_mm, random)
    weft = np.pi * y / thread_mm + 2.0 * _smooth_line(rows, 12 / pitch_mm, random)
    height = np.outer(np.sin(weft), np.sin(warp)).astype(np.float32)
    # Plain weave: the crossing threads rise and sink in turn, and each is round.
    height *= np.float32(0.7)
    height += np.float32(0.3) * np.maximum(
        np.abs(np.sin(weft))[:, np.newaxis], np.abs(np.sin(warp))[np.newaxis]
    ).astype(np.float32)
    height *= np.float32(weave_mm / 2)
    bow = np.outer(np.cos(np.pi * y / canvas_mm[1]), np.cos(np.pi * x / canvas_mm[0]))
    height += (bow_mm * (bow - 0.5)).astype(np.float32)
    albedo = np.empty((rows, cols, 3), np.uint8)
    tone = 1 + 0.05 * smooth_noise((rows, cols), 6 / pitch_mm, random)
    for channel, reflectance in enumerate(ground):
        albedo[..., channel] = np.clip(code_albedo(reflectance) * tone, 0, 255)
    return Canvas(
        height,
        albedo,
        np.full((rows, cols), round(255 * 0.6), np.uint8),
        np.zeros((rows, cols), np.uint8),
        np.zeros((rows, cols), np.uint8),
        x,
        y,
        pitch_mm,
        canvas_mm,
        moulding_mm,
    )


def smooth_noise(
    shape: tuple[int, int], scale_px: float, random: np.random.Generator
) -> NDArray[np.float32]:
    """Smooth noise of unit deviation that varies over ``scale_px``, (rows, cols)."""
    coarse = [max(4, round(size / scale_px) + 4) for size in shape]
    grid = random.normal(size=coarse).astype(np.float32)
    return np.asarray(cv2.resize(grid, shape[::-1], interpolation=cv2.INTER_CUBIC), np.float32)


def varnish_patches(
    canvas: Canvas, *, share: float, random: np.random.Generator, patch_mm: float = 35.0
) -> None:
    """Varnish a share of the canvas in patches that brush and time have left."""
    size = canvas.height.shape[0], canvas.height.shape[1]
    field = smooth_noise(size, patch_mm / canvas.pitch_mm, random)
    field += 0.35 * smooth_noise(size, patch_mm / 5 / canvas.pitch_mm, random)
    inside = np.ix_(
        np.abs(canvas.y) < canvas.canvas_mm[1] / 2, np.abs(canvas.x) < canvas.canvas_mm[0] / 2
    )
    limit = float(np.quantile(field[inside][::7, ::7], 1 - share))
    cover = np.clip((field[inside] - limit) / 0.25 + 0.5, 0, 1)
    canvas.varnish[inside] = np.round(255 * cover)


def frame_and_wall(
    canvas: Canvas,
    *,
    frame_mm: float,
    albedo: tuple[float, float, float] = (0.30, 0.18, 0.09),
    roughness: float = 0.35,
    metal: float = 0.0,
) -> None:
    """Put a rounded moulding around the canvas, and a wall behind.

    Parameters
    ----------
    canvas : Canvas
    frame_mm : float
        Height of the moulding.
    albedo, roughness, metal
        Of its surface.
    """
    width = canvas.moulding_mm
    outside = np.maximum(
        np.abs(canvas.y)[:, np.newaxis] - np.float32(canvas.canvas_mm[1] / 2),
        np.abs(canvas.x)[np.newaxis] - np.float32(canvas.canvas_mm[0] / 2),
    )
    frame = (outside > 0) & (outside <= width)
    across = (outside[frame] - width / 2) / (width / 2)
    canvas.height[frame] = frame_mm * (0.75 + 0.25 * np.sqrt(np.maximum(0, 1 - across**2)))
    wall = outside > width
    canvas.height[wall] = WALL_MM
    for channel in range(3):
        canvas.albedo[..., channel][frame] = code_albedo(albedo[channel])
    canvas.albedo[wall] = code_albedo(0.6)
    for where, rough, gilt in ((frame, roughness, metal), (wall, 0.9, 0.0)):
        canvas.roughness[where] = round(255 * rough)
        canvas.metal[where] = round(255 * gilt)
        canvas.varnish[where] = 0


def _smooth_line(length: int, scale_px: float, random: np.random.Generator) -> NDArray[np.float64]:
    knots = random.normal(size=max(4, round(length / scale_px) + 4))
    return np.interp(np.linspace(0, len(knots) - 1, length), np.arange(len(knots)), knots)
