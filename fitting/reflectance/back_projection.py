"""Radiance samples by back-projection: each texel looked up in each photograph that shows it.

Paper section 4.4. Texels go through tile by tile, so that the memory needed does not grow with the
number of photographs: more of them make smaller tiles. Samples that the relief hides from lamp or
camera are dropped, and so are those close to the edge of a shadow, where the lamp is seen in part.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.lens import rotation, transform
from fitting.digital_copy import DigitalCopy
from fitting.errors import FittingError
from fitting.reflectance.photographs import Photograph
from fitting.reflectance.ray_kernels import ABOVE_HORIZON, BLOCKED
from fitting.reflectance.samples import DEFAULT_GRAZING_LIMIT, RadianceSamples, local_frames
from fitting.reflectance.sampling_kernels import look_up_texels, store_samples
from fitting.reflectance.terrain import Terrain

Floats = NDArray[np.float64]
_WIDEST_MARGIN = 64  # texels
_BYTES_PER_SAMPLE = 160  # with what the solver and the residual need beside it


@dataclass(frozen=True, kw_only=True)
class SamplingOptions:
    """How samples are taken.

    Attributes
    ----------
    penumbra_px : float
        Pixels of the photograph around the edge of a shadow, or of what hides the surface from the
        camera, in which samples are dropped.
    clearance_sigmas : float
        Standard errors of the height by which the relief must stand above a ray to block it.
    skip_above_horizon : bool
        Whether no ray is cast towards what stands above the local horizon.
    grazing_limit : float
        Largest angle of light and view to the normal, radians.
    tile_bytes : int
        Memory for the samples of a tile.
    """

    penumbra_px: float = 1.0
    clearance_sigmas: float = 1.0
    skip_above_horizon: bool = True
    grazing_limit: float = DEFAULT_GRAZING_LIMIT
    tile_bytes: int = 192 * 2**20


@dataclass(frozen=True)
class Tile:
    """A rectangle of texels: rows and columns from the first to before the last."""

    rows: tuple[int, int]
    cols: tuple[int, int]

    @property
    def slices(self) -> tuple[slice, slice]:
        """For indexing maps."""
        return slice(*self.rows), slice(*self.cols)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows[1] - self.rows[0], self.cols[1] - self.cols[0]


@dataclass
class RayCount:
    """What visibility took.

    Attributes
    ----------
    tested, cast, blocked : int
        Pairs of texel and source looked at, rays cast for them, and pairs that were hidden.
    """

    tested: int = 0
    cast: int = 0
    blocked: int = 0


@dataclass(frozen=True)
class _Viewpoint:
    """What a tile looks like from one place of the camera."""

    pixels: Floats
    footprint: Floats
    view: NDArray[np.float32]
    visible: NDArray[np.bool_]
    margin: int


@dataclass(frozen=True)
class PhotographSampler:
    """Takes the samples of tiles of a copy's texels.

    Attributes
    ----------
    copy : DigitalCopy
    photographs : sequence of Photograph
    terrain : Terrain
        What throws shadows.
    options : SamplingOptions
    rays : RayCount
        Counted as tiles go by.

    Raises
    ------
    FittingError
        There is no photograph.
    """

    copy: DigitalCopy
    photographs: Sequence[Photograph]
    terrain: Terrain
    options: SamplingOptions = field(default_factory=SamplingOptions)
    rays: RayCount = field(default_factory=RayCount)

    def __post_init__(self) -> None:
        if not self.photographs:
            raise FittingError("reflectance needs photographs: the session holds none")

    def tiles(self) -> Iterator[Tile]:
        """Tiles that cover the copy and hold a measured texel each."""
        per_tile = self.options.tile_bytes / (_BYTES_PER_SAMPLE * len(self.photographs))
        side = int(min(max(math.sqrt(per_tile), 16), 512))
        rows, cols = self.copy.height_field.shape
        for row in range(0, rows, side):
            for col in range(0, cols, side):
                tile = Tile((row, min(row + side, rows)), (col, min(col + side, cols)))
                if self.copy.height_field.mask[tile.slices].any():
                    yield tile

    def samples(self, tile: Tile) -> RadianceSamples:
        """Samples of the measured texels of a tile, row by row; one place per photograph.

        Returns
        -------
        RadianceSamples
            Of as many texels as the tile has in the mask.
        """
        own = self.copy.height_field.mask[tile.slices]
        points, normals = self._surface(tile)
        points, normals = points[own], normals[own]
        frames = local_frames(normals)
        shape = (len(points), len(self.photographs))
        view, light = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
        radiance, variance = np.zeros((*shape, 3), np.float32), np.ones((*shape, 3), np.float32)
        weight = np.zeros(shape, np.float32)
        shadows = _Shadows(self, tile)
        seen: dict[tuple[bytes, ...], _Viewpoint] = {}
        for place, photograph in enumerate(self.photographs):
            key = photograph.viewpoint
            if key not in seen:
                seen[key] = self._look(photograph, points, frames, own, shadows)
            from_here, lamp = seen[key], photograph.lamp
            view[:, place] = from_here.view
            lit = ~shadows.around(lamp.position, from_here.margin)[own]
            found, noise = look_up_texels(
                *_as_channels(photograph),
                photograph.channels,
                from_here.pixels,
                from_here.footprint,
                from_here.visible & lit,
            )
            scale = 1.0 / photograph.exposure
            store_samples(
                frames,
                lamp.directions(points),
                lamp.irradiance(points),
                found * scale,
                noise * scale**2,
                *(place, light, radiance, variance, weight),
            )
        samples = RadianceSamples(view, light, radiance, variance, weight)
        return samples.limited(self.options.grazing_limit)

    def normals(self, tile: Tile) -> Floats:
        """Unit normals of the measured texels of a tile, in the order of their samples, (n, 3)."""
        return self._surface(tile)[1][self.copy.height_field.mask[tile.slices]]

    def _look(
        self,
        photograph: Photograph,
        points: Floats,
        frames: Floats,
        own: NDArray[np.bool_],
        shadows: _Shadows,
    ) -> _Viewpoint:
        """Where the texels of a tile are in a photograph, how large, and which can be seen."""
        pose = photograph.rt_cam_canvas
        before = transform(pose, points)
        pixels, gradient = photograph.lens.project_with_gradient(before)
        across = gradient @ (rotation(pose) @ self._edges(frames[:, 2]))
        margin = self._margin(photograph)
        towards = photograph.eye - points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        view = np.einsum("nij,nj->ni", frames, towards)
        hidden = shadows.around(photograph.eye, margin)[own]
        visible = ~hidden & (before[:, 2] > 0.0) & (view[:, 2] > 0.0)
        return _Viewpoint(
            pixels - np.array(photograph.first_pixel, np.float64),
            np.abs(across).sum(axis=2),
            view.astype(np.float32),
            visible & np.isfinite(pixels).all(axis=1) & np.isfinite(across).all(axis=(1, 2)),
            margin,
        )

    def _edges(self, normals: Floats) -> Floats:
        """Edges (n, 3, 2) of texels on the surface: along X and Y, and as it rises there."""
        edges = np.zeros((len(normals), 3, 2))
        edges[:, 0, 0] = edges[:, 1, 1] = 1.0
        edges[:, 2] = -normals[:, :2] / np.maximum(normals[:, 2:], 0.05)
        return edges * self.copy.height_field.pitch_mm

    def _margin(self, photograph: Photograph) -> int:
        """The margin of shadows in texels: alike for all tiles of a photograph."""
        mask = self.copy.height_field.mask
        step = max(1, math.isqrt(mask.size // 400))
        x = self.copy.height_field.texel_x_mm()[::step]
        y = self.copy.height_field.texel_y_mm()[::step]
        points = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1).reshape(-1, 3)
        flat = np.tile([0.0, 0.0, 1.0], (len(points), 1))
        pose = photograph.rt_cam_canvas
        _, gradient = photograph.lens.project_with_gradient(transform(pose, points))
        across = gradient @ (rotation(pose) @ self._edges(flat))
        # Where the camera's own plane meets the canvas there is no size.
        across = across[np.isfinite(across).all(axis=(1, 2))]
        sizes = np.sqrt(np.abs(np.linalg.det(across)))
        sizes = sizes[np.isfinite(sizes) & (sizes > 0.0)]
        if sizes.size == 0:
            return 0  # nothing of the canvas is in the photograph
        margin = math.ceil(self.options.penumbra_px / float(np.median(sizes)) - 1e-9)
        return min(margin, _WIDEST_MARGIN)

    def _surface(self, tile: Tile) -> tuple[Floats, Floats]:
        """Points and unit normals (rows, cols, 3) of a tile's texels in the canvas frame."""
        heights = self.copy.height_field
        x, y = np.meshgrid(
            heights.texel_x_mm()[tile.slices[1]], heights.texel_y_mm()[tile.slices[0]]
        )
        points = np.stack([x, y, heights.height[tile.slices]], axis=-1).astype(np.float64)
        flat = self.copy.normal_xy[tile.slices].astype(np.float64)
        up = np.sqrt(np.maximum(1.0 - np.sum(flat**2, axis=-1, keepdims=True), 1e-6))
        return points, np.concatenate([flat, up], axis=-1)


