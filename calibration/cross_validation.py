"""Cross-validation: a calibration is judged by board poses that it has not seen.

A richer lens model always leaves smaller residuals. Whether it is a better lens shows on a pose
that was held out: with the lenses and the pose between them held, only the board's own pose is
fitted to it. The simplest model within one standard error of the best is taken (Breiman et al.
1984). And two calibrations from disjoint halves of the views show how far they differ over the
image at the working distance, once the rigid motion that calibrations are free to differ by is
removed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from acquisition.plan import Imager
from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.errors import CalibrationError
from calibration.lens import Lens, compose, transform
from calibration.mrcal_solution import LensSolution
from calibration.mrcal_solve import OUTLIER_SIGMAS, solve_lenses, solve_without

_FOLDS = 5
_ROUNDS = 30
_MOST_LEFT_OUT = 0.05


@dataclass(frozen=True)
class FittedPose:
    """A board's pose with the lenses held.

    Attributes
    ----------
    rt_ref_board : (6,) float64 array
    residuals_px : (lenses, rows, columns, 2) float64 array
        Projected less observed corners; NaN where not seen, or left out.
    weighted_rms : float
        Root mean square of the residuals over their ``sigma_px``, corrected for the pose.
    """

    rt_ref_board: NDArray[np.float64]
    residuals_px: NDArray[np.float64]
    weighted_rms: float

    @property
    def rms_per_point_px(self) -> float:
        """Root mean square distance of projected and observed corners."""
        squares = np.sum(self.residuals_px**2, axis=-1)
        return float(np.sqrt(np.nanmean(squares)))


@dataclass(frozen=True)
class ModelScore:
    """Held-out residuals of a lens model.

    Attributes
    ----------
    model : str
    heldout : (views,) float64 array
        Weighted RMS of each view, held out once.
    sigma0 : float
        The same of the views that were solved from, corrected for what was fitted: a held-out view
        leaves as much if the model is true and the views determine it.
    why : str
        Why the model could not be solved; empty if it could.
    """

    model: str
    heldout: NDArray[np.float64]
    sigma0: float = float("nan")
    why: str = ""

    @property
    def heldout_over_noise(self) -> NDArray[np.float64]:
        """(views,) residuals of each view, held out once, over the noise that the others show."""
        return self.heldout / self.sigma0

    @property
    def mean(self) -> float:
        """Root mean square over the views; infinite for a model that could not be solved."""
        return float("inf") if self.why else float(np.sqrt(np.mean(self.heldout**2)))

    @property
    def standard_error(self) -> float:
        """Standard error of :attr:`mean`."""
        if self.why or len(self.heldout) < 2:
            return float("inf")
        spread = np.std(self.heldout**2, ddof=1) / np.sqrt(len(self.heldout))
        return float(spread / (2 * self.mean)) if self.mean > 0 else 0.0


@dataclass(frozen=True)
class ModelChoice:
    """Lens models compared, and the one that was taken."""

    scores: tuple[ModelScore, ...]
    chosen: str

    @property
    def score(self) -> ModelScore:
        """Of the model that was taken."""
        return next(score for score in self.scores if score.model == self.chosen)


def fit_board_pose(
    lenses: tuple[Lens, ...],
    rt_lens_ref: NDArray[np.float64],
    view: BoardView,
    points: NDArray[np.float64],
    *,
    outlier_sigmas: float = np.inf,
) -> FittedPose:
    """Pose of a board that best explains a view, with the lenses held.

    Parameters
    ----------
    lenses : tuple of Lens
        The first must see the board.
    rt_lens_ref : (lenses, 6) array
    view : BoardView
    points : (rows, columns, 3) array
        Corners in the board's frame, mm.
    outlier_sigmas : float
        Weighted residual, over the root mean square of all, beyond which a corner is left out, as
        in a solve; but if that is more than a twentieth of them, or two are neighbours, none is: a
        board that is bent there, or a lens that is wrong there, shows in neighbours.

    Raises
    ------
    CalibrationError
        Too few corners, or a pose that does not converge.
    """
    pose = _first_pose(lenses[0], view, points)
    pose = _refined(lenses, rt_lens_ref, view, points, pose)
    whole = fitted = _fitted(lenses, rt_lens_ref, view, points, pose)
    most = _MOST_LEFT_OUT * view.seen.any(axis=0).sum()
    kept, left_out = view, np.zeros(points.shape[:2], np.bool_)
    while (gross := _gross(kept, fitted, outlier_sigmas)).any():
        kept, left_out = kept.without(gross), left_out | gross
        apart = label(left_out, np.ones((3, 3)))[1]
        if left_out.sum() > min(most, apart):
            return whole
        pose = _refined(lenses, rt_lens_ref, kept, points, fitted.rt_ref_board)
        fitted = _fitted(lenses, rt_lens_ref, kept, points, pose)
    return fitted


def _gross(view: BoardView, fitted: FittedPose, outlier_sigmas: float) -> NDArray[np.bool_]:
    """Corners (rows, columns) that lie too far from where a pose has them in some lens."""
    weighted = np.abs(fitted.residuals_px) / np.stack(view.sigma_px)[..., np.newaxis]
    limit = outlier_sigmas * fitted.weighted_rms
    return np.asarray((weighted > limit).any(axis=(0, 3)), np.bool_)


def choose_model(
    views: list[BoardView],
    board: Chessboard,
    imagers: list[Imager],
    models: Sequence[str],
    *,
    outlier_sigmas: float = OUTLIER_SIGMAS,
) -> ModelChoice:
    """Compare lens models by held-out views.

    Parameters
    ----------
    views, board, imagers
        As for :func:`~calibration.mrcal_solve.solve_lenses`.
    models : sequence of str
        From the simplest to the richest.
    outlier_sigmas : float

    Raises
    ------
    CalibrationError
        Not one model can be solved.
    """
    scores = tuple(_score(views, board, imagers, model, outlier_sigmas) for model in models)
    best = min(scores, key=lambda score: score.mean)
    if best.why:
        raise CalibrationError(f"no lens model could be cross-validated: {best.why}")
    limit = best.mean + best.standard_error
    chosen = next(score.model for score in scores if score.mean <= limit)
    return ModelChoice(scores, chosen)


@dataclass(frozen=True)
class CalibrationDifference:
    """How two calibrations of a lens differ over its imager.

    Attributes
    ----------
    pixels : (rows, cols, 2) float64 array
        Grid over the imager.
    difference_px : (rows, cols, 2) float64 array
        Where the second projects what the first sees at ``pixels``, less ``pixels``.
    """

    pixels: NDArray[np.float64]
    difference_px: NDArray[np.float64]

    @property
    def rms_px(self) -> float:
        """Root mean square length of the difference."""
        return float(np.sqrt(np.nanmean(np.sum(self.difference_px**2, axis=-1))))


def calibration_difference(
    first: Lens,
    second: Lens,
    *,
    distance_mm: float,
    covered: NDArray[np.float64] | None = None,
    columns: int = 24,
) -> CalibrationDifference:
    """Difference of two lenses at a distance, up to a rigid motion between their frames.

    Parameters
    ----------
    first, second : Lens
        Of the same imager.
    distance_mm : float
        Distance of the points along z.
    covered : (n, 2) array, optional
        Observed corners: only pixels within their bounds are compared.
    columns : int
        Of the grid.
    """
    rows = max(2, round(columns * first.height / first.width))
    low, high = np.zeros(2), np.array([first.width - 1.0, first.height - 1.0])
    if covered is not None and len(covered):
        low, high = np.maximum(low, covered.min(axis=0)), np.minimum(high, covered.max(axis=0))
    axes = [np.linspace(low[0], high[0], columns), np.linspace(low[1], high[1], rows)]
    pixels = np.stack(np.meshgrid(*axes), axis=-1)
    view = BoardView.of("grid", [pixels], sigma_px=1.0)
    points = first.unproject(pixels) * distance_mm
    pose = np.zeros(6)
    pose = _refined((second,), np.zeros((1, 6)), view, points, pose)
    moved = second.project(transform(pose, points))
    return CalibrationDifference(pixels, moved - pixels)


def split_difference(
    views: list[BoardView],
    board: Chessboard,
    imagers: list[Imager],
    *,
    model: str,
    distance_mm: float,
) -> tuple[CalibrationDifference, ...]:
    """Differences of two calibrations, from every other view each, for every lens.

    Raises
    ------
    CalibrationError
        Fewer than six views.
    """
    if len(views) < 6:
        raise CalibrationError(
            f"{len(views)} views cannot be split into two calibrations; record six at least"
        )
    halves = [solve_lenses(views[k::2], board, imagers, model=model) for k in (0, 1)]
    differences = []
    for number in range(len(imagers)):
        corners = np.concatenate([view.pixels[number].reshape(-1, 2) for view in views])
        corners = corners[np.isfinite(corners).all(axis=-1)]
        lenses = [half.lenses[number] for half in halves]
        differences.append(
            calibration_difference(*lenses, distance_mm=distance_mm, covered=corners)
        )
    return tuple(differences)


def heldout_poses(
    solve: LensSolution, views: list[BoardView], *, outlier_sigmas: float
) -> tuple[FittedPose, ...]:
    """Poses of views that took no part in a solve, with the residuals that they leave.

    A corner that was found wrongly is left out as a solve leaves it out: it says nothing about the
    lenses.
    """
    given = solve.lenses, solve.rt_lens_ref
    points = solve.board_points
    return tuple(
        fit_board_pose(*given, view, points, outlier_sigmas=outlier_sigmas) for view in views
    )


def _score(
    views: list[BoardView],
    board: Chessboard,
    imagers: list[Imager],
    model: str,
    outlier_sigmas: float,
) -> ModelScore:
    folds = min(_FOLDS, len(views))
    heldout = np.full(len(views), np.nan)
    try:
        whole = solve_lenses(views, board, imagers, model=model, outlier_sigmas=outlier_sigmas)
        for fold in range(folds):
            out = list(range(fold, len(views), folds))
            names = {views[n].name for n in out}
            solution = solve_without(whole, names, views, outlier_sigmas=outlier_sigmas)
            hidden = [views[n] for n in out]
            poses = heldout_poses(solution, hidden, outlier_sigmas=outlier_sigmas)
            heldout[out] = [pose.weighted_rms for pose in poses]
    except CalibrationError as error:
        return ModelScore(model, heldout, why=str(error))
    return ModelScore(model, heldout, whole.sigma0)


def _first_pose(lens: Lens, view: BoardView, points: NDArray[np.float64]) -> NDArray[np.float64]:
    slopes = lens.unproject(view.pixels[0])[..., :2]
    good = np.isfinite(slopes).all(axis=-1)
    if good.sum() < 6:
        raise CalibrationError(f"{view.name}: the first lens sees too few corners for a pose")
    flat = points[good] * [1, 1, 0]
    found, turn, shift = cv2.solvePnP(flat, slopes[good], np.eye(3), np.zeros(4))
    if not found:
        raise CalibrationError(f"{view.name}: no pose of the board explains its corners")
    return np.concatenate([np.ravel(turn), np.ravel(shift)]).astype(np.float64)


def _turning(gradient: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative of pixels by a small turn of points about the origin, (n, 2, 3)."""
    # (ω × X) · g = ω · (X × g)
    return np.cross(points[:, np.newaxis, :], gradient)


