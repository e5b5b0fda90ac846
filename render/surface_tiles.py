"""The triangles of a surface by tiles, of which a view draws those that it sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy
from render.surface_shapes import surface_triangles

# Narrow enough for a row of texels to be transformed once for the triangles on both of its sides.
_SIDE = 16  # cells


@dataclass(frozen=True)
class SurfaceTiles:
    """Triangles ordered by squares of cells.

    Attributes
    ----------
    vertices : (n, 3) float32 array
        mm, canvas frame.
    triangles : (m, 3) uint32 array
    first : (tiles + 1,) int64 array
        Of the triangles of each tile; those of the next come after them.
    corners : (tiles, 8, 4) float64 array
        Of the boxes around them, homogeneous.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    first: NDArray[np.int64]
    corners: NDArray[np.float64]

    @classmethod
    def of(cls, copy: DigitalCopy) -> SurfaceTiles:
        """Of a copy with a triangle or more."""
        vertices, triangles = surface_triangles(copy)
        field = copy.height_field
        middle = vertices[triangles].astype(np.float64).mean(axis=1)
        col = ((middle[:, 0] - field.origin_mm[0]) / field.pitch_mm).astype(np.int64)
        row = ((field.origin_mm[1] - middle[:, 1]) / field.pitch_mm).astype(np.int64)
        tile = row // _SIDE * (field.shape[1] // _SIDE + 1) + col // _SIDE
        order = np.lexsort((col, row, tile))
        triangles, tile = triangles[order], tile[order]
        first = np.flatnonzero(np.append(True, np.diff(tile) != 0))
        heights = vertices[triangles]
        low = np.minimum.reduceat(heights.min(axis=1), first)
        high = np.maximum.reduceat(heights.max(axis=1), first)
        ends = np.stack([low, high])
        which = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        corners = np.ones((len(first), 8, 4))
        corners[..., :3] = np.stack(
            [ends[which[:, axis], :, axis] for axis in range(3)], -1
        ).swapaxes(0, 1)
        return cls(vertices, triangles, np.append(first, len(triangles)), corners)

    def seen(self, to_clip: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tiles (tiles,) whose boxes reach into a view, by its matrix (4, 4) from the canvas."""
        x, y, z, w = np.moveaxis(self.corners @ to_clip.T, -1, 0)
        beyond = [w - x, w + x, w - y, w + y, w + z]
        return ~np.any([(side < 0).all(axis=1) for side in beyond], axis=0)

    def runs(self, seen: NDArray[np.bool_]) -> list[tuple[int, int]]:
        """First and number of triangles of tiles that lie one after another."""
        edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8)))
        begin, end = self.first[edges[::2]], self.first[edges[1::2]]
        return [(int(one), int(count)) for one, count in zip(begin, end - begin, strict=True)]