class _Shadows:
    """Which texels of a tile a source does not reach; each source is looked at once."""

    def __init__(self, sampler: PhotographSampler, tile: Tile) -> None:
        self._sampler = sampler
        self._tile = tile
        self._found: dict[tuple[bytes, int], NDArray[np.bool_]] = {}
        self._horizons: dict[int, NDArray[np.float32]] = {}

    def around(self, source: Floats, margin: int) -> NDArray[np.bool_]:
        """Texels of the tile within ``margin`` texels of one that ``source`` does not reach."""
        key = (np.asarray(source, np.float64).tobytes(), margin)
        if key not in self._found:
            self._found[key] = self._look(source, margin)
        return self._found[key]

    def _look(self, source: Floats, margin: int) -> NDArray[np.bool_]:
        sampler, tile, options = self._sampler, self._tile, self._sampler.options
        heights = sampler.copy.height_field
        rows, cols = heights.shape
        (top, bottom), (left, right) = tile.rows, tile.cols
        wider = Tile(
            (max(top - margin, 0), min(bottom + margin, rows)),
            (max(left - margin, 0), min(right + margin, cols)),
        )
        measured = heights.mask[wider.slices]
        points = sampler._surface(wider)[0][measured]
        clearance = options.clearance_sigmas * np.sqrt(heights.variance[wider.slices][measured])
        if options.skip_above_horizon and margin not in self._horizons:
            self._horizons[margin] = sampler.terrain.horizons(points)
        found = sampler.terrain.findings(
            points,
            source,
            clearance_mm=clearance + 1e-3 * heights.pitch_mm,
            horizons=self._horizons.get(margin),
        )
        blocked = found == BLOCKED
        sampler.rays.tested += len(found)
        sampler.rays.cast += int(np.sum(found != ABOVE_HORIZON))
        sampler.rays.blocked += int(blocked.sum())
        dark = np.zeros(measured.shape, np.uint8)
        dark[measured] = blocked
        if margin:
            disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
            dark = np.asarray(cv2.dilate(dark, disc), np.uint8)
        inner = dark[
            top - wider.rows[0] : top - wider.rows[0] + tile.shape[0],
            left - wider.cols[0] : left - wider.cols[0] + tile.shape[1],
        ]
        return np.asarray(inner, np.bool_)


def _as_channels(
    photograph: Photograph,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Radiance and variance with an axis of channels, and the flat field or nothing.

    All are read-only and, but for odd layouts, in the order of C, so that the kernels are compiled
    once.
    """
    flat = photograph.flat_field
    none = np.empty((0, 0), np.float32)
    arrays = []
    for array in (photograph.radiance, photograph.variance):
        one = np.asarray(array, np.float32)
        if photograph.mosaic is not None:
            one = one[..., np.newaxis]
        elif one.strides[2] == 0:
            one = one[..., :1]  # three channels that are one
        arrays.append(one)
    arrays.append(none if flat is None else np.asarray(flat, np.float32))
    views = [array.view() for array in arrays]
    for view in views:
        view.flags.writeable = False
    return views[0], views[1], views[2]
