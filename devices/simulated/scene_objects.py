"""What stands in a simulated scene: surfaces placed in space, and the wall behind them.

Anything that can be hit by rays, stand in the light and reflect it fills :class:`SceneObject`.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from devices.simulated.ray_kernels import MaximumPyramid, cast_rays, cast_shadows
from devices.simulated.surface import Surface, SurfacePoints

# A point is in the shadow of what rises above its line to the light by more than this.
_SHADOW_MARGIN_MM = 1e-5
# Roughness of polished metal: the least that the shading knows.
_POLISH = 0.02


class SceneObject(Protocol):
    """Something that a camera can see."""

    def cast(
        self, origin: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Distance (n,) along each unit direction (n, 3); NaN where it is missed."""

    def points_at(
        self, points: NDArray[np.float64], footprints: NDArray[np.float32]
    ) -> SurfacePoints:
        """Shape and reflectance at points (n, 3) of its surface, normals in the scene frame.

        The reflectance is averaged over footprints (n, 2, 3): by how much the point moves from one
        pixel to the next, along a row and along a column.
        """

    def hides(self, points: NDArray[np.float64], light: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether it stands between each point (n, 3) and a light (3,)."""


class PlacedSurface:
    """A surface somewhere in the scene.

    Parameters
    ----------
    surface : Surface
    rt_scene_surface : (6,) array, optional
        Pose (Rodrigues, mm) that takes points of the surface's frame to the scene's; by default
        they are the same.
    """

    def __init__(
        self, surface: Surface, rt_scene_surface: NDArray[np.float64] | None = None
    ) -> None:
        self.surface = surface
        rt = np.zeros(6) if rt_scene_surface is None else np.array(rt_scene_surface, np.float64)
        self.rt_scene_surface = rt
        self._rotation = np.asarray(cv2.Rodrigues(rt[:3])[0])
        self._moved = bool(rt.any())

    def placed(self, rt_scene_surface: NDArray[np.float64]) -> PlacedSurface:
        """The same surface elsewhere."""
        other = PlacedSurface(self.surface, rt_scene_surface)
        other.__dict__["_pyramid"] = self._pyramid
        return other

    def cast(
        self, origin: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Distance along each direction; the surface is seen from its front only."""
        local = self._to_surface(origin[np.newaxis])[0]
        turned = directions @ self._rotation if self._moved else directions
        return np.asarray(cast_rays(*(*self._solid, local, turned)))

    def points_at(
        self, points: NDArray[np.float64], footprints: NDArray[np.float32]
    ) -> SurfacePoints:
        """Shape and reflectance at points of the surface, averaged over footprints."""
        if self._moved:
            footprints = footprints @ self._rotation.astype(np.float32)
        found = self.surface.points_at(
            self._to_surface(points), np.ascontiguousarray(footprints[..., :2])
        )
        if not self._moved:
            return found
        turned = (found.normals @ self._rotation.T).astype(np.float32)
        return SurfacePoints(turned, found.finish)

    def hides(self, points: NDArray[np.float64], light: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether the surface stands between each point and a light."""
        local = self._to_surface(light[np.newaxis])[0]
        at = self._to_surface(points)
        return np.asarray(cast_shadows(*(*self._solid, at, local, _SHADOW_MARGIN_MM)))

    @cached_property
    def _pyramid(self) -> MaximumPyramid:
        return MaximumPyramid.of(self.surface.height)

    @cached_property
    def _high(self) -> float:
        return float(self.surface.height.max())

    @property
    def _solid(self) -> tuple[Any, ...]:
        """Height map, pyramid, pitch and extent in depth, for the kernels."""
        surface = self.surface
        pyramid = self._pyramid
        maps = surface.height, pyramid.maxima, pyramid.starts, pyramid.shapes
        return *maps, surface.pitch_mm, surface.back_mm, self._high

    def _to_surface(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        if not self._moved:
            return points
        return np.asarray((points - self.rt_scene_surface[3:]) @ self._rotation)


class Wall:
    """A matt plane behind everything.

    Parameters
    ----------
    z_mm : float
        Where it is; it faces along Z.
    albedo : float
    """

    def __init__(self, z_mm: float, *, albedo: float = 0.6) -> None:
        self.z_mm = z_mm
        self._finish = np.array([albedo, albedo, albedo, 0.9, 0.0, 0.0], np.float32)

    def cast(
        self, origin: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Distance along each direction."""
        down = directions[:, 2] < 0
        reach = np.full(len(directions), np.nan)
        reach[down] = (self.z_mm - origin[2]) / directions[down, 2]
        return reach

    def points_at(
        self, points: NDArray[np.float64], footprints: NDArray[np.float32]
    ) -> SurfacePoints:
        """Alike everywhere."""
        normal = np.array([0, 0, 1], np.float32)
        return SurfacePoints(
            np.tile(normal, (len(points), 1)), np.tile(self._finish, (len(points), 1))
        )

    def hides(self, points: NDArray[np.float64], light: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Everything is before it."""
        return np.zeros(len(points), np.bool_)


class PolishedSphere:
    """A ball of polished metal: a dark disc, but for a spot where it mirrors a lamp.

    It mirrors nothing else, since no light of the scene goes from surface to surface.

    Parameters
    ----------
    centre_mm : (3,) array
        In the scene frame.
    radius_mm : float
    """

    def __init__(self, centre_mm: NDArray[np.float64], radius_mm: float) -> None:
        self.centre_mm = np.array(centre_mm, np.float64)
        self.radius_mm = radius_mm
        self._finish = np.array([0.9, 0.9, 0.9, _POLISH, 0.0, 1.0], np.float32)

    def cast(
        self, origin: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Distance along each direction to the near side."""
        near, under = self._meet(origin - self.centre_mm, directions)
        reach = near - np.sqrt(np.where(under >= 0, under, np.nan))
        return np.where(reach > 0, reach, np.nan)

    def points_at(
        self, points: NDArray[np.float64], footprints: NDArray[np.float32]
    ) -> SurfacePoints:
        """Alike everywhere, with normals from the centre."""
        normals = ((points - self.centre_mm) / self.radius_mm).astype(np.float32)
        return SurfacePoints(normals, np.tile(self._finish, (len(points), 1)))

    def hides(self, points: NDArray[np.float64], light: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether the sphere stands between each point and a light."""
        away = light - points
        length = np.linalg.norm(away, axis=1)
        near, under = self._meet(points - self.centre_mm, away / length[:, np.newaxis])
        # From its own points that face the light, the way leads away from its middle.
        return (under > 0) & (near > 0) & (near < length)

    def _meet(
        self, from_centre: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Way to the middle of a ray's chord, and half the chord squared."""
        near = -np.sum(from_centre * directions, axis=-1)
        under = near**2 - np.sum(from_centre**2, axis=-1) + self.radius_mm**2
        return near, under
