r"""What a calibration leaves uncertain: in pixels over the image, and in millimetres of height.

Two pictures of the same covariance. :func:`uncertainty_map` says by how many pixels a lens
misplaces points at the working distance (mrcal's projection uncertainty). :class:`RigCovariance`
holds the joint covariance of both lenses and the pose between them, and propagates it to
triangulated points: with :math:`X(\theta)` the point at which the measured pixel and projector
coordinates meet, :math:`\Sigma_X = \frac{\partial X}{\partial\theta} \Sigma_\theta
\frac{\partial X}{\partial\theta}^T`. Errors of one calibration are shared by all points of a scan,
so heights come as a joint covariance; the part that a plane explains only moves the painting and
can be removed. A wrong square size scales everything and is added.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.lens import Lens, transform
from calibration.mrcal_covariance import parameter_covariance, projection_covariance
from calibration.mrcal_solution import LensSolution
from calibration.rig_geometry import RigGeometry
from calibration.triangulation import depth_along_rays

# Finite differences go this many standard deviations to either side.
_STEP_SIGMAS = 0.02


@dataclass(frozen=True)
class UncertaintyMap:
    """Uncertainty of projection over an imager.

    Attributes
    ----------
    pixels : (rows, cols, 2) float64 array
        Grid over the imager.
    covariance : (rows, cols, 2, 2) float64 array
        Square pixels.
    distance_mm : float
        How far along the rays the points lie.
    """

    pixels: NDArray[np.float64]
    covariance: NDArray[np.float64]
    distance_mm: float

    @property
    def worst_sigma_px(self) -> NDArray[np.float64]:
        """(rows, cols) standard deviation along the worst direction."""
        return np.sqrt(np.linalg.eigvalsh(self.covariance)[..., -1])


def uncertainty_map(
    solution: LensSolution,
    number: int,
    *,
    distance_mm: float,
    columns: int = 30,
    rows: int | None = None,
) -> UncertaintyMap:
    """Uncertainty of a lens's projection at a distance, on a grid over its imager.

    Parameters
    ----------
    solution : LensSolution
    number : int
        Which lens.
    distance_mm : float
        Distance from the lens, along each ray.
    columns, rows : int
        Of the grid; rows follow the imager's shape by default.
    """
    return covariance_map(
        solution.lenses[number],
        lambda points: projection_covariance(solution, number, points),
        distance_mm=distance_mm,
        columns=columns,
        rows=rows,
    )


def covariance_map(
    lens: Lens,
    covariance_of: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    *,
    distance_mm: float,
    columns: int = 30,
    rows: int | None = None,
) -> UncertaintyMap:
    """What :func:`uncertainty_map` gives, of any covariance of projection.

    Parameters
    ----------
    lens : Lens
    covariance_of : callable
        Covariance (..., 2, 2), square pixels, of where points (..., 3) of the lens's frame are
        seen.
    distance_mm, columns, rows
        As for :func:`uncertainty_map`.
    """
    if not (np.isfinite(distance_mm) and distance_mm > 0):
        raise CalibrationError(f"a working distance of {distance_mm} mm: it must be positive")
    rows = rows or max(2, round(columns * lens.height / lens.width))
    across, down = np.linspace(0, lens.width - 1, columns), np.linspace(0, lens.height - 1, rows)
    pixels = np.stack(np.meshgrid(across, down), axis=-1)
    rays = lens.unproject(pixels)
    points = rays * (distance_mm / np.linalg.norm(rays, axis=-1, keepdims=True))
    return UncertaintyMap(pixels, covariance_of(points), distance_mm)


@dataclass(frozen=True)
class RigCovariance:
    """Joint covariance of camera, projector and the pose between them.

    Attributes
    ----------
    rig : RigGeometry
    covariance : (n, n) float64 array
        Of the camera's parameters, the projector's, and ``rt_proj_cam``, in this order.
    scale_sigma : float
        Relative standard error of lengths, from that of the board's squares.
    """

    rig: RigGeometry
    covariance: NDArray[np.float64]
    scale_sigma: float

    def point_jacobian(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """How triangulated points move with the rig's parameters, their measurements held.

        Parameters
        ----------
        points : (k, 3) array
            In the camera frame, mm, seen by both lenses.

        Returns
        -------
        (k, 3, n) float64 array
        """
        points = np.asarray(points, np.float64)
        pixels = self.rig.camera.project(points)
        coordinates = self.rig.projector.project(transform(self.rig.rt_proj_cam, points))
        jacobian = np.zeros((len(points), 3, len(self.covariance)))
        sigmas = np.sqrt(np.diag(self.covariance))
        start = float(np.median(points[:, 2]))
        for number in np.flatnonzero(sigmas > 0):
            step = _STEP_SIGMAS * sigmas[number]
            moved = [
                _triangulated(self._with(number, sign * step), pixels, coordinates, start)
                for sign in (1, -1)
            ]
            jacobian[..., number] = (moved[0] - moved[1]) / (2 * step)
        return jacobian

    def point_covariance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Covariance (k, 3, 3) of each point by the calibration, mm²."""
        jacobian = self.point_jacobian(points)
        covariance = jacobian @ self.covariance @ np.swapaxes(jacobian, -1, -2)
        scale = self.scale_sigma**2 * points[..., :, np.newaxis] * points[..., np.newaxis, :]
        return np.asarray(covariance + scale)

    def height_covariance(
        self, points: NDArray[np.float64], *, normal: NDArray[np.float64], remove_plane: bool = True
    ) -> NDArray[np.float64]:
        """Joint covariance of the heights of points, mm².

        Parameters
        ----------
        points : (k, 3) array
            In the camera frame.
        normal : (3,) array
            Direction of height in the camera frame.
        remove_plane : bool
            Whether an error that a plane explains is left out: it moves and tilts the whole.

        Returns
        -------
        (k, k) float64 array
        """
        points = np.asarray(points, np.float64)
        up = np.asarray(normal, np.float64)
        up = up / np.linalg.norm(up)
        lever = np.einsum("i,kin->kn", up, self.point_jacobian(points))
        scale = self.scale_sigma * (points @ up)
        if remove_plane:
            across = np.linalg.svd(up[np.newaxis])[2][1:]
            offset = (points - points.mean(axis=0)) @ across.T
            plane = np.column_stack([np.ones(len(points)), offset])
            keep = np.eye(len(points)) - plane @ np.linalg.pinv(plane)
            lever, scale = keep @ lever, keep @ scale
        return np.asarray(lever @ self.covariance @ lever.T + np.outer(scale, scale))

    def _with(self, number: int, step: float) -> RigGeometry:
        camera, projector = self.rig.camera, self.rig.projector
        counts = len(camera.intrinsics), len(projector.intrinsics)
        if number < counts[0]:
            return replace(self.rig, camera=_moved(camera, number, step))
        number -= counts[0]
        if number < counts[1]:
            return replace(self.rig, projector=_moved(projector, number, step))
        pose = self.rig.rt_proj_cam.copy()
        pose[number - counts[1]] += step
        return replace(self.rig, rt_proj_cam=pose)


