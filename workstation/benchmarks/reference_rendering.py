"""What a picture of a copy should be: rays on the CPU, and eq. 1 of the paper in NumPy.

Shares nothing with the shaders but the copy: Embree (I. Wald et al., ACM Trans. Graph. 33(4), 2014)
says which triangle of the height field a ray meets, double precision says where, and the shading
is written out again. Front faces alone are seen, as in a mesh whose back is culled. Along a
silhouette Embree's single precision may take the wrong side: rays that something else disagrees
about are cast again, in double precision throughout.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy
from fitting.height_field import HeightField
from render.painter import BACKGROUND, Light
from render.painting_maps import gaps_from_nearest
from render.surface_shapes import surface_triangles
from render.views import View, direction
from workstation.benchmarks.render_rays import TriangleRays

Floats = NDArray[np.float64]

_PLASTER = 0.8 / np.pi
_LEAST_COSINE = 0.05  # of a footprint's slant
_BATCH = 1 << 20


@dataclass(frozen=True)
class ReferencePicture:
    """A picture, and where its rays hit.

    Attributes
    ----------
    radiance : (rows, cols, 3) float64 array
        Linear RGB.
    points : (rows, cols, 3) float64 array
        mm, canvas frame; NaN where nothing is hit.
    """

    radiance: Floats
    points: Floats

    @property
    def covered(self) -> NDArray[np.bool_]:
        """Where something was hit, (rows, cols)."""
        return np.isfinite(self.points[..., 0])


class Reference:
    """Pictures of a copy by ray casting.

    Parameters
    ----------
    copy : DigitalCopy
    """

    def __init__(self, copy: DigitalCopy) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        vertices, triangles = surface_triangles(copy)
        self._corners = _on_grid(vertices, copy.height_field)[triangles]
        self._rays = TriangleRays(copy.height_field, self._corners)
        self._scene = EmbreeScene()
        # The scene keeps no reference to its mesh.
        self._mesh = TriangleMesh(self._scene, vertices, triangles.astype(np.int32))
        self._copy = copy
        self._levels = _map_levels(copy)
        self._high = float(vertices[:, 2].max())

    def picture(
        self,
        view: View,
        *,
        width: int,
        height: int,
        light: Light | None = None,
    ) -> ReferencePicture:
        """One ray through the middle of each pixel."""
        rays = pixel_rays(view, width, height)
        points = self.hits(view.position, rays.reshape(-1, 3)).reshape(rays.shape)
        return ReferencePicture(self._radiance(points, view, height, light), points)

    def recast(
        self,
        picture: ReferencePicture,
        where: NDArray[np.bool_],
        view: View,
        *,
        light: Light | None = None,
    ) -> ReferencePicture:
        """A picture whose rays at some pixels (rows, cols) are cast again in double precision.

        For rays along an edge, where Embree's single precision decides.
        """
        height, width = where.shape
        points, radiance = picture.points.copy(), picture.radiance.copy()
        rays = pixel_rays(view, width, height)[where]
        points[where] = self._rays.first_front_faces(view.position, rays)
        radiance[where] = self._radiance(points[where], view, height, light)
        return ReferencePicture(radiance, points)

    def _radiance(self, points: Floats, view: View, height: int, light: Light | None) -> Floats:
        """Of points (..., 3) that are seen, background where they are NaN."""
        radiance = np.empty_like(points)
        radiance[...] = BACKGROUND
        hit = np.isfinite(points[..., 0])
        pixel_angle = 2 * np.tan(view.field_of_view / 2) / height
        radiance[hit] = self.shade(points[hit], view.position, pixel_angle, light or Light())
        return radiance

    def hits(self, eye: Floats, rays: Floats) -> Floats:
        """First front face that each ray (n, 3) from the eye meets, (n, 3); NaN for none."""
        points = np.full(rays.shape, np.nan)
        for first in range(0, len(rays), _BATCH):
            batch = slice(first, first + _BATCH)
            points[batch] = self._hits(eye, rays[batch])
        return points

    def _hits(self, eye: Floats, rays: Floats) -> Floats:
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        # From just above the surface: Embree counts in single precision.
        lift = self._high + 1e-3 * max(1.0, abs(self._high)) - eye[2]
        begin = np.zeros(len(rays))
        if lift < 0:
            np.divide(lift, rays[:, 2], out=begin, where=rays[:, 2] < 0)
        points = np.full(rays.shape, np.nan)
        active = np.flatnonzero((rays[:, 2] < 0) | (lift >= 0))
        while len(active):
            origin = eye + begin[active, np.newaxis] * rays[active]
            found = self._scene.run(
                origin.astype(np.float32), rays[active].astype(np.float32), output=1
            )
            met = found["primID"] >= 0
            active, triangle = active[met], found["primID"][met]
            a, b, c = self._corners[triangle].swapaxes(0, 1)
            normal = np.cross(b - a, c - a)
            facing = (normal * rays[active]).sum(axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (normal * (a - eye)).sum(axis=1) / facing
            front = facing < 0
            points[active[front]] = eye + t[front, np.newaxis] * rays[active[front]]
            # On through what is seen from behind.
            begin[active] = np.maximum(t, begin[active]) + 1e-4
            active = active[~front & np.isfinite(t)]
        return points

    def shade(self, points: Floats, eye: Floats, pixel_angle: float, light: Light) -> Floats:
        """Radiance (n, 3) that points (n, 3) of the surface send to the eye."""
        field = self._copy.height_field
        to_eye = eye - points
        distance = np.linalg.norm(to_eye, axis=1)
        view = to_eye / distance[:, np.newaxis]
        slant = np.maximum(np.abs(view[:, 2]), _LEAST_COSINE)
        level = np.log2(pixel_angle * distance / (field.pitch_mm * np.sqrt(slant)))
        u = (points[:, 0] - field.origin_mm[0] + field.pitch_mm / 2) / field.size_mm[0]
        v = (field.origin_mm[1] + field.pitch_mm / 2 - points[:, 1]) / field.size_mm[1]
        maps = {name: _sampled(levels, u, v, level) for name, levels in self._levels.items()}
        n_xy = maps["normal"]
        n_z = np.sqrt(np.maximum(1 - (n_xy**2).sum(axis=1), 0))
        normal = np.column_stack([n_xy, n_z])
        tangent = np.array([1.0, 0, 0]) - normal[:, :1] * normal
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        frame = np.stack([tangent, np.cross(normal, tangent), normal], axis=1)

        away = light.distance_mm or 5 * max(field.size_mm)
        to_light = away * direction(light.azimuth, light.elevation) - points
        r = np.linalg.norm(to_light, axis=1, keepdims=True)
        v_local = np.einsum("nij,nj->ni", frame, view)
        l_local = np.einsum("nij,nj->ni", frame, to_light / r)
        irradiance = np.pi * light.strength * (away / r) ** 2 * np.maximum(l_local[:, 2:], 0)
        f = maps["diffuse"].copy()
        if "lobe" in maps:
            lobe = maps["lobe"]
            base = np.maximum((lobe[:, :3] * v_local * l_local).sum(axis=1), 0)
            f += maps["specular"] * (base ** lobe[:, 3])[:, np.newaxis] * (base > 0)[:, np.newaxis]
        return np.asarray(f * irradiance + np.pi * maps["diffuse"] * light.ambient)


def pixel_rays(view: View, width: int, height: int) -> Floats:
    """Directions (rows, cols, 3) through the middles of the pixels, not normalised."""
    half = np.tan(view.field_of_view / 2)
    x = (2 * (np.arange(width) + 0.5) / width - 1) * half * width / height
    y = (1 - 2 * (np.arange(height) + 0.5) / height) * half
    rays = np.empty((height, width, 3))
    rays[..., 0], rays[..., 1], rays[..., 2] = x, y[:, np.newaxis], -1.0
    return rays @ view.pose()[:3, :3].T


def _on_grid(vertices: NDArray[np.float32], field: HeightField) -> Floats:
    """Vertices (n, 3) where they are: single precision has them off the grid by its rounding."""
    places = vertices.astype(np.float64)
    first = np.array(field.origin_mm)
    texels = np.round((places[:, :2] - first) / field.pitch_mm)
    places[:, :2] = first + texels * field.pitch_mm
    return places


def _map_levels(copy: DigitalCopy) -> dict[str, list[Floats]]:
    """Maps with gaps filled from the nearest texel, averaged over ever larger areas."""
    mask = copy.height_field.mask
    maps = {"normal": copy.normal_xy}
    if copy.reflectance is None:
        maps["diffuse"] = np.full((*mask.shape, 3), _PLASTER, np.float32)
    else:
        maps |= {
            "diffuse": copy.reflectance.diffuse,
            "specular": copy.reflectance.specular,
            "lobe": copy.reflectance.lobe,
        }
    filled = gaps_from_nearest(maps, mask)
    return {name: _levels(values) for name, values in filled.items()}


def _levels(values: NDArray[np.float32]) -> list[Floats]:
    levels = [values]
    while max(levels[-1].shape[:2]) > 1:
        rows, cols = levels[-1].shape[:2]
        size = (max(cols // 2, 1), max(rows // 2, 1))
        smaller = cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA)
        levels.append(smaller.astype(np.float32).reshape(size[1], size[0], -1))
    return [level.astype(np.float64) for level in levels]


def _sampled(levels: list[Floats], u: Floats, v: Floats, level: Floats) -> Floats:
    """Linear in both coordinates of the map and between its levels."""
    level = np.clip(level, 0, len(levels) - 1)
    below = np.minimum(level.astype(int), max(len(levels) - 2, 0))
    share = level - below
    sampled = np.zeros((len(u), levels[0].shape[2]))
    for number in np.unique(below):
        here = below == number
        value = _bilinear(levels[number], u[here], v[here])
        if (share[here] > 0).any():
            coarser = _bilinear(levels[number + 1], u[here], v[here])
            value += share[here, np.newaxis] * (coarser - value)
        sampled[here] = value
    return sampled


def _bilinear(values: Floats, u: Floats, v: Floats) -> Floats:
    rows, cols = values.shape[:2]
    x = np.clip(u * cols - 0.5, 0, cols - 1)
    y = np.clip(v * rows - 0.5, 0, rows - 1)
    col, row = (
        np.minimum(x.astype(int), max(cols - 2, 0)),
        np.minimum(y.astype(int), max(rows - 2, 0)),
    )
    x, y = (x - col)[:, np.newaxis], (y - row)[:, np.newaxis]
    right, down = np.minimum(col + 1, cols - 1), np.minimum(row + 1, rows - 1)
    top = (1 - x) * values[row, col] + x * values[row, right]
    bottom = (1 - x) * values[down, col] + x * values[down, right]
    return np.asarray((1 - y) * top + y * bottom)
