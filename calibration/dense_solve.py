r"""Camera and projector solved from every decoded pixel of a board, and not from its corners alone.

Corners tell the board's scale, but they are few, each is read off where the code is worst, and a
lens that three or four poses of them determine takes up their errors as focal length, centre and
distortion. Between them lie thousands of pixels whose projector coordinates are read well. A pixel
says nothing of where on the board it lies; but all poses see one surface, so each of them has to
meet its two coordinates at the depth of that surface: one equation that holds for any surface (the
ray of the camera meets that of the projector) and one that holds for the same surface in all poses.

Unknown are both lenses, the pose between them, the poses of the board, its relief (a spline,
:mod:`calibration.board_surface`), the place of every corner in the board's plane, and how far the
projector moved from view to view: the first equation tells a ten-thousandth of a radian of it,
which a solve from corners takes for lenses. The residuals are those of

* the mean coordinates of blocks of white pixels, columns and rows, projected from where the
  camera's ray meets the surface, and
* the corners as the camera sees them, which hold scale, rotation and shift in the board's plane.

Blocks are weighted by what they really leave: their own noise, what is left beyond it, and how far
neighbours err alike. This is bundle adjustment with a shape common to the views (Albarelli, Rodolà
& Torsello 2010, "Robust camera calibration using inaccurate targets"), on a dense code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from acquisition.robust_spread import nan_robust_sigma
from calibration.board_shape import shears, similarities
from calibration.board_surface import SplineGrid
from calibration.boards import Chessboard
from calibration.dense_equations import (
    DenseProblem,
    DenseState,
    Equations,
    blocks_of,
    corner_equations,
    surface_equations,
)
from calibration.dense_solution import DenseSolution, printed_skew
from calibration.errors import CalibrationError
from calibration.lens import compose
from calibration.rig_geometry import RigGeometry
from calibration.surface_samples import SurfaceSamples

# Tukey's limit in each round: before a blister is fitted it looks like gross error.
_REACHES = (60.0, 60.0, 20.0, 10.0, 5.0)
_STEPS = 8
_SETTLED = 1e-3
_HELD = 1e5
# Fewer corners of a view do not tell its place on the board.
_LEAST_CORNERS = 4
_UNDETERMINED = (
    "the surface of the board does not determine the rig; record more poses of it, tilted to all "
    "four sides"
)


def solve_densely(
    rig: RigGeometry,
    rt_cam_board: NDArray[np.float64],
    board: Chessboard,
    corners: Sequence[NDArray[np.float64]],
    samples: Sequence[SurfaceSamples],
    *,
    knots_per_square: float = 2.0,
) -> DenseSolution:
    """Solve lenses and poses from the surface of a board that all views share.

    Parameters
    ----------
    rig : RigGeometry
        Of a solve from corners: where this one starts.
    rt_cam_board : (views, 6) array
        Poses of the board, by the same solve.
    board : Chessboard
    corners : sequence of (rows, columns, 2) arrays
        As the camera sees them, full frame, counted from the same end in every view; NaN where one
        is not seen.
    samples : sequence of SurfaceSamples
    knots_per_square : float
        How finely the relief is resolved.

    Raises
    ------
    CalibrationError
        Fewer than three views, or views that do not determine the rig.
    """
    if not 3 <= len(rt_cam_board) == len(corners) == len(samples):
        raise CalibrationError(
            f"{len(rt_cam_board)} poses, {len(corners)} views of corners and {len(samples)} of the "
            "surface: three of each are needed at least"
        )
    grid = SplineGrid.over(board, knots_per_square=knots_per_square)
    state = DenseState(
        rig,
        np.array(rt_cam_board, np.float64),
        np.zeros((len(rt_cam_board), 6)),
        np.zeros(grid.size),
        np.zeros((board.rows, board.columns, 2)),
    )
    problem = DenseProblem(board, grid, tuple(corners), tuple(samples))
    _check_seen(problem)
    for reach in _REACHES:
        weights = _weights(problem, state, reach)
        for _ in range(_STEPS):
            normal, right = _normal_equations(problem, state, weights)
            try:
                factor = cho_factor(normal)
                step = cho_solve(factor, right)
                state = state.moved(step)
            # A step that leads to no lens is one of views that determine none.
            except (np.linalg.LinAlgError, CalibrationError) as error:
                raise CalibrationError(_UNDETERMINED) from error
            if not (np.isfinite(state.rig.parameters).all() and np.isfinite(state.poses).all()):
                raise CalibrationError(_UNDETERMINED)
            if float(step @ right) < _SETTLED * len(step):
                break
        covariance = cho_solve(factor, np.eye(len(normal)))
        problem = problem.with_priors_of(state, covariance)
    return _solved(problem, state, covariance)


def _check_seen(problem: DenseProblem) -> None:
    for number, (corners, samples) in enumerate(
        zip(problem.corners, problem.samples, strict=True), start=1
    ):
        seen = int(np.isfinite(corners).all(axis=-1).sum())
        if seen < _LEAST_CORNERS:
            raise CalibrationError(
                f"view {number} has {seen} corners of the board, and {_LEAST_CORNERS} are needed"
            )
        if not (np.isfinite(samples.variance) & (samples.variance > 0)).all():
            raise CalibrationError(
                f"view {number} has blocks of the surface without a positive variance; decode it "
                "again"
            )


@dataclass(frozen=True)
class _Weights:
    """Standard deviations that the residuals show."""

    floor_px: NDArray[np.float64]  # (2,), beyond the noise of the pixels
    alike: NDArray[np.float64]  # (2,), by how much neighbours err alike, as a variance
    corner_px: float
    reach: float  # of Tukey's function, in standard deviations


def _robust(
    residual: NDArray[np.float64], sigma: NDArray[np.float64], reach: float
) -> NDArray[np.float64]:
    """Tukey's weights; a coordinate that is off takes the other with it."""
    share = np.clip(1 - (residual / (reach * sigma)) ** 2, 0, None)
    return np.repeat(np.nan_to_num(share.min(axis=-1, keepdims=True)), 2, axis=-1)