def _refined(
    lenses: tuple[Lens, ...],
    rt_lens_ref: NDArray[np.float64],
    view: BoardView,
    points: NDArray[np.float64],
    pose: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Gauss-Newton on the pose, with the lenses held."""
    for _ in range(_ROUNDS):
        normal, right = np.zeros((6, 6)), np.zeros(6)
        for lens, rt, pixels, sigma in zip(
            lenses, rt_lens_ref, view.pixels, view.sigma_px, strict=True
        ):
            seen = np.isfinite(pixels).all(axis=-1)
            here = transform(pose, points[seen])
            projected, gradient = lens.project_with_gradient(transform(rt, here))
            gradient = gradient @ cv2.Rodrigues(rt[:3])[0]
            jacobian = np.concatenate([_turning(gradient, here), gradient], axis=-1)
            weight = 1 / sigma[seen] ** 2
            normal += np.einsum("n,nia,nib->ab", weight, jacobian, jacobian)
            right += np.einsum("n,nia,ni->a", weight, jacobian, pixels[seen] - projected)
        step = np.linalg.lstsq(normal, right, rcond=1e-14)[0]
        pose = compose(step, pose)
        if not np.isfinite(pose).all():
            break
        size = max(float(np.linalg.norm(pose[3:])), float(np.nanmax(np.abs(points))))
        if np.linalg.norm(step[:3]) < 1e-10 and np.linalg.norm(step[3:]) < 1e-8 * size:
            return pose
    raise CalibrationError(
        f"{view.name}: no pose of the board explains its corners; detect them again"
    )


def _fitted(
    lenses: tuple[Lens, ...],
    rt_lens_ref: NDArray[np.float64],
    view: BoardView,
    points: NDArray[np.float64],
    pose: NDArray[np.float64],
) -> FittedPose:
    residuals, chi2, equations = [], 0.0, 0
    for lens, rt, pixels, sigma in zip(
        lenses, rt_lens_ref, view.pixels, view.sigma_px, strict=True
    ):
        residual = lens.project(transform(compose(rt, pose), points)) - pixels
        weighted = residual / sigma[..., np.newaxis]
        chi2 += float(np.nansum(weighted**2))
        equations += int(np.isfinite(weighted).sum())
        residuals.append(residual)
    rms = float(np.sqrt(chi2 / max(1, equations - 6)))
    return FittedPose(pose, np.array(residuals), rms)
