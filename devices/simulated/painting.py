"""A painting made by code: relief, colour, frame and wall as one height map.

Everything is a function of a seed. Lengths are in mm in the canvas frame: X right, Y up, Z towards
the viewer, the origin at the centre of the canvas.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from devices.errors import DeviceError
from devices.simulated.ray_kernels import look_up


@dataclass(frozen=True)
class Painting:
    """A height map with its albedo, on a grid finer than any scan of it.

    Attributes
    ----------
    height : (rows, cols) float64 array
        Z in mm; row 0 is the top. Includes the frame and the wall behind.
    albedo : (rows, cols) float64 array
        Diffuse reflectance, 0 to 1.
    pitch_mm : float
        Spacing of the grid.
    canvas_mm : (float, float)
        Width and height of the canvas, inside the frame.
    """

    height: NDArray[np.float64]
    albedo: NDArray[np.float64]
    pitch_mm: float
    canvas_mm: tuple[float, float]

    def height_at(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Z at canvas coordinates (mm), by bilinear interpolation; same shape."""
        rows, cols = self.height.shape
        col = np.asarray(x) / self.pitch_mm + (cols - 1) / 2
        row = (rows - 1) / 2 - np.asarray(y) / self.pitch_mm
        if not ((col >= 0) & (col <= cols - 1) & (row >= 0) & (row <= rows - 1)).all():
            raise DeviceError("heights were asked for beyond the simulated wall")
        c = np.minimum(col.astype(int), cols - 2)
        r = np.minimum(row.astype(int), rows - 2)
        u, v = col - c, row - r
        z = self.height
        top = (1 - u) * z[r, c] + u * z[r, c + 1]
        bottom = (1 - u) * z[r + 1, c] + u * z[r + 1, c + 1]
        return np.asarray((1 - v) * top + v * bottom)

    def surface_at(
        self, x: NDArray[np.float64], y: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Unit normals (n, 3) and albedo (n,) at canvas coordinates (n,) in mm; truth for tests."""
        rows, cols = self.height.shape
        slope_y, slope_x = np.gradient(self.height, self.pitch_mm)
        at = np.stack(
            [x / self.pitch_mm + (cols - 1) / 2, (rows - 1) / 2 - y / self.pitch_mm], axis=1
        )
        # Rows run down, so the gradient along them is minus the slope along Y.
        slope = [look_up(g.astype(np.float32), at) for g in (slope_x, -slope_y)]
        normal = np.stack([-slope[0], -slope[1], np.ones(len(at))], axis=1)
        albedo = look_up(self.albedo.astype(np.float32), at)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True), albedo


def paint_small_oil(
    *,
    seed: int,
    canvas_mm: tuple[float, float] = (120.0, 90.0),
    pitch_mm: float = 0.1,
    relief_mm: float = 2.0,
    frame_mm: float = 14.0,
) -> Painting:
    """A small oil painting in a frame, before a wall.

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

    Returns
    -------
    Painting
    """
    random = np.random.default_rng(seed)
    border = 40.0
    cols = round((canvas_mm[0] + 2 * border) / pitch_mm) + 1
    rows = round((canvas_mm[1] + 2 * border) / pitch_mm) + 1
    x, y = np.meshgrid(
        (np.arange(cols) - (cols - 1) / 2) * pitch_mm, ((rows - 1) / 2 - np.arange(rows)) * pitch_mm
    )
    height = 0.010 * (np.sin(2 * np.pi * x / 1.6) * np.sin(2 * np.pi * y / 1.6))
    # A stretcher bows by a few tenths of a millimetre over its width.
    height += 0.3 * np.cos(np.pi * x / canvas_mm[0]) * np.cos(np.pi * y / canvas_mm[1]) - 0.15
    albedo = np.full_like(height, 0.55)
    for _ in range(140):
        _stroke(height, albedo, x, y, random, canvas_mm, random.uniform(0.05, 0.3))
    for _ in range(14):
        _stroke(height, albedo, x, y, random, canvas_mm, random.uniform(0.4, 1.0) * relief_mm)
    height = cv2.GaussianBlur(height, (0, 0), 0.35 / pitch_mm)
    albedo = np.clip(cv2.GaussianBlur(albedo, (0, 0), 0.2 / pitch_mm), 0.15, 0.9)
    if frame_mm > 0:
        _mount(height, albedo, x, y, canvas_mm, frame_mm)
    return Painting(height, albedo, pitch_mm, canvas_mm)


def _stroke(
    height: NDArray[np.float64],
    albedo: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    random: np.random.Generator,
    canvas_mm: tuple[float, float],
    thickness: float,
) -> None:
    """Lay one brush stroke: a rounded bar with bristle marks, in one colour."""
    length, width = random.uniform(8, 24), random.uniform(3, 7)
    cx = random.uniform(-0.46, 0.46) * canvas_mm[0]
    cy = random.uniform(-0.46, 0.46) * canvas_mm[1]
    angle, shade, phase = random.uniform(0, np.pi), random.uniform(0.2, 0.85), random.uniform(0, 6)
    pitch = x[0, 1] - x[0, 0]
    reach = length / 2 + width
    middle = (x.shape[0] - 1) / 2, (x.shape[1] - 1) / 2
    r0, r1 = (round(middle[0] - (cy + s * reach) / pitch) for s in (1, -1))
    c0, c1 = (round(middle[1] + (cx + s * reach) / pitch) for s in (-1, 1))
    window = (slice(max(r0, 0), max(r1, 0)), slice(max(c0, 0), max(c1, 0)))
    dx, dy = x[window] - cx, y[window] - cy
    along = dx * np.cos(angle) + dy * np.sin(angle)
    across = -dx * np.sin(angle) + dy * np.cos(angle)
    inside = np.maximum(np.abs(along) - length / 2, 0) ** 2 + across**2
    # Flat-topped with soft flanks about a millimetre and a half wide.
    profile = 1 / (1 + np.exp((np.sqrt(inside) - width / 2) / 0.35))
    bristles = 1 + 0.06 * np.sin(2 * np.pi * across / 1.8 + phase)
    height[window] += thickness * profile * bristles
    albedo[window] += (shade - albedo[window]) * profile


def _mount(
    height: NDArray[np.float64],
    albedo: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    canvas_mm: tuple[float, float],
    frame_mm: float,
) -> None:
    """Put a rounded moulding 20 mm wide around the canvas, and a wall behind."""
    outside = np.maximum(np.abs(x) - canvas_mm[0] / 2, np.abs(y) - canvas_mm[1] / 2)
    frame = (outside > 0) & (outside <= 20)
    across = (outside[frame] - 10) / 10
    height[frame] = frame_mm * (0.75 + 0.25 * np.sqrt(np.maximum(0, 1 - across**2)))
    albedo[frame] = 0.35
    height[outside > 20] = -15.0
    albedo[outside > 20] = 0.6
