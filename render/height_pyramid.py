"""What rays skip by: pyramids of least and greatest heights, and cones that hold no surface.

Maximum mipmaps: Tevs, Ihrke, Seidel, I3D 2008. A cell lies between four texel centres; level 0 has
the cells, every further level squares of twice their size. Cones: J. Dummer, Cone step mapping,
2006.
"""

from __future__ import annotations

from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from fitting.height_field import HeightField

GAP = np.float32(-1e30)
"""Stands for no height; as ``GAP`` in the shaders."""


class Heading(Enum):
    """Where rays that come down run over the canvas: rows and columns, -1, 0 or 1 each."""

    ANYWHERE = (0, 0)
    UP = (-1, 0)
    DOWN = (1, 0)
    LEFT = (0, -1)
    RIGHT = (0, 1)


def heights_with_gaps(field: HeightField) -> NDArray[np.float32]:
    """Heights (rows, cols) in mm, ``GAP`` where nothing was measured."""
    return np.where(field.mask, field.height, GAP).astype(np.float32)


def min_max_pyramid(height: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Least and greatest height of squares of cells.

    Parameters
    ----------
    height : (rows, cols) float32 array
        mm, ``GAP`` where nothing was measured.

    Returns
    -------
    list of (rows, cols, 3) float32 arrays
        Sides are powers of two. The least height that was measured, the greatest, and 1 where
        nothing is missing, 0 where a square has a gap or reaches beyond the grid. Where nothing
        was measured they are ``-GAP`` and ``GAP``.
    """
    rows, cols = (max(side - 1, 1) for side in height.shape)
    corners = [height[i : i + rows, j : j + cols] for i in (0, 1) for j in (0, 1)]
    corners = [corner for corner in corners if corner.shape == (rows, cols)]
    level = np.empty((_power_of_two(rows), _power_of_two(cols), 3), np.float32)
    level[...] = -GAP, GAP, 0
    # Without a second row or column there is no cell, and nothing to hit.
    if len(corners) == 4:
        measured = [np.where(corner == GAP, -GAP, corner) for corner in corners]
        level[:rows, :cols, 0] = np.minimum.reduce(measured)
        level[:rows, :cols, 1] = np.maximum.reduce(corners)
        level[:rows, :cols, 2] = np.minimum.reduce(corners) != GAP
    levels = [level]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_halved(levels[-1]))
    return levels


def _power_of_two(side: int) -> int:
    return 1 << (side - 1).bit_length()


def _halved(level: NDArray[np.float32]) -> NDArray[np.float32]:
    rows, cols = level.shape[:2]
    down, across = min(rows, 2), min(cols, 2)
    blocks = level.reshape(rows // down, down, cols // across, across, 3)
    halved = blocks.min(axis=(1, 3))
    halved[..., 1] = blocks[..., 1].max(axis=(1, 3))
    return halved


def cone_slopes(
    height: NDArray[np.float32], pitch_mm: float, heading: Heading = Heading.ANYWHERE
) -> NDArray[np.float32]:
    """Slope S of the steepest cone over each texel that may hold surface.

    At a distance r from a texel no height is above its own by more than S r; of a heading, none of
    those in the half of the canvas that lies that way. Heights are gathered in rectangles of
    growing size, so S is a little too large, and never too small.

    Parameters
    ----------
    height : (rows, cols) float32 array
        mm.
    pitch_mm : float
    heading : Heading

    Returns
    -------
    (rows, cols) float32 array
    """
    slopes = np.zeros_like(height)
    before = 1.0
    for radius in (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128):
        if before > max(height.shape):
            break
        highest = _highest(_highest(height, heading.value[0], radius).T, heading.value[1], radius).T
        np.maximum(slopes, (highest - height) / np.float32(before * pitch_mm), out=slopes)
        before = radius
    return slopes


def _highest(height: NDArray[np.float32], ahead: int, radius: int) -> NDArray[np.float32]:
    """Greatest of the rows within a radius: ahead alone, or on both sides."""
    window = np.ones((radius + 1 if ahead else 2 * radius + 1, 1), np.uint8)
    texel = 0 if ahead > 0 else radius
    return np.asarray(cv2.dilate(height, window, anchor=(0, texel)), np.float32)