def _weights(problem: DenseProblem, state: DenseState, reach: float) -> _Weights:
    """Of all views together: a view weighed by its own residuals alone could be given up."""
    views = range(len(state.poses))
    left = [surface_equations(problem, state, v, derivatives=False).residual for v in views]
    noise = np.median(np.concatenate([s.variance for s in problem.samples]), axis=0)
    floor = np.sqrt(np.maximum(nan_robust_sigma(np.concatenate(left), axis=0) ** 2 - noise, 0))
    means = []
    for residual, samples in zip(left, problem.samples, strict=True):
        sigma = np.sqrt(samples.variance + floor**2)
        weight = _robust(residual, sigma, reach) / sigma**2
        _, tile = np.unique(samples.tile, return_inverse=True)
        for k in (0, 1):
            total = np.bincount(tile, weight[:, k])
            summed = np.bincount(tile, weight[:, k] * np.nan_to_num(residual[:, k]))
            means.append((k, summed[total > 0] ** 2 / total[total > 0]))
    alike = [
        max(1.0, float(np.mean(np.concatenate([m for axis, m in means if axis == k]))))
        for k in (0, 1)
    ]
    corners = np.concatenate([corner_equations(problem, state, v).residual for v in views])
    # Each corner's place is fitted to one residual in so many.
    spent = len(views) / (len(views) - 1)
    corner = float(np.sqrt(np.mean(nan_robust_sigma(corners, axis=0) ** 2) * spent))
    return _Weights(floor, np.array(alike), corner, reach)


