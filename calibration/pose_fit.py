r"""The pose of a camera from points of known uncertainty, some of them wrong.

RANSAC over the smallest sets (M. A. Fischler, R. C. Bolles, CACM 24, 1981; the solver for three
points is OpenCV's AP3P) finds a start; weighted least squares by Levenberg and Marquardt with the
covariance of every residual, and without what lies far outside of it, finish. A pose changes by a
small turn and shift of the camera's frame, :math:`X' = X + \omega \times X + \tau`.

Residuals of neighbouring pairs may share an error that their noise does not tell of (a lens that is
not quite the right one). Sums of the gradient over tiles of the picture then scatter by more than
they should, and the covariance is scaled by that ratio where it cannot be chance.

A plane seen by a narrow lens looks nearly alike from two sides of its line of sight: the other pose
is tried, and if the pairs cannot tell which is right, this is an error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.code_pairs import CodePairs
from calibration.errors import RegistrationError
from calibration.lens import (
    OPENCV_MODELS,
    Lens,
    compose,
    invert,
    rotation,
    rt_from_matrix,
    transform,
)

_ROUNDS = 60
# Decrease of chi² that a step promises: the parameters' errors are thousands of times as large.
_CONVERGED = 1e-5
_RANSAC_ROUNDS = 2000
_RANSAC_PX = 4.0
# A lens that is to be refined may miss by more at first.
_UNREFINED_PX = 30.0
# Squares of residuals beyond this multiple of their variance are outliers; median of chi² with 2.
_OUTLIER = 4.0**2
_MEDIAN_CHI2 = 1.386
# Of a pixel, for what nothing accounts for.
_FLOOR_PX2 = 1e-6
_TILES = 8
_CHANCE = 1e-3
# Difference of chi² from which one of two poses is right.
_DECISIVE = 30.0
_INTRINSIC_STEP = 1e-6
_DETERMINED = 1e-13


@dataclass(frozen=True)
class PoseFit:
    """A fitted pose.

    Attributes
    ----------
    lens : Lens
        As given, or refined.
    rt_cam_ref : (6,) float64 array
        Takes points of the pairs' frame to the camera's.
    covariance : (n, n) float64 array
        Of a small turn (rad) and shift (mm) of the camera's frame, then of the lens's parameters
        if they were refined.
    inliers : (pairs,) bool array
    residuals_px : (pairs, 2) float64 array
        Seen minus fitted.
    inflation : float
        By which the variances were scaled beyond what the noise of the pairs explains.
    by_points : (n, pairs, 3) float64 array
        Derivative of the fitted parameters by the points; 0 for outliers.
    """

    lens: Lens
    rt_cam_ref: NDArray[np.float64]
    covariance: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    residuals_px: NDArray[np.float64]
    inflation: float
    by_points: NDArray[np.float64]


@dataclass(frozen=True)
class _System:
    """Residuals, their derivative by the free parameters, and their inverse covariance."""

    residuals: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    weight: NDArray[np.float64]

    @property
    def squares(self) -> NDArray[np.float64]:
        """(pairs,) squares of the residuals over their variance."""
        return self.squares_under(self.weight)

    def squares_under(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """(pairs,) squares of the residuals under inverse covariances (pairs, 2, 2)."""
        return np.einsum("ni,nij,nj->n", self.residuals, weight, self.residuals)

    def gradients(self) -> NDArray[np.float64]:
        """(pairs, parameters) terms of the gradient."""
        return np.einsum("nip,nij,nj->np", self.jacobian, self.weight, self.residuals)

    def normal(self, use: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Normal matrix of some of the pairs."""
        jacobian = self.jacobian[use]
        weighted = self.weight[use] @ jacobian
        return np.asarray(
            jacobian.reshape(-1, jacobian.shape[2]).T @ weighted.reshape(-1, jacobian.shape[2])
        )


