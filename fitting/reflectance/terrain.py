"""What can stand in the way of light: the height field, and what surrounds it.

A painting's frame is no part of its copy, but throws shadows on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from fitting.errors import FittingError
from fitting.height_field import HeightField
from fitting.reflectance.ray_kernels import Pyramid, cast_from_eye, cast_to_source, local_horizons

Floats = NDArray[np.float64]
_LARGEST_GRID = 8192  # a side


@dataclass(frozen=True)
class Terrain:
    """A height field without gaps, ready for rays.

    Attributes
    ----------
    pyramid : Pyramid
        Heights over the spacing.
    pitch_mm : float
    origin_mm : (float, float)
        X and Y of the first grid point.
    """

    pyramid: Pyramid
    pitch_mm: float
    origin_mm: tuple[float, float]

    @classmethod
    def of(cls, field: HeightField, *, surroundings: Floats | None = None) -> Terrain:
        """Build the terrain of a height field.

        Gaps are given the height of the nearest measured texel: they are commonest beside steep
        strokes, which do throw shadows.

        Parameters
        ----------
        field : HeightField
        surroundings : (n, 3) array, optional
            Points in the canvas frame, mm, that were measured beyond the field: of the frame, say.
            Only what stands higher than the lowest texel matters.

        Raises
        ------
        FittingError
            The field is narrower than two texels.
        """
        rows, cols = field.shape
        if min(rows, cols) < 2:
            raise FittingError(
                f"a height field of {cols} × {rows} texels has no surface to cast on"
            )
        height = field.height.astype(np.float32)
        if not field.mask.all():
            nearest = distance_transform_edt(
                ~field.mask, return_distances=False, return_indices=True
            )
            height = height[nearest[0], nearest[1]]
        x0, y0 = field.origin_mm
        if surroundings is not None:
            height, (west, north) = _extended(height, field, np.asarray(surroundings, np.float64))
            x0, y0 = x0 - west * field.pitch_mm, y0 + north * field.pitch_mm
        return cls(_pyramid_of(height / np.float32(field.pitch_mm)), field.pitch_mm, (x0, y0))

    def horizons(self, points: Floats) -> NDArray[np.float32]:
        """Bounds of the slope at which anything stands before surface points (n, 3), (n, 16)."""
        return local_horizons(self.pyramid, self._on_grid(points))

    def findings(
        self,
        points: Floats,
        source: Floats,
        *,
        clearance_mm: NDArray[np.floating] | float,
        horizons: NDArray[np.float32] | None = None,
    ) -> NDArray[np.uint8]:
        """What stands between surface points and a source of light, or an eye.

        Parameters
        ----------
        points : (n, 3) array
            In the canvas frame, mm.
        source : (3,) array
        clearance_mm : (n,) array or float
            By which the surface must stand above a ray to block it.
        horizons : (n, 16) array, optional
            Without them a ray is cast from every point.

        Returns
        -------
        (n,) uint8 array
            ``ABOVE_HORIZON``, ``CLEAR`` or ``BLOCKED`` of
            :mod:`~fitting.reflectance.ray_kernels`.
        """
        if horizons is None:
            horizons = np.empty((0, 16), np.float32)
        clearance = np.broadcast_to(
            np.asarray(clearance_mm, np.float32) / np.float32(self.pitch_mm), len(points)
        )
        return cast_to_source(
            self.pyramid,
            self._on_grid(points),
            self._on_grid(np.asarray(source, np.float64)[np.newaxis])[0],
            horizons,
            np.ascontiguousarray(clearance),
        )

    def seen_from(self, eye: Floats, directions: Floats) -> Floats:
        """Surface points (n, 3) that rays (n, 3) from an eye meet, mm; NaN where they miss."""
        scale = np.array([1.0, -1.0, 1.0]) / self.pitch_mm
        start = self._on_grid(np.asarray(eye, np.float64)[np.newaxis])[0]
        way = cast_from_eye(self.pyramid, start, np.ascontiguousarray(directions * scale))
        return np.asarray(eye + way[:, np.newaxis] * directions)

    def _on_grid(self, points: Floats) -> Floats:
        grid = np.empty_like(points, dtype=np.float64)
        grid[:, 0] = (points[:, 0] - self.origin_mm[0]) / self.pitch_mm
        grid[:, 1] = (self.origin_mm[1] - points[:, 1]) / self.pitch_mm
        grid[:, 2] = points[:, 2] / self.pitch_mm
        return grid


def _pyramid_of(height: NDArray[np.float32]) -> Pyramid:
    low = cv2.erode(height, np.ones((2, 2)), anchor=(0, 0))[:-1, :-1]
    high = cv2.dilate(height, np.ones((2, 2)), anchor=(0, 0))[:-1, :-1]
    levels = [(low, high)]
    while max(levels[-1][0].shape) > 1:
        odd = [(0, size % 2) for size in levels[-1][0].shape]
        low, high = (np.pad(level, odd, mode="edge") for level in levels[-1])
        levels.append(
            (
                np.minimum.reduce([low[i::2, j::2] for i in (0, 1) for j in (0, 1)]),
                np.maximum.reduce([high[i::2, j::2] for i in (0, 1) for j in (0, 1)]),
            )
        )
    sizes = [low.size for low, _ in levels]
    return Pyramid(
        np.ascontiguousarray(height),
        np.concatenate([low.ravel() for low, _ in levels]).astype(np.float32),
        np.concatenate([high.ravel() for _, high in levels]).astype(np.float32),
        np.concatenate([[0], np.cumsum(sizes[:-1])]).astype(np.int64),
        np.array([low.shape for low, _ in levels], np.int64),
    )


def _extended(
    height: NDArray[np.float32], field: HeightField, points: Floats
) -> tuple[NDArray[np.float32], tuple[int, int]]:
    """The heights on a larger grid that holds the points, and the texels added left and above."""
    rows, cols = height.shape
    lowest = float(height.min())
    high = points[np.isfinite(points).all(axis=1) & (points[:, 2] > lowest)]
    col = np.rint((high[:, 0] - field.origin_mm[0]) / field.pitch_mm).astype(np.int64)
    row = np.rint((field.origin_mm[1] - high[:, 1]) / field.pitch_mm).astype(np.int64)
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    near = (np.abs(row - rows // 2) < _LARGEST_GRID // 2) & (
        np.abs(col - cols // 2) < _LARGEST_GRID // 2
    )
    around = near & ~inside
    if not around.any():
        return height, (0, 0)
    row, col, top = row[around], col[around], high[around, 2].astype(np.float32)
    north, south = max(0, -int(row.min())), max(0, int(row.max()) - rows + 1)
    west, east = max(0, -int(col.min())), max(0, int(col.max()) - cols + 1)
    larger = np.full((rows + north + south, cols + west + east), lowest, np.float32)
    np.maximum.at(larger, (row + north, col + west), top)
    # Points are about as far apart as texels: close the holes between them.
    larger = np.asarray(cv2.morphologyEx(larger, cv2.MORPH_CLOSE, np.ones((3, 3))), np.float32)
    larger[north : north + rows, west : west + cols] = height
    return larger, (west, north)
