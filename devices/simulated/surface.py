"""A surface made by code: relief and reflectance on a grid finer than any scan of it.

Lengths are in mm in the surface's own frame: X right, Y up, Z towards the viewer, the origin at the
centre of the grid. Reflectance is that of :mod:`devices.simulated.shading_kernels`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from devices.errors import DeviceError
from devices.simulated.surface_kernels import sample_finish, sample_normals


@dataclass(frozen=True)
class SurfacePoints:
    """Shape and reflectance at points of a surface.

    Attributes
    ----------
    normals : (n, 3) float32 array
        Unit, outward.
    finish : (n, 6) float32 array
        Albedo for red, green and blue, roughness, varnish and metal, as the properties say.
    """

    normals: NDArray[np.float32]
    finish: NDArray[np.float32]

    @property
    def albedo(self) -> NDArray[np.float32]:
        """Diffuse reflectance for red, green and blue, (n, 3); of metal, that head-on."""
        return self.finish[..., :3]

    @property
    def roughness(self) -> NDArray[np.float32]:
        """Width α of the microfacet distribution, (n,)."""
        return self.finish[..., 3]

    @property
    def varnish(self) -> NDArray[np.float32]:
        """Share covered by varnish, (n,)."""
        return self.finish[..., 4]

    @property
    def metal(self) -> NDArray[np.float32]:
        """Share covered by metal, (n,)."""
        return self.finish[..., 5]


@dataclass(frozen=True)
class Surface:
    """A height map with its reflectance.

    Attributes
    ----------
    height : (rows, cols) float32 array
        Z in mm; row 0 is the top. Of a painting, includes frame and wall.
    albedo : (rows, cols, 3) uint8 array
        255 times the square root of the diffuse reflectance for red, green and blue; where there is
        metal, of its reflectance head-on.
    roughness : (rows, cols) uint8 array
        255 times the width α of the microfacet distribution.
    varnish : (rows, cols) uint8 array
        255 times the share covered by varnish.
    metal : (rows, cols) uint8 array
        255 times the share covered by metal.
    pitch_mm : float
        Spacing of the grid.
    canvas_mm : (float, float)
        Width and height of the canvas, or of whatever is to be scanned, about the origin.
    back_mm : float
        Z of the back: the surface is solid between its height and its back.
    """

    height: NDArray[np.float32]
    albedo: NDArray[np.uint8]
    roughness: NDArray[np.uint8]
    varnish: NDArray[np.uint8]
    metal: NDArray[np.uint8]
    pitch_mm: float
    canvas_mm: tuple[float, float]
    back_mm: float = -15.0

    def __post_init__(self) -> None:
        for name in ("roughness", "varnish", "metal"):
            if getattr(self, name).shape != self.height.shape:
                raise DeviceError(f"a surface's {name} map is not of the size of its height map")
        if self.albedo.shape != (*self.height.shape, 3):
            raise DeviceError("a surface's albedo map is not of the size of its height map")

    @classmethod
    def uniform(
        cls,
        height: NDArray[np.float32],
        *,
        pitch_mm: float,
        canvas_mm: tuple[float, float],
        albedo: float = 0.6,
        roughness: float = 1.0,
        back_mm: float = -15.0,
    ) -> Surface:
        """A surface of one grey, without varnish or metal."""
        shape = height.shape
        return cls(
            np.asarray(height, np.float32),
            np.full((*shape, 3), code_albedo(albedo), np.uint8),
            np.full(shape, round(255 * roughness), np.uint8),
            np.zeros(shape, np.uint8),
            np.zeros(shape, np.uint8),
            pitch_mm,
            canvas_mm,
            back_mm,
        )

    def grid_mm(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """X of the columns (cols,) and Y of the rows (rows,), mm."""
        rows, cols = self.height.shape
        x = (np.arange(cols) - (cols - 1) / 2) * self.pitch_mm
        y = ((rows - 1) / 2 - np.arange(rows)) * self.pitch_mm
        return x, y

    def height_at(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Z at coordinates (mm), by bilinear interpolation; same shape.

        Raises
        ------
        DeviceError
            A point lies outside the grid.
        """
        row, col = self._place(x, y)
        r = np.minimum(row.astype(int), self.height.shape[0] - 2)
        c = np.minimum(col.astype(int), self.height.shape[1] - 2)
        v, u = row - r, col - c
        corner = [self.height[r + i, c + j].astype(np.float64) for i in (0, 1) for j in (0, 1)]
        top = (1 - u) * corner[0] + u * corner[1]
        bottom = (1 - u) * corner[2] + u * corner[3]
        return np.asarray((1 - v) * top + v * bottom)

    def points_at(
        self, points: NDArray[np.float64], footprints: NDArray[np.float32] | None = None
    ) -> SurfacePoints:
        """Shape and reflectance at points of the surface, in its frame.

        Slopes are central differences over two cells, interpolated; maps are decoded, then
        interpolated. Points beyond the edge take its values; points of the edge below the surface
        are on the side of the solid.

        Parameters
        ----------
        points : (n, 3) float64 array
        footprints : (n, 2, 2) float32 array, optional
            X and Y from one pixel to the next, along a row and along a column: reflectance, but not
            the normal, is averaged over the pixel.
        """
        if footprints is None:
            footprints = np.zeros((len(points), 2, 2), np.float32)
        finish = sample_finish(
            self.albedo,
            self.roughness,
            self.varnish,
            self.metal,
            self.pitch_mm,
            points,
            footprints,
        )
        return SurfacePoints(sample_normals(self.height, self.pitch_mm, points), finish)

    def _place(
        self, x: NDArray[np.float64], y: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Row and column of coordinates."""
        rows, cols = self.height.shape
        col = np.asarray(x) / self.pitch_mm + (cols - 1) / 2
        row = (rows - 1) / 2 - np.asarray(y) / self.pitch_mm
        if not ((col >= 0) & (col <= cols - 1) & (row >= 0) & (row <= rows - 1)).all():
            raise DeviceError("the simulated surface was asked for points beyond its edge")
        return row, col


def code_albedo(albedo: float) -> int:
    """The code of a reflectance in an albedo map."""
    return round(255 * float(np.sqrt(min(max(albedo, 0.0), 1.0))))