def fit_pose(pairs: CodePairs, lens: Lens, *, refine_lens: bool = False) -> PoseFit:
    """Fit a camera's pose, and its lens if asked, to points and the pixels that see them.

    Parameters
    ----------
    pairs : CodePairs
    lens : Lens
        Of the camera.
    refine_lens : bool
        Whether its parameters are fitted too; ``lens`` is then where they start.

    Returns
    -------
    PoseFit

    Raises
    ------
    RegistrationError
        No pose explains a good part of the pairs, or two explain them alike, or the lens is of a
        family that cannot be refined.
    """
    if refine_lens and lens.model not in OPENCV_MODELS.values():
        raise RegistrationError(
            f"a lens of {lens.model} has too many parameters to be refined from one photograph; "
            "begin with one of OpenCV's models"
        )
    start = _consensus(pairs, lens, _UNREFINED_PX if refine_lens else _RANSAC_PX)
    found = _refined(pairs, lens, start, free_lens=refine_lens)
    other = _refined(
        pairs, found[0], _turned_over(found[1], pairs.points[found[2]]), free_lens=refine_lens
    )
    systems = [_system(pairs, fit[0], fit[1], refine_lens) for fit in (found, other)]
    costs = [float(np.minimum(s.squares, _OUTLIER).sum()) for s in systems]
    turn = rotation(compose(found[1], invert(other[1])))
    apart = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    scale = max(1.0, min(costs) / (2 * len(pairs)))
    explained = np.median(np.linalg.norm(systems[0].residuals, axis=1)) < _RANSAC_PX
    if explained and apart > 1e-3 and abs(costs[1] - costs[0]) / scale < _DECISIVE:
        raise RegistrationError(
            f"two poses, {np.degrees(apart):.1f}° apart, explain the photograph's code alike: the "
            "part of the surface that it shares with the scan is plane and too small to tell; show "
            "more of it, or come nearer"
        )
    best = int(costs[1] < costs[0])
    return _finished(pairs, *(found, other)[best], systems[best], refine_lens)


