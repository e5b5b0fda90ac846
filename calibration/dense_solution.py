r"""What the surface of a board determines of camera and projector, with its standard errors.

:mod:`calibration.dense_solve` finds it. The covariance is that of all that the views share and of
every pose: small steps of both lenses, of the pose between them, and, for each view, of the board's
pose and of the projector's motion, so that whatever follows from these has its error bar.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.dense_equations import DenseProblem, lens_gradient, motion_gradient
from calibration.lens import Lens, compose, invert, rotation, transform
from calibration.rig_geometry import RigGeometry

# Numbers of a view: turn and shift of the board, then of the projector.
_PER_VIEW = 12


@dataclass(frozen=True)
class PrintedSkew:
    """How askew a board is printed.

    Attributes
    ----------
    shear : float
        By how much its columns and rows are off a right angle, rad.
    stretch : float
        Relative length along the rows over that along the columns, less one.
    covariance : (2, 2) float64 array
        Of both.
    """

    shear: float
    stretch: float
    covariance: NDArray[np.float64]

    @property
    def sigma(self) -> tuple[float, float]:
        """Standard errors of shear and stretch."""
        shear, stretch = np.sqrt(np.diagonal(self.covariance))
        return float(shear), float(stretch)


@dataclass(frozen=True)
class ProjectorMotion:
    """By how much the projector moved against the camera while each view was recorded.

    Of the mean over the views, since a motion that all share is the pose between both. Turns and
    shifts explain much of one another; what both together do to the picture is told well.

    Attributes
    ----------
    turn_rad, turn_sigma_rad : (views,) float64 arrays
        Angle, and its standard error.
    shift_mm, shift_sigma_mm : (views,) float64 arrays
    moved_px, moved_sigma_px : (views,) float64 arrays
        Of the board in the projector's picture, root mean square over its corners.
    """

    turn_rad: NDArray[np.float64]
    turn_sigma_rad: NDArray[np.float64]
    shift_mm: NDArray[np.float64]
    shift_sigma_mm: NDArray[np.float64]
    moved_px: NDArray[np.float64]
    moved_sigma_px: NDArray[np.float64]


@dataclass(frozen=True)
class DenseSolution:
    """What the surface of the board determines.

    Attributes
    ----------
    rig : RigGeometry
        With its covariance.
    rt_cam_board : (views, 6) float64 array
    drift : (views, 6) float64 array
        What the projector moved by from the usual pose while a view was recorded (Rodrigues, mm).
    problem : DenseProblem
        What it was solved from, with the variances that the unknowns showed.
    relief : (grid.size,) float64 array
        Coefficients of the board's height, mm.
    displacement_mm : (rows, columns, 2) float64 array
        Of the corners in the board's plane, off the grid.
    corner_sigma_mm : (rows, columns, 3) float64 array
        Standard errors of the corners' places, and of the relief at them.
    skew : PrintedSkew
    covariance : (n, n) float64 array
        Of small steps of the lenses, of the pose between them, and, for each view, of the board's
        pose and of the projector's motion; n is their numbers and six, and twelve for each view.
    sample_rms_px : (views, 2) float64 array
        Robust standard deviation of the blocks' residuals, projector columns and rows.
    corner_rms_px : (views,) float64 array
        The same of the corners in the camera, per coordinate.
    """

    rig: RigGeometry
    rt_cam_board: NDArray[np.float64]
    drift: NDArray[np.float64]
    problem: DenseProblem
    relief: NDArray[np.float64]
    displacement_mm: NDArray[np.float64]
    corner_sigma_mm: NDArray[np.float64]
    skew: PrintedSkew
    covariance: NDArray[np.float64]
    sample_rms_px: NDArray[np.float64]
    corner_rms_px: NDArray[np.float64]

    @property
    def lenses(self) -> tuple[Lens, Lens]:
        """Camera and projector."""
        return self.rig.camera, self.rig.projector

    @property
    def corner_places(self) -> NDArray[np.float64]:
        """(rows, columns, 3) mm: where the corners are in the board's frame."""
        places = self.problem.board.points + 0.0
        places[..., :2] += self.displacement_mm
        flat = places[..., :2].reshape(-1, 2)
        places[..., 2] = self.heights(flat).reshape(places.shape[:2])
        return places

    def heights(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height (n,) of the board in mm at places (n, 2) of its plane."""
        return self.problem.grid.heights(self.relief, places)[:, 0]

    def project_corners(self) -> NDArray[np.float64]:
        """(views, 2, rows, columns, 2) pixels of the corners in camera and projector."""
        places, found = self.corner_places, []
        for pose, drift in zip(self.rt_cam_board, self.drift, strict=True):
            lit = compose(drift, compose(self.rig.rt_proj_cam, pose))
            found.append(
                [
                    lens.project(transform(rt, places))
                    for lens, rt in zip(self.lenses, (pose, lit), strict=True)
                ]
            )
        return np.array(found)

    def motion(self) -> ProjectorMotion:
        """How the projector moved from view to view."""
        views = len(self.drift)
        own = self._of_views()[:, 6:]
        apart = np.eye(views) - 1 / views
        relative = apart @ self.drift
        shared = self.covariance[self._first :, self._first :]
        turn, shift, moved = np.empty((3, views, 2))
        places = self.corner_places.reshape(-1, 3)
        for view, pose in enumerate(self.rt_cam_board):
            lever = np.zeros((6, len(shared)))
            for other in range(views):
                lever[np.arange(6), own[other]] = apart[view, other]
            spread = lever @ shared @ lever.T
            lit = transform(compose(self.rig.rt_proj_cam, pose), places)
            by_motion = motion_gradient(lit, self.rig.projector.project_with_gradient(lit)[1])
            seen = np.einsum("nik,k->ni", by_motion, relative[view])
            unsure = np.einsum("nik,kl,nil->n", by_motion, spread, by_motion)
            turn[view] = _length(relative[view, :3], spread[:3, :3])
            shift[view] = _length(relative[view, 3:], spread[3:, 3:])
            moved[view] = np.sqrt(np.mean(np.sum(seen**2, axis=1))), np.sqrt(np.mean(unsure))
        return ProjectorMotion(*turn.T, *shift.T, *moved.T)

    def projection_covariance(
        self, number: int, points: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Covariance of the pixels at which a lens sees points, as the solve leaves it.

        The points are fixed to the boards, on the mean over all of their poses, as of
        :func:`calibration.mrcal_covariance.projection_covariance`.

        Parameters
        ----------
        number : int
            0 is the camera, 1 the projector.
        points : (..., 3) array
            In the lens's frame, mm.

        Returns
        -------
        (..., 2, 2) float64 array
            Square pixels.
        """
        points = np.asarray(points, np.float64)
        flat, lens = points.reshape(-1, 3), self.lenses[number]
        gradient = lens.project_with_gradient(flat)[1]
        counts = [len(one.intrinsics) for one in self.lenses]
        lever = np.zeros((len(flat), 2, len(self.covariance)))
        start = 0 if number == 0 else counts[0]
        lever[..., start : start + counts[number]] = lens_gradient(lens, flat)
        of_views = self._of_views() + self._first
        in_camera, turned = flat, gradient
        if number == 1:
            pose = self.rig.rt_proj_cam
            own = motion_gradient(flat, gradient)
            lever[..., self._first - 6 : self._first] = own
            lever[..., of_views[:, 6:]] = own[:, :, np.newaxis] / len(of_views)
            in_camera, turned = transform(invert(pose), flat), gradient @ rotation(pose)
        by_board = motion_gradient(in_camera, turned)
        lever[..., of_views[:, :6]] = by_board[:, :, np.newaxis] / len(of_views)
        found = lever @ self.covariance @ np.swapaxes(lever, 1, 2)
        return np.asarray(found.reshape(*points.shape[:-1], 2, 2))

    @property
    def _first(self) -> int:
        """Where the views begin in :attr:`covariance`."""
        return len(self.covariance) - _PER_VIEW * len(self.drift)

    def _of_views(self) -> NDArray[np.int_]:
        """(views, 12) where each view's numbers stand, from the first of them."""
        return np.arange(_PER_VIEW * len(self.drift)).reshape(-1, _PER_VIEW)


def printed_skew(
    places: NDArray[np.float64],
    displacement: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> PrintedSkew:
    """Shear and stretch of a board's corners.

    Parameters
    ----------
    places : (n, 2) array
        Of the grid, mm.
    displacement : (n, 2) array
        Off it, mm.
    covariance : (2n, 2n) array
        Of the displacements, mm².
    """
    x, y = (places - places.mean(axis=0)).T
    lever = np.zeros((2, len(x), 2))
    lever[:, :, 0] = y / (y @ y), x / (x @ x)
    lever[:, :, 1] = x / (x @ x), -y / (y @ y)
    flat = lever.reshape(2, -1)
    shear, stretch = flat @ displacement.ravel()
    return PrintedSkew(float(shear), float(stretch), flat @ covariance @ flat.T)


def _length(step: NDArray[np.float64], spread: NDArray[np.float64]) -> tuple[float, float]:
    """Length of a vector, and its standard error along the vector."""
    length = float(np.linalg.norm(step))
    along = step / max(length, 1e-300)
    return length, float(np.sqrt(along @ spread @ along))
