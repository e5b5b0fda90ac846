"""The shapes that carry a copy's surface: its triangles, its plane at δ0, the box around it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy


def surface_triangles(
    copy: DigitalCopy,
) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Triangles between measured texels.

    Returns
    -------
    vertices : (n, 3) float32 array
        Texel centres in the canvas frame, mm.
    triangles : (m, 3) uint32 array
        Two per square of four measured texels, one per square of three.
    """
    field = copy.height_field
    mask = field.mask
    x, y = np.meshgrid(field.texel_x_mm(), field.texel_y_mm())
    vertices = np.stack([x[mask], y[mask], field.height[mask]], axis=1).astype(np.float32)
    number = np.full(mask.shape, -1, np.int64)
    number[mask] = np.arange(len(vertices))
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    have = [corner >= 0 for corner in (a, b, c, d)]
    whole = have[1] & have[2]
    choices = [
        (np.stack([a, c, b], axis=1), whole & have[0]),
        (np.stack([b, c, d], axis=1), whole & have[3]),
        (np.stack([a, d, b], axis=1), have[0] & have[1] & have[3] & ~have[2]),
        (np.stack([a, c, d], axis=1), have[0] & have[2] & have[3] & ~have[1]),
    ]
    return vertices, np.concatenate([t[keep] for t, keep in choices]).astype(np.uint32)


def has_triangle(mask: NDArray[np.bool_]) -> bool:
    """Whether any square of four texels has three that were measured."""
    measured = mask.astype(np.int8)
    squares = measured[:-1, :-1] + measured[:-1, 1:] + measured[1:, :-1] + measured[1:, 1:]
    return bool((squares >= 3).any())


def bounds(copy: DigitalCopy) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest corner, (3,) each in mm, of the box around the whole surface."""
    field = copy.height_field
    half = 0.5 * field.pitch_mm
    left, top = field.origin_mm[0] - half, field.origin_mm[1] + half
    width, height = field.size_mm
    low, high = field.height_range_mm
    # A flat copy still needs a box with an inside.
    thin = 1e-3 * field.pitch_mm
    return np.array([left, top - height, low - thin]), np.array([left + width, top, high + thin])


def cell_bounds(copy: DigitalCopy) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest corner, (3,) each in mm, of the box around all triangles."""
    low, high = bounds(copy)
    half = 0.5 * copy.height_field.pitch_mm * np.array([1.0, 1.0, 0.0])
    return low + half, high - half


def plane(copy: DigitalCopy) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Corners (4, 3) and triangles of the bump plane, which lies at δ0 (paper section 5.1)."""
    low, high = bounds(copy)
    z = copy.relief.delta0_mm
    corners = np.array(
        [[low[0], low[1], z], [high[0], low[1], z], [high[0], high[1], z], [low[0], high[1], z]]
    )
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


def box(
    low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Corners (8, 3) and triangles, facing outwards, of a box between two corners."""
    corners = np.array(
        [[x, y, z] for z in (low[2], high[2]) for y in (low[1], high[1]) for x in (low[0], high[0])]
    )
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [triangle for q in quads for triangle in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]
    return corners, np.array(faces)