def _consensus(pairs: CodePairs, lens: Lens, within_px: float) -> NDArray[np.float64]:
    """A pose that the largest number of pairs agrees with, from sets of three and a fourth."""
    import cv2

    rays = lens.unproject(pairs.pixels)
    good = np.isfinite(rays).all(axis=1)
    if good.sum() < 4:
        raise RegistrationError("the lens has no viewing rays for the photograph's pixels")
    middle = pairs.points[good].mean(axis=0)
    found, turn, shift, _ = cv2.solvePnPRansac(
        np.ascontiguousarray(pairs.points[good] - middle),
        np.ascontiguousarray(rays[good, :2]),
        np.eye(3),
        np.zeros(4),
        iterationsCount=_RANSAC_ROUNDS,
        reprojectionError=within_px / float(lens.focal_px.mean()),
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    pose = np.concatenate([np.ravel(turn), np.ravel(shift)]) if found else np.full(6, np.nan)
    if not np.isfinite(pose).all():
        raise RegistrationError(
            f"no pose explains the {len(pairs)} pairs of photograph and scan: their codes "
            "contradict one another; was the projector or the painting moved in between?"
        )
    pose[3:] -= rotation(pose) @ middle
    return pose


def _refined(
    pairs: CodePairs, lens: Lens, pose: NDArray[np.float64], *, free_lens: bool
) -> tuple[Lens, NDArray[np.float64], NDArray[np.bool_]]:
    """Weighted least squares from a start, with outliers told anew in every round."""
    damping = 1e-4
    system = _system(pairs, lens, pose, free_lens)
    for _ in range(_ROUNDS):
        use = _inliers(system.squares)
        limit = _limit(system.squares)
        normal = system.normal(use)
        gradient = system.gradients()[use].sum(axis=0)
        scale = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
        values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
        along = (gradient / scale) @ vectors
        # What an undamped step would gain, along all that the pairs determine.
        known = values > _DETERMINED * values[-1]
        if np.sum(along[known] ** 2 / values[known]) < _CONVERGED * limit:
            break
        step = vectors @ (along / (np.maximum(values, 0) + damping)) / scale
        moved = _moved(lens, pose, step)
        trial = None if moved is None else _system(pairs, *moved, free_lens)
        cost = np.minimum(system.squares, limit).sum()
        # Under the weights by which the step was found: they change a little with the pose, and
        # the step that ends their gradient may lead up in squares under other ones.
        after = np.inf
        if trial is not None:
            after = np.minimum(trial.squares_under(system.weight), limit).sum()
        if not after <= cost * (1 + 1e-12):
            damping *= 10
            if damping > 1e8:
                break
            continue
        assert moved is not None
        assert trial is not None
        lens, pose, system = *moved, trial
        damping = max(0.01 * damping, 1e-14)
    return lens, pose, _inliers(system.squares)


def _limit(squares: NDArray[np.float64]) -> float:
    """Above which residuals are outliers: wider as long as the fit is poor."""
    return _OUTLIER * max(1.0, float(np.median(squares)) / _MEDIAN_CHI2)


def _inliers(squares: NDArray[np.float64]) -> NDArray[np.bool_]:
    return squares < _limit(squares)


def _moved(
    lens: Lens, pose: NDArray[np.float64], step: NDArray[np.float64]
) -> tuple[Lens, NDArray[np.float64]] | None:
    """Lens and pose after a step; None if there is no such lens."""
    if len(step) > 6:
        intrinsics = lens.intrinsics + step[6:]
        if not (np.isfinite(intrinsics).all() and (intrinsics[:2] > 0).all()):
            return None
        lens = replace(lens, intrinsics=intrinsics)
    return lens, compose(step[:6], pose)


def _system(pairs: CodePairs, lens: Lens, pose: NDArray[np.float64], free_lens: bool) -> _System:
    points = transform(pose, pairs.points)
    behind = ~(points[:, 2] > 0)
    points[behind] = (0, 0, 1)
    pixels, gradient = lens.project_with_gradient(points)
    lever = gradient @ rotation(pose)
    covariance = lever @ pairs.covariance @ np.swapaxes(lever, 1, 2) + _FLOOR_PX2 * np.eye(2)
    weight = _inverse2(covariance)
    # Points behind the camera are outliers, whatever else they are.
    residuals = np.where(behind[:, np.newaxis], 1e9, pairs.pixels - pixels)
    return _System(residuals, pose_derivative(lens, points, free_lens=free_lens), weight)


def _inverse2(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverses (n, 2, 2) of symmetric matrices."""
    a, b, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    adjugate = np.stack([d, -b, -b, a], axis=1).reshape(-1, 2, 2)
    return np.asarray(adjugate / (a * d - b * b)[:, np.newaxis, np.newaxis])


def pose_derivative(
    lens: Lens, points: NDArray[np.float64], *, free_lens: bool
) -> NDArray[np.float64]:
    """Derivative (points, 2, parameters) of pixels by a camera's turn and shift, and by its lens.

    Parameters
    ----------
    lens : Lens
    points : (n, 3) array
        In the camera's frame, mm.
    free_lens : bool
        Whether the lens's parameters follow the turn (rad) and the shift (mm).
    """
    gradient = lens.project_with_gradient(points)[1]
    across = np.zeros((len(points), 3, 3))
    for row, column, of, sign in ((0, 1, 2, 1), (0, 2, 1, -1), (1, 2, 0, 1)):
        across[:, row, column] = sign * points[:, of]
        across[:, column, row] = -sign * points[:, of]
    parts = [gradient @ across, gradient]
    if free_lens:
        parts.append(_by_intrinsics(lens, points))
    return np.concatenate(parts, axis=2)


def _by_intrinsics(lens: Lens, points: NDArray[np.float64]) -> NDArray[np.float64]:
    columns = []
    for number, value in enumerate(lens.intrinsics):
        step = _INTRINSIC_STEP * max(1.0, abs(value))
        ends = []
        for sign in (1, -1):
            intrinsics = lens.intrinsics.copy()
            intrinsics[number] += sign * step
            ends.append(replace(lens, intrinsics=intrinsics).project(points))
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(columns, axis=2)


def _turned_over(pose: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The pose from which a plane looks nearly the same: its normal reflected in the sight."""
    seen = transform(pose, points)
    middle = seen.mean(axis=0)
    normal = np.linalg.svd(seen - middle, full_matrices=False)[2][2]
    sight = middle / np.linalg.norm(middle)
    normal = normal * np.sign(normal @ sight)
    # Two reflections, at the normal and at the sight, turn one tilt into the other.
    about = np.eye(3) - 2 * np.outer(normal, normal)
    turn = np.asarray((np.eye(3) - 2 * np.outer(sight, sight)) @ about, np.float64)
    return compose(rt_from_matrix(turn, middle - turn @ middle), pose)


def _finished(
    pairs: CodePairs,
    lens: Lens,
    pose: NDArray[np.float64],
    inliers: NDArray[np.bool_],
    system: _System,
    free_lens: bool,
) -> PoseFit:
    normal = system.normal(inliers)
    scale = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    covariance = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-15, hermitian=True)
    inflation = _inflation(pairs.pixels, system, inliers)
    covariance = covariance / np.outer(scale, scale)
    lever = _by_point(lens, transform(pose, pairs.points)) @ rotation(pose)
    by_points = -np.einsum(
        "pq,niq,nij,njk->pnk", covariance, system.jacobian, system.weight, lever, optimize=True
    )
    by_points[:, ~inliers] = 0
    return PoseFit(
        lens, pose, inflation * covariance, inliers, system.residuals, inflation, by_points
    )


def _by_point(lens: Lens, points: NDArray[np.float64]) -> NDArray[np.float64]:
    ahead = points.copy()
    ahead[~(points[:, 2] > 0)] = (0, 0, 1)
    return lens.project_with_gradient(ahead)[1]


def pixel_covariance(
    lens: Lens,
    rt_cam_ref: NDArray[np.float64],
    covariance: NDArray[np.float64],
    points: NDArray[np.float64],
) -> NDArray[np.float64]:
    """By how much an uncertain pose, and lens, misplace points in the picture.

    Parameters
    ----------
    lens : Lens
    rt_cam_ref : (6,) array
    covariance : (n, n) array
        As of :class:`PoseFit`; 6 × 6 if the lens is exact.
    points : (k, 3) array
        Before the camera, in the reference frame.

    Returns
    -------
    (k, 2, 2) float64 array
        Square pixels.
    """
    seen = transform(rt_cam_ref, np.asarray(points, np.float64))
    if not (seen[:, 2] > 0).all():
        raise RegistrationError("points behind the camera have no place in its picture")
    jacobian = pose_derivative(lens, seen, free_lens=len(covariance) > 6)
    return np.asarray(jacobian @ covariance @ np.swapaxes(jacobian, 1, 2))


def _inflation(pixels: NDArray[np.float64], system: _System, inliers: NDArray[np.bool_]) -> float:
    """How much more the tiles of the picture disagree than they should; 1 if by chance."""
    from scipy.stats import chi2

    parameters = system.jacobian.shape[2]
    low, high = pixels[inliers].min(axis=0), pixels[inliers].max(axis=0)
    place = np.minimum((pixels - low) / (high - low + 1e-9) * _TILES, _TILES - 1)
    tile = np.where(inliers, place.astype(int) @ [1, _TILES], -1)
    gradients = system.gradients()
    total, freedom = 0.0, -parameters
    for number in np.unique(tile[tile >= 0]):
        here = tile == number
        normal = system.normal(here)
        scale = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
        values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
        strong = values > 1e-9 * values[-1]
        along = (gradients[here].sum(axis=0) / scale) @ vectors[:, strong]
        total += float(np.sum(along**2 / values[strong]))
        freedom += int(strong.sum())
    if freedom < 1 or chi2.sf(total, freedom) > _CHANCE:
        return 1.0
    return total / freedom
