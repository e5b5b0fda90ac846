"""Equations of the surface of a board that several views share: residuals and their derivatives.

See :mod:`calibration.dense_solve`, which solves them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibration.board_shape import shears
from calibration.board_surface import SplineGrid
from calibration.boards import Chessboard
from calibration.lens import Lens, compose, rotation, transform
from calibration.rig_geometry import RigGeometry
from calibration.surface_samples import SurfaceSamples

_MEETINGS = 5
_FIRST_DISPLACEMENT_MM = 0.02
_FIRST_ROUGHNESS_MM = 0.05
# A turn of the projector from view to view in radians, and a shift in mm.
_FIRST_DRIFT = (1e-4, 0.03)


@dataclass(frozen=True)
class DenseState:
    """The unknowns.

    Attributes
    ----------
    rig : RigGeometry
    poses, drift : (views, 6) float64 array
        Of the board in the camera's frame, and of the projector from its usual pose.
    relief : (grid.size,) float64 array
        Coefficients of the board's height, mm.
    displacement : (rows, columns, 2) float64 array
        Of the corners in the board's plane, mm.
    """

    rig: RigGeometry
    poses: NDArray[np.float64]
    drift: NDArray[np.float64]
    relief: NDArray[np.float64]
    displacement: NDArray[np.float64]

    @property
    def lens_parameters(self) -> int:
        """How many numbers both lenses have."""
        return len(self.rig.parameters) - 6

    def moved(self, step: NDArray[np.float64]) -> DenseState:
        """The state after a step; poses turn and shift in the frame that they lead to."""
        lenses, rest = np.split(step, [self.lens_parameters])
        pose, rest = np.split(rest, [6])
        poses, rest = np.split(rest, [self.poses.size + self.drift.size])
        poses, drift = np.split(poses.reshape(-1, 12), 2, axis=1)
        relief, displacement = np.split(rest, [len(self.relief)])
        rig = self.rig.moved(np.concatenate([lenses, np.zeros(6)]))
        return DenseState(
            replace(rig, rt_proj_cam=compose(pose, rig.rt_proj_cam)),
            np.array([compose(s, p) for s, p in zip(poses, self.poses, strict=True)]),
            np.array([compose(s, d) for s, d in zip(drift, self.drift, strict=True)]),
            self.relief + relief,
            self.displacement + displacement.reshape(self.displacement.shape),
        )


@dataclass(frozen=True)
class DenseProblem:
    """What was seen, and what is thought of the unknowns beforehand.

    Attributes
    ----------
    board : Chessboard
    grid : SplineGrid
    corners : tuple of (rows, columns, 2) arrays
        In the camera's pixels; NaN where one is not seen.
    samples : tuple of SurfaceSamples
    roughness_mm, displacement_mm : float
        Standard deviations of the relief's bends and of the corners' places.
    drift : (6,) float64 array
        Standard deviations of the projector's turns and shifts.
    """

    board: Chessboard
    grid: SplineGrid
    corners: tuple[NDArray[np.float64], ...]
    samples: tuple[SurfaceSamples, ...]
    roughness_mm: float = _FIRST_ROUGHNESS_MM
    displacement_mm: float = _FIRST_DISPLACEMENT_MM
    drift: NDArray[np.float64] = field(default_factory=lambda: np.repeat(_FIRST_DRIFT, 3))

    def with_priors_of(self, state: DenseState, covariance: NDArray[np.float64]) -> DenseProblem:
        """With the variances that the unknowns show, and what their priors hide."""
        _, poses, relief, place = blocks_of(state)
        rough = self.grid.roughness()
        hidden = rough.multiply(rough @ covariance[relief, relief]).sum() / rough.shape[0]
        own = float(np.mean((rough @ state.relief) ** 2) + hidden)
        sheared = shears(self.board.points.reshape(-1, 3)[:, :2]).reshape(-1, 2)
        flat = state.displacement.ravel()
        flat = flat - sheared @ (sheared.T @ flat)
        shown = np.mean(flat**2) + np.mean(np.diag(covariance)[place])
        unsure = np.diag(covariance)[poses].reshape(len(state.poses), 12)[:, 6:]
        moved = (state.drift**2 + unsure).reshape(-1, 2, 3).mean(axis=(0, 2))
        return replace(
            self,
            roughness_mm=max(np.sqrt(own), 1e-5),
            displacement_mm=float(np.sqrt(shown)),
            drift=np.repeat(np.maximum(np.sqrt(moved), _FIRST_DRIFT), 3),
        )


def blocks_of(state: DenseState) -> tuple[slice, slice, slice, slice]:
    """Where rig, poses with drifts, relief and displacements stand in a step.

    Of each view the board's pose stands first, then the projector's drift.
    """
    ends = np.cumsum(
        [
            state.lens_parameters + 6,
            state.poses.size + state.drift.size,
            len(state.relief),
            state.displacement.size,
        ]
    )
    return tuple(slice(int(a), int(b)) for a, b in zip([0, *ends], ends, strict=False))  # type: ignore[return-value]


@dataclass(frozen=True)
class Equations:
    """Residuals of one view and their derivatives.

    Attributes
    ----------
    residual : (n, 2) float64 array
        Pixels; NaN where nothing was seen.
    rig : (n, 2, parameters + 6) float64 array
        By the lenses, and by the pose between them.
    view : (n, 2, 12) float64 array
        By the board's pose and the projector's drift.
    relief : (n, 2) float64 array
        By the height.
    index : (n, 16) int array
        Coefficients that the height is made of.
    basis : (n, 16) float64 array
        How much of each.
    place : (n, 2, 2) float64 array or None
        By the corner's displacement; None of what is no corner.
    """

    residual: NDArray[np.float64]
    rig: NDArray[np.float64]
    view: NDArray[np.float64]
    relief: NDArray[np.float64]
    index: NDArray[np.int_]
    basis: NDArray[np.float64]
    place: NDArray[np.float64] | None = None


def surface_equations(
    problem: DenseProblem, state: DenseState, view: int, *, derivatives: bool = True
) -> Equations:
    """Of the mean coordinates of blocks, where the camera's rays meet the surface.

    Without derivatives only the residual is of use.
    """
    samples, pose, rig = problem.samples[view], state.poses[view], state.rig
    ray = rig.camera.unproject(samples.pixels)
    turn = rotation(pose)
    start, along = -turn.T @ pose[3:], ray @ turn
    depth = -start[2] / along[:, 2]
    for _ in range(_MEETINGS):
        at = start + depth[:, None] * along
        height = problem.grid.heights(state.relief, at[:, :2])
        normal = np.column_stack([-height[:, 1:], np.ones(len(at))])
        facing = np.einsum("ni,ni->n", along, normal)
        depth = depth - (at[:, 2] - height[:, 0]) / facing
    point = depth[:, None] * ray
    usual, drift = transform(rig.rt_proj_cam, point), state.drift[view]
    lit = transform(drift, usual)
    pixels, gradient = rig.projector.project_with_gradient(lit)
    residual = samples.coordinates - pixels
    index, basis = problem.grid.basis(at[:, :2])
    nothing = np.zeros((len(ray), 2, 0))
    if not derivatives:
        return Equations(residual, nothing, nothing, residual, index, basis[..., 0])
    before = gradient @ rotation(drift)
    by_point = before @ rotation(rig.rt_proj_cam)
    by_depth = np.einsum("nij,nj->ni", by_point, ray)
    towards = normal @ turn.T
    # Moving the surface by d moves the point along the ray by N·d / N·ray.
    surface = by_depth[:, :, None] * (towards / facing[:, None])[:, None, :]
    _, bend = rig.camera.project_with_gradient(ray)
    slope = -np.linalg.solve(bend[..., :2], lens_gradient(rig.camera, ray))
    by_ray = depth[:, None, None] * (by_point - surface)[..., :2]
    return Equations(
        residual,
        np.concatenate(
            [by_ray @ slope, lens_gradient(rig.projector, lit), motion_gradient(usual, before)],
            axis=-1,
        ),
        np.concatenate([motion_gradient(point, surface), motion_gradient(lit, gradient)], axis=-1),
        by_depth / facing[:, None],
        index,
        basis[..., 0],
    )


def corner_equations(problem: DenseProblem, state: DenseState, view: int) -> Equations:
    """Of the corners in the camera."""
    pose, rig = state.poses[view], state.rig
    points = problem.board.points.reshape(-1, 3).copy()
    points[:, :2] += state.displacement.reshape(-1, 2)
    index, basis = problem.grid.basis(points[:, :2])
    height = np.einsum("nk,nkj->nj", state.relief[index], basis)
    points[:, 2] = height[:, 0]
    here = transform(pose, points)
    pixels, gradient = rig.camera.project_with_gradient(here)
    on_board = gradient @ rotation(pose)
    by_rig = np.zeros((len(points), 2, state.lens_parameters + 6))
    count = len(rig.camera.intrinsics)
    by_rig[..., :count] = lens_gradient(rig.camera, here)
    by_place = on_board[..., :2] + on_board[..., 2:] * height[:, None, 1:]
    return Equations(
        problem.corners[view].reshape(-1, 2) - pixels,
        by_rig,
        np.concatenate([motion_gradient(here, gradient), np.zeros((len(points), 2, 6))], axis=-1),
        on_board[..., 2],
        index,
        basis[..., 0],
        by_place,
    )


def lens_gradient(lens: Lens, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative (n, 2, parameters) of pixels by the lens's parameters, of points (n, 3)."""
    gradient = np.empty((len(points), 2, len(lens.intrinsics)))
    for number, value in enumerate(lens.intrinsics):
        step = 1e-5 * max(1.0, abs(value))
        ends = []
        for sign in (1, -1):
            intrinsics = lens.intrinsics.copy()
            intrinsics[number] += sign * step
            ends.append(replace(lens, intrinsics=intrinsics).project(points))
        gradient[..., number] = (ends[0] - ends[1]) / (2 * step)
    return gradient


def motion_gradient(
    points: NDArray[np.float64], gradient: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derivative (n, i, 6) of what has a gradient (n, i, 3) by a turn and shift of points."""
    return np.concatenate([np.cross(points[:, None, :], gradient), gradient], axis=-1)