def _normal_equations(
    problem: DenseProblem, state: DenseState, weights: _Weights
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rig, poses, relief, place = blocks_of(state)
    normal = np.zeros((place.stop, place.stop))
    right = np.zeros(place.stop)
    for view, samples in enumerate(problem.samples):
        surface = surface_equations(problem, state, view)
        sigma = np.sqrt(samples.variance + weights.floor_px**2)
        weight = _robust(surface.residual, sigma, weights.reach) / (sigma**2 * weights.alike)
        seen = corner_equations(problem, state, view)
        corner = np.full(seen.residual.shape, weights.corner_px)
        pairs = (
            (surface, weight),
            (seen, _robust(seen.residual, corner, weights.reach) / corner**2),
        )
        for equations, each in pairs:
            _add(normal, right, equations, each, (rig, poses, relief, place), view)
    _add_priors(problem, state, normal, right)
    return normal, right


def _add(
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    equations: Equations,
    weight: NDArray[np.float64],
    blocks: tuple[slice, slice, slice, slice],
    view: int,
) -> None:
    rig, poses, relief, place = blocks
    known = np.isfinite(equations.residual).all(axis=-1) & (weight > 0).all(axis=-1)
    count = int(known.sum())
    if count == 0:  # the rig has left it, or the board turned its back
        raise CalibrationError(_UNDETERMINED)
    root = np.sqrt(weight[known])[..., None]
    residual = (equations.residual[known][..., None] * root).ravel()
    dense = np.concatenate([equations.rig, equations.view], axis=-1)[known] * root
    dense = dense.reshape(2 * count, -1)
    value = equations.relief[known][..., None] * equations.basis[known][:, None, :] * root
    column = np.repeat(equations.index[known][:, None, :], 2, axis=1)
    row = np.repeat(np.arange(2 * count), value.shape[-1])
    parts = [(value.ravel(), row, column.ravel())]
    size = relief.stop - relief.start
    if equations.place is not None:
        own = 2 * np.flatnonzero(known)[:, None, None] + np.arange(2)
        own = np.broadcast_to(own, (count, 2, 2))
        moved = equations.place[known] * root
        parts.append((moved.ravel(), np.repeat(np.arange(2 * count), 2), size + own.ravel()))
    values, rows, columns = (np.concatenate([p[k] for p in parts]) for k in range(3))
    width = size + place.stop - place.start
    thin = sparse.csr_matrix((values, (rows, columns)), shape=(2 * count, width))
    at = np.r_[np.arange(rig.start, rig.stop), poses.start + 12 * view + np.arange(12)]
    normal[np.ix_(at, at)] += dense.T @ dense
    cross = np.asarray(thin.T @ dense)
    normal[relief.start :, at] += cross
    normal[np.ix_(at, np.arange(relief.start, place.stop))] += cross.T
    normal[relief.start :, relief.start :] += (thin.T @ thin).toarray()
    right[at] += dense.T @ residual
    right[relief.start :] += thin.T @ residual


def _add_priors(
    problem: DenseProblem,
    state: DenseState,
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
) -> None:
    _, poses, relief, place = blocks_of(state)
    for view, drift in enumerate(state.drift):
        own = poses.start + 12 * view + 6 + np.arange(6)
        normal[own, own] += 1 / problem.drift**2
        right[own] -= drift / problem.drift**2
    rough = problem.grid.roughness() / problem.roughness_mm
    # The plane of the relief is that of the poses.
    points = problem.board.points.reshape(-1, 3)
    plane = np.linalg.qr(np.column_stack([np.ones(len(points)), points[:, :2]]))[0]
    index, basis = problem.grid.basis(points[:, :2])
    at_corners = np.zeros((len(points), problem.grid.size))
    np.put_along_axis(at_corners, index, basis[..., 0], axis=1)
    held = _HELD * plane.T @ at_corners
    normal[relief, relief] += (rough.T @ rough).toarray() + held.T @ held
    right[relief] -= rough.T @ (rough @ state.relief) + held.T @ (held @ state.relief)
    # What no sample reaches has no height.
    normal[relief, relief] += 1e-4 * np.eye(problem.grid.size)
    right[relief] -= 1e-4 * state.relief
    # Pose and size of the corners are not theirs to take; their shear, however large, is.
    same = similarities(points[:, :2]).reshape(-1, 4)
    sheared = shears(points[:, :2]).reshape(-1, 2)
    each = np.eye(len(same)) - sheared @ sheared.T
    pinned = _HELD**2 * same @ same.T + each / problem.displacement_mm**2
    normal[place, place] += pinned
    right[place] -= pinned @ state.displacement.ravel()


def _solved(
    problem: DenseProblem, state: DenseState, covariance: NDArray[np.float64]
) -> DenseSolution:
    rig, poses, relief, place = blocks_of(state)
    count = state.lens_parameters
    step = 1e-6
    turned = np.empty((6, 6))
    for k in range(6):
        ends = [compose(sign * step * np.eye(6)[k], state.rig.rt_proj_cam) for sign in (1, -1)]
        turned[:, k] = (ends[0] - ends[1]) / (2 * step)
    lever = np.eye(rig.stop)
    lever[count:, count:] = turned
    found = lever @ covariance[rig, rig] @ lever.T
    views = range(len(state.poses))
    left = [surface_equations(problem, state, v, derivatives=False).residual for v in views]
    seen = [corner_equations(problem, state, v).residual for v in views]
    grid = problem.board.points.reshape(-1, 3)[:, :2]
    placed = covariance[place, place]
    index, basis = problem.grid.basis(grid + state.displacement.reshape(-1, 2))
    height = basis[..., 0]
    own = covariance[relief, relief][index[:, :, np.newaxis], index[:, np.newaxis, :]]
    sigma = np.column_stack(
        [
            np.sqrt(np.diagonal(placed)).reshape(-1, 2),
            np.sqrt(np.einsum("nk,nkl,nl->n", height, own, height)),
        ]
    )
    kept = slice(0, poses.stop)
    return DenseSolution(
        rig=replace(state.rig, covariance=(found + found.T) / 2),
        rt_cam_board=state.poses,
        drift=state.drift,
        problem=problem,
        relief=state.relief,
        displacement_mm=state.displacement,
        corner_sigma_mm=sigma.reshape(problem.board.points.shape),
        skew=printed_skew(grid, state.displacement.reshape(-1, 2), placed),
        covariance=covariance[kept, kept],
        sample_rms_px=np.array([nan_robust_sigma(residual, axis=0) for residual in left]),
        corner_rms_px=np.array([np.sqrt(np.mean(nan_robust_sigma(r, axis=0) ** 2)) for r in seen]),
    )