def rig_covariance(solution: LensSolution, *, scale_sigma: float = 0.0) -> RigCovariance:
    """The covariance of a camera and projector that were solved together.

    Parameters
    ----------
    solution : LensSolution
        Of two lenses, the camera first.
    scale_sigma : float
        Relative standard error of the board's squares.
    """
    if len(solution.lenses) != 2:
        raise CalibrationError(f"a rig has a camera and a projector, not {len(solution.lenses)}")
    rig = RigGeometry(solution.lenses[0], solution.lenses[1], solution.rt_lens_ref[1])
    return RigCovariance(rig, parameter_covariance(solution), scale_sigma)


def _moved(lens: Lens, number: int, step: float) -> Lens:
    intrinsics = lens.intrinsics.copy()
    intrinsics[number] += step
    return replace(lens, intrinsics=intrinsics)


def _triangulated(
    rig: RigGeometry,
    pixels: NDArray[np.float64],
    coordinates: NDArray[np.float64],
    start_mm: float,
) -> NDArray[np.float64]:
    slopes = rig.camera.unproject(pixels)[..., :2]
    depth, _ = depth_along_rays(
        rig, slopes, coordinates, np.ones_like(coordinates), start_mm=start_mm
    )
    return np.concatenate([slopes * depth[:, np.newaxis], depth[:, np.newaxis]], axis=1)
