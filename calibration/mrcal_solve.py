"""Lenses and board poses solved together by mrcal's optimiser.

Besides :mod:`calibration.lens` this is the only module that calls mrcal. It puts observations into
``mrcal.optimize`` and typed results out of it: poses first, then the lenses' core, then their
distortion, then the board's warp together with the rejection of outliers. The first lens is the
reference frame. See mrcal's pages "formulation" and "uncertainty".

mrcal's inputs are arrays that its optimiser overwrites, so each solve works on copies. Every
``do_optimize`` flag is in the inputs, without which the uncertainty cannot be had from them. Later
releases renamed two of the arrays; both names are understood.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mrcal
import numpy as np
from numpy.typing import NDArray

from acquisition.atomic_files import file_in_progress
from acquisition.plan import Imager
from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.errors import CalibrationError
from calibration.lens import Lens, compose, invert, transform
from calibration.lens_seeds import LensSeed, seed_lens

# Names before mrcal 2.5, and since.
_POSES = ("extrinsics_rt_fromref", "rt_cam_ref")
_BOARDS = ("frames_rt_toref", "rt_ref_frame")
_SPLINED = "LENSMODEL_SPLINED_STEREOGRAPHIC"
_ROUNDS = 4
# Pixels that a guessed pinhole may leave, beyond which a wide lens is tried, over the diagonal.
_POOR_SEED = 0.02


def splined_model(*, columns: int, rows: int, fov_deg: float) -> str:
    """Name, in mrcal, of a cubic splined stereographic model."""
    return f"{_SPLINED}_order=3_Nx={columns}_Ny={rows}_fov_x_deg={round(fov_deg)}"


@dataclass(frozen=True)
class LensSolution:
    """Lenses and board poses, with what they were solved from.

    Attributes
    ----------
    lenses : tuple of Lens
    rt_lens_ref : (lenses, 6) float64 array
        Poses of the lenses; the first is the reference.
    names : tuple of str
        The views, in order.
    rt_ref_board : (views, 6) float64 array
        Poses of the board, mm.
    warp_mm : (2,) float64 array
        Bow of the board at its middle along columns and rows.
    square_mm : float
    residuals_px : (views, lenses, rows, columns, 2) float64 array
        Solved less observed pixels; NaN where a corner was not seen.
    outliers : (views, lenses, rows, columns) bool array
        Corners seen but left out.
    sigma0 : float
        Standard deviation of the weighted residuals: 1 where ``sigma_px`` of the views was right.
        Corrected for the parameters that were fitted.
    degrees : int
        Degrees of freedom behind ``sigma0``.
    optimization_inputs : dict
        mrcal's own, at the optimum.
    """

    lenses: tuple[Lens, ...]
    rt_lens_ref: NDArray[np.float64]
    names: tuple[str, ...]
    rt_ref_board: NDArray[np.float64]
    warp_mm: NDArray[np.float64]
    square_mm: float
    residuals_px: NDArray[np.float64]
    outliers: NDArray[np.bool_]
    sigma0: float
    degrees: int
    optimization_inputs: dict[str, Any] = field(repr=False)

    @property
    def inliers(self) -> NDArray[np.bool_]:
        """(views, lenses, rows, columns) bool array: corners that took part."""
        return np.isfinite(self.residuals_px[..., 0]) & ~self.outliers

    @property
    def rms_per_point_px(self) -> float:
        """Root mean square distance of solved and observed corners, all lenses."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px[self.inliers] ** 2, axis=-1))))

    @property
    def rms_per_coordinate_px(self) -> float:
        """Root mean square of the residuals' components, all lenses."""
        return float(np.sqrt(np.mean(self.residuals_px[self.inliers] ** 2)))

    @property
    def weighted_rms(self) -> float:
        """Root mean square of the residuals' components over their ``sigma_px``."""
        inputs = self.optimization_inputs
        kept = inputs["observations_board"][..., 2] > 0
        _, x, _, _ = mrcal.optimizer_callback(**inputs, no_jacobian=True, no_factorization=True)
        weighted = x[: 2 * kept.size].reshape(*kept.shape, 2)
        return float(np.sqrt(np.mean(weighted[kept] ** 2)))

    @property
    def board_points(self) -> NDArray[np.float64]:
        """(rows, columns, 3) corners of the board with its warp, mm."""
        rows, columns = self.residuals_px.shape[2:4]
        return np.asarray(
            mrcal.ref_calibration_object(columns, rows, self.square_mm, calobject_warp=self.warp_mm)
        )

    def project_board(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (views, lenses, ..., 2) of points (..., 3) in the board's frame."""
        views = []
        for rt_ref_board in self.rt_ref_board:
            poses = [compose(rt_lens_ref, rt_ref_board) for rt_lens_ref in self.rt_lens_ref]
            pairs = zip(self.lenses, poses, strict=True)
            views.append([lens.project(transform(pose, points)) for lens, pose in pairs])
        return np.array(views)


def solve_lenses(
    views: list[BoardView],
    board: Chessboard,
    imagers: list[Imager],
    *,
    model: str,
    board_warp: bool = True,
    outlier_sigmas: float = 5.0,
) -> LensSolution:
    """Solve lenses that see a moving board, from nothing but the observed corners.

    Parameters
    ----------
    views : list of BoardView
        Poses of the board; each is seen by the first lens.
    board : Chessboard
    imagers : list of Imager
        Sizes of the lenses' imagers.
    model : str
        mrcal's name of the lens model, the same for every lens.
    board_warp : bool
        Whether the board's bow is solved for.
    outlier_sigmas : float
        Weighted residual, over the root mean square of all, beyond which a corner is left out;
        infinite keeps all.

    Returns
    -------
    LensSolution

    Raises
    ------
    CalibrationError
        Views that do not fit the board, too few of them, or a solve that fails or does not end
        in numbers.
    """
    _check(views, board, imagers)
    pixels = [np.stack([view.pixels[k] for view in views]) for k in range(len(imagers))]
    seeds = _seeds(board, pixels, imagers, stereographic=model.startswith(_SPLINED))
    inputs = _inputs(views, board, imagers, seeds)
    _optimize(inputs, {"extrinsics", "frames"}, regularize=False)
    _optimize(inputs, {"extrinsics", "frames", "intrinsics_core"}, regularize=False)
    _take_model(inputs, model)
    steps = {"extrinsics", "frames", "intrinsics_distortions"}
    if not model.startswith(_SPLINED):
        steps.add("intrinsics_core")
    _optimize(inputs, steps)
    if board_warp:
        steps.add("calobject_warp")
    _settle(inputs, steps, outlier_sigmas)
    return _solution(inputs, tuple(view.name for view in views))


def resolve(
    solution: LensSolution,
    views: list[BoardView] | None = None,
    *,
    outlier_sigmas: float = np.inf,
) -> LensSolution:
    """Solve again from a solution, with other observations of the same corners if given.

    Parameters
    ----------
    solution : LensSolution
    views : list of BoardView, optional
        The same poses with other pixels or noise. Outliers stay outliers.
    outlier_sigmas : float
        As in :func:`solve_lenses`; by default no more corners are left out.
    """
    inputs = _copied(solution.optimization_inputs)
    if views is not None:
        if tuple(view.name for view in views) != solution.names:
            raise CalibrationError("a solution is solved again with the views it was made from")
        observations, _ = _observations(views)
        observations[..., 2] *= np.where(inputs["observations_board"][..., 2] < 0, -1.0, 1.0)
        observations[..., 2] = np.where(observations[..., 2] == 0, -1.0, observations[..., 2])
        inputs["observations_board"] = _cleaned(observations)
    _settle(inputs, _steps_of(inputs), outlier_sigmas)
    return _solution(inputs, solution.names)


def solve_without(
    solution: LensSolution, names: set[str], views: list[BoardView], *, outlier_sigmas: float
) -> LensSolution:
    """Solve again from a solution, without some of its views.

    Parameters
    ----------
    solution : LensSolution
        Of all views; where the optimiser starts.
    names : set of str
        Views left out.
    views : list of BoardView
        All of them, in order.
    outlier_sigmas : float
        As in :func:`solve_lenses`; all corners are looked at afresh.
    """
    rest = [view for view in views if view.name not in names]
    if len(rest) < 3:
        raise CalibrationError("without the views left out, fewer than three remain")
    inputs = _copied(solution.optimization_inputs)
    kept = [n for n, name in enumerate(solution.names) if name not in names]
    key = _key(inputs, _BOARDS)
    inputs[key] = np.ascontiguousarray(inputs[key][kept])
    observations, indices = _observations(rest)
    inputs["observations_board"] = _cleaned(observations)
    inputs["indices_frame_camintrinsics_camextrinsics"] = indices
    _settle(inputs, _steps_of(inputs), outlier_sigmas)
    return _solution(inputs, tuple(view.name for view in rest))


def with_noise_of(solution: LensSolution, views: list[BoardView]) -> list[BoardView]:
    """Views with the noise of each lens scaled to what its residuals show.

    Solved again with these, the weighted residuals have unit variance, and regularisation, which
    is made for that, its proper part.

    Parameters
    ----------
    solution : LensSolution
    views : list of BoardView
        What it was solved from.
    """
    spent = solution.sigma0 / solution.weighted_rms
    scales = []
    for number in range(len(solution.lenses)):
        sigma = np.stack([view.sigma_px[number] for view in views])
        kept = solution.inliers[:, number]
        weighted = solution.residuals_px[:, number][kept] / sigma[kept][:, np.newaxis]
        scales.append(max(float(np.sqrt(np.mean(weighted**2))) * spent, 1e-6))
    return [
        replace(
            view,
            sigma_px=tuple(s * scale for s, scale in zip(view.sigma_px, scales, strict=True)),
        )
        for view in views
    ]


def save_lens(solution: LensSolution, number: int, path: Path) -> None:
    """Write a lens as a ``.cameramodel`` that carries what it was solved from."""
    model = mrcal.cameramodel(
        optimization_inputs=_copied(solution.optimization_inputs), icam_intrinsics=number
    )
    names = " ".join(solution.names)
    with file_in_progress(Path(path)) as temporary:
        model.write(str(temporary), note=f"views: {names}")


def load_solution(path: Path, *, names: tuple[str, ...] | None = None) -> LensSolution:
    """The solution that a ``.cameramodel`` carries.

    Raises
    ------
    CalibrationError
        The file is unreadable or carries none.
    """
    try:
        inputs = mrcal.cameramodel(str(path)).optimization_inputs()
    except Exception as error:  # mrcal raises bare Exceptions of its own
        raise CalibrationError(f"{path}: not a readable camera model ({error})") from error
    if inputs is None:
        raise CalibrationError(f"{path}: the model does not say what it was solved from")
    frames = len(inputs[_key(inputs, _BOARDS)])
    return _solution(inputs, names or tuple(f"view {n + 1}" for n in range(frames)))


def stored_views(solution: LensSolution) -> list[BoardView]:
    """The observations of a solution as views, with its outliers back in place."""
    inputs = solution.optimization_inputs
    observations, indices = inputs["observations_board"], _indices(inputs)
    rows, columns = observations.shape[1:3]
    lenses = len(inputs["intrinsics"])
    pixels = np.full((len(solution.names), lenses, rows, columns, 2), np.nan)
    sigma = np.ones(pixels.shape[:-1])
    for observed, (frame, lens, _) in zip(observations, indices, strict=True):
        seen = _seen(observed)
        pixels[frame, lens][seen] = observed[..., :2][seen]
        sigma[frame, lens][seen] = 1 / np.abs(observed[..., 2][seen])
    return [
        BoardView(name, tuple(pixels[n]), tuple(sigma[n])) for n, name in enumerate(solution.names)
    ]


_STEPS = ("intrinsics_core", "intrinsics_distortions", "extrinsics", "frames", "calobject_warp")


def _steps_of(inputs: dict[str, Any]) -> set[str]:
    return {step for step in _STEPS if inputs.get(f"do_optimize_{step}")}


def _check(views: list[BoardView], board: Chessboard, imagers: list[Imager]) -> None:
    if len(views) < 3:
        raise CalibrationError(
            f"{len(views)} views of the board: a calibration takes three at least, better ten, "
            "with different tilts"
        )
    for view in views:
        if len(view.pixels) != len(imagers):
            raise CalibrationError(
                f"{view.name}: seen by {len(view.pixels)} lenses, {len(imagers)} are calibrated"
            )
        if view.pixels[0].shape[:2] != (board.rows, board.columns):
            raise CalibrationError(
                f"{view.name}: {view.pixels[0].shape[:2]} corners, the board has "
                f"{(board.rows, board.columns)}"
            )
        for number, seen in enumerate(view.seen):
            if 0 < seen.sum() < 6 or (number == 0 and not seen.any()):
                raise CalibrationError(
                    f"{view.name}: lens {number + 1} sees {int(seen.sum())} corners; leave the "
                    "view out or record it again"
                )


def _seeds(
    board: Chessboard,
    pixels: list[NDArray[np.float64]],
    imagers: list[Imager],
    *,
    stereographic: bool,
) -> list[LensSeed]:
    """Guesses of pinholes, or of stereographic lenses where those do better or are asked for."""

    def of(wide: bool) -> list[LensSeed]:
        return [
            seed_lens(board.points, p, width=i.width, height=i.height, wide=wide)
            for p, i in zip(pixels, imagers, strict=True)
        ]

    if stereographic:
        return of(True)
    seeds = of(False)
    diagonals = [np.hypot(i.width, i.height) for i in imagers]
    if any(s.rms_px > _POOR_SEED * d for s, d in zip(seeds, diagonals, strict=True)):
        wide = of(True)
        if sum(s.rms_px for s in wide) < sum(s.rms_px for s in seeds):
            return wide
    return seeds


def _inputs(
    views: list[BoardView], board: Chessboard, imagers: list[Imager], seeds: list[LensSeed]
) -> dict[str, Any]:
    observations, indices = _observations(views)
    first = seeds[0].rt_lens_board
    extrinsics = np.array([_relative_pose(board, first, s.rt_lens_board) for s in seeds[1:]])
    new_names = hasattr(mrcal.cameramodel, "rt_cam_ref")
    return {
        "intrinsics": np.array([seed.core for seed in seeds]),
        _POSES[new_names]: extrinsics.reshape(-1, 6),
        _BOARDS[new_names]: first.copy(),
        "points": None,
        "observations_board": _cleaned(observations),
        "indices_frame_camintrinsics_camextrinsics": indices,
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "lensmodel": "LENSMODEL_STEREOGRAPHIC" if seeds[0].wide else "LENSMODEL_PINHOLE",
        "imagersizes": np.array([[i.width, i.height] for i in imagers], np.int32),
        "calobject_warp": np.zeros(2),
        "calibration_object_spacing": float(board.square_mm),
        "verbose": False,
    }


def _observations(
    views: list[BoardView],
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    observations, indices = [], []
    for number, view in enumerate(views):
        for lens, (pixels, sigma) in enumerate(zip(view.pixels, view.sigma_px, strict=True)):
            seen = np.isfinite(pixels).all(axis=-1)
            if not seen.any():
                continue
            weight = np.where(seen, 1 / np.where(seen, sigma, 1.0), 0.0)
            observations.append(np.dstack([np.where(seen[..., None], pixels, 0.0), weight]))
            indices.append((number, lens, lens - 1))
    return np.array(observations), np.array(indices, np.int32)


def _cleaned(observations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Missing corners as mrcal has them: a weight of -1."""
    observations = np.ascontiguousarray(observations)
    observations[..., 2][observations[..., 2] == 0] = -1.0
    return observations


def _seen(observed: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which corners of an observation were seen: the others are at (0, 0), with a weight of -1."""
    return np.asarray((observed[..., 2] > 0) | observed[..., :2].any(axis=-1))


def discord_of_views(
    views: list[BoardView], board: Chessboard, imagers: list[Imager]
) -> NDArray[np.float64]:
    """How far each view is from the pose between the first two lenses that most views agree on.

    From first guesses alone, so that a view which would lead the solve astray is known before it.

    Returns
    -------
    (views,) float64 array
        Mean displacement of the board's outer corners over its diagonal; NaN where a view is not
        seen by both.
    """
    _check(views, board, imagers)
    pixels = [np.stack([view.pixels[k] for view in views]) for k in range(2)]
    seeds = _seeds(board, pixels, imagers[:2], stereographic=False)
    both, apart = _poses_apart(board, seeds[0].rt_lens_board, seeds[1].rt_lens_board)
    discord = np.full(len(views), np.nan)
    agreed = int(np.argmin(np.median(apart, axis=1)))
    discord[both] = apart[agreed] / np.linalg.norm(board.points[-1, -1])
    return discord


def _relative_pose(
    board: Chessboard, first: NDArray[np.float64], other: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The pose that most views agree on, of those that each view gives."""
    both, apart = _poses_apart(board, first, other)
    agreed = both[int(np.argmin(np.median(apart, axis=1)))]
    return compose(other[agreed], invert(first[agreed]))


def _poses_apart(
    board: Chessboard, first: NDArray[np.float64], other: NDArray[np.float64]
) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
    """Views with both poses; mm by which the pose between lenses of one misplaces another's board.

    Rows of the second are the views that give the pose, columns those that it is tried on.
    """
    both = np.flatnonzero(np.isfinite(first[:, 0]) & np.isfinite(other[:, 0]))
    if not len(both):
        raise CalibrationError("no view of the board is seen by both camera and projector")
    corners = board.points[:: board.rows - 1, :: board.columns - 1].reshape(-1, 3)
    here = [transform(first[v], corners) for v in both]
    there = [transform(other[v], corners) for v in both]
    apart = np.empty((len(both), len(both)))
    for row, v in enumerate(both):
        rt = compose(other[v], invert(first[v]))
        apart[row] = [
            np.linalg.norm(transform(rt, a) - b, axis=-1).mean()
            for a, b in zip(here, there, strict=True)
        ]
    return both, apart


def _take_model(inputs: dict[str, Any], model: str) -> None:
    """Grow the lenses from their core to a model, in place."""
    try:
        extra = mrcal.lensmodel_num_params(model) - 4
    except Exception as error:  # mrcal raises bare Exceptions of its own
        raise CalibrationError(f"mrcal has no lens model {model!r} ({error})") from None
    lenses = len(inputs["intrinsics"])
    # Not zero: there the gradient of some models vanishes.
    grown = np.hstack([inputs["intrinsics"], np.full((lenses, extra), 1e-6)])
    inputs["intrinsics"], inputs["lensmodel"] = grown, model


def _settle(inputs: dict[str, Any], steps: set[str], outlier_sigmas: float) -> None:
    """Solve, and leave out corners until those that are left agree, in place."""
    observations = inputs["observations_board"]
    for _ in range(_ROUNDS):
        _optimize(inputs, steps)
        if not np.isfinite(outlier_sigmas):
            return
        _, x, _, _ = mrcal.optimizer_callback(**inputs, no_jacobian=True, no_factorization=True)
        distance = np.abs(x[: observations[..., :2].size].reshape(*observations.shape[:3], 2))
        kept = observations[..., 2] > 0
        rms = float(np.sqrt(np.mean(distance[kept] ** 2)))
        gross = kept & (distance.max(axis=-1) > outlier_sigmas * rms)
        if not gross.any():
            return
        observations[..., 2][gross] *= -1
    _optimize(inputs, steps)


def _optimize(inputs: dict[str, Any], steps: set[str], *, regularize: bool = True) -> None:
    """Optimise some of the variables, in place."""
    for step in _STEPS:
        inputs[f"do_optimize_{step}"] = step in steps
    # The uncertainty wants this flag also where there is one lens and nothing to optimise.
    inputs["do_optimize_extrinsics"] = True
    # mrcal's own threshold drops hundreds of good corners of heavy-tailed detectors.
    inputs["do_apply_outlier_rejection"] = False
    inputs["do_apply_regularization"] = regularize and (
        "intrinsics_core" in steps or "intrinsics_distortions" in steps
    )
    try:
        mrcal.optimize(**inputs)
    except Exception as error:  # mrcal raises bare Exceptions of its own
        raise CalibrationError(
            f"the calibration cannot be solved ({error}); check that the board's corners are "
            "counted alike in every view, and that its tilt changes from view to view"
        ) from error
    for name in ("intrinsics", _key(inputs, _POSES), _key(inputs, _BOARDS)):
        if inputs[name] is not None and not np.isfinite(inputs[name]).all():
            raise CalibrationError(
                "the calibration does not converge; record the board at more tilts, and over all "
                "of the image"
            )


def _solution(inputs: dict[str, Any], names: tuple[str, ...]) -> LensSolution:
    observations, indices = inputs["observations_board"], _indices(inputs)
    frames = np.array(inputs[_key(inputs, _BOARDS)])
    count, (rows, columns) = len(inputs["intrinsics"]), observations.shape[1:3]
    _, x, _, _ = mrcal.optimizer_callback(**inputs, no_jacobian=True, no_factorization=True)
    measured = x[: observations[..., :2].size].reshape(*observations.shape[:3], 2)
    weight = observations[..., 2]
    residuals = np.full((len(frames), count, rows, columns, 2), np.nan)
    outliers = np.zeros(residuals.shape[:-1], bool)
    lenses, poses = _lenses(inputs)
    for number, (frame, lens, _) in enumerate(indices):
        kept = weight[number] > 0
        residuals[frame, lens][kept] = measured[number][kept] / weight[number][kept][:, None]
        outliers[frame, lens] = (weight[number] < 0) & _seen(observations[number])
    degrees = 2 * int((weight > 0).sum()) - mrcal.num_states(**inputs)
    chi2 = float(np.sum(measured[weight > 0] ** 2))
    if inputs["lensmodel"].startswith(_SPLINED):
        # Most knots of a spline are held by the regularisation, not by the corners.
        degrees = max(degrees, int((weight > 0).sum()))
    solution = LensSolution(
        lenses=lenses,
        rt_lens_ref=poses,
        names=names,
        rt_ref_board=frames,
        warp_mm=np.array(_warp(inputs)),
        square_mm=float(inputs["calibration_object_spacing"]),
        residuals_px=residuals,
        outliers=outliers,
        sigma0=float(np.sqrt(chi2 / max(1, degrees))),
        degrees=max(1, degrees),
        optimization_inputs=_copied(inputs),
    )
    _fill_outliers(solution)
    return solution


def _fill_outliers(solution: LensSolution) -> None:
    """Residuals of the corners left out, into the array of a solution being made."""
    if not solution.outliers.any():
        return
    projected = solution.project_board(solution.board_points)
    observed = np.full(projected.shape, np.nan)
    inputs = solution.optimization_inputs
    for pixels, (frame, lens, _) in zip(
        inputs["observations_board"], _indices(inputs), strict=True
    ):
        observed[frame, lens] = pixels[..., :2]
    left = solution.outliers
    solution.residuals_px[left] = (projected - observed)[left]


def _lenses(inputs: dict[str, Any]) -> tuple[tuple[Lens, ...], NDArray[np.float64]]:
    sizes, model = inputs["imagersizes"], inputs["lensmodel"]
    lenses = tuple(
        Lens(model, np.array(numbers, np.float64), int(size[0]), int(size[1]))
        for numbers, size in zip(inputs["intrinsics"], sizes, strict=True)
    )
    poses = np.zeros((len(lenses), 6))
    for _, lens, pose in _indices(inputs):
        if pose >= 0:
            poses[lens] = inputs[_key(inputs, _POSES)][pose]
    return lenses, poses


def _warp(inputs: dict[str, Any]) -> NDArray[np.float64]:
    warp = inputs.get("calobject_warp")
    return np.zeros(2) if warp is None else np.asarray(warp, np.float64)[:2]


def _indices(inputs: dict[str, Any]) -> NDArray[np.int32]:
    return np.asarray(inputs["indices_frame_camintrinsics_camextrinsics"], np.int32)


def _key(inputs: dict[str, Any], names: tuple[str, str]) -> str:
    return names[1] if names[1] in inputs else names[0]


def _copied(inputs: dict[str, Any]) -> dict[str, Any]:
    return {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in inputs.items()}


def projection_covariance(
    solution: LensSolution, number: int, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Covariance of the pixels at which a lens sees points, as the calibration leaves it.

    ``mrcal.projection_uncertainty`` with the noise that the residuals show, corrected for the
    fitted parameters. The points are fixed to the boards, on the mean over all of their poses.

    Parameters
    ----------
    solution : LensSolution
    number : int
        Which lens.
    points : (..., 3) array
        In the lens's frame, mm.

    Returns
    -------
    (..., 2, 2) float64 array
        Square pixels.
    """
    model = mrcal.cameramodel(
        optimization_inputs=_copied(solution.optimization_inputs), icam_intrinsics=number
    )
    points = np.ascontiguousarray(points, np.float64)
    try:
        covariance = mrcal.projection_uncertainty(
            points, model, what="covariance", observed_pixel_uncertainty=solution.sigma0
        )
    except Exception as error:  # mrcal raises bare Exceptions of its own
        raise CalibrationError(
            f"the uncertainty cannot be computed ({error}); the views do not determine the lens"
        ) from error
    return np.asarray(covariance)


def parameter_covariance(solution: LensSolution) -> NDArray[np.float64]:
    """Covariance of the lenses' parameters and poses, board poses marginalised.

    Noise of the corners is propagated through the solve with regularisation (mrcal's page
    "uncertainty"). A parameter that was not optimised has no variance.

    Returns
    -------
    (n, n) float64 array
        In the order: parameters of each lens, then the pose of each lens but the first.

    Raises
    ------
    CalibrationError
        The views do not determine the parameters.
    """
    inputs = solution.optimization_inputs
    _, _, jacobian, factorization = mrcal.optimizer_callback(**inputs)
    if factorization is None:
        raise CalibrationError("the views do not determine the lenses; record more tilts")
    states, places = _states(solution)
    unit = np.zeros((len(states), jacobian.shape[1]))
    unit[np.arange(len(states)), states] = 1.0
    scale = np.ones(jacobian.shape[1])
    mrcal.unpack_state(scale, **inputs)
    rows = mrcal.num_measurements_boards(**inputs)
    solved = factorization.solve_xt_JtJ_bt(unit) * scale[states][:, np.newaxis]
    noise = jacobian[:rows] @ solved.T
    total = sum(len(lens.intrinsics) for lens in solution.lenses) + 6 * (len(solution.lenses) - 1)
    covariance = np.zeros((total, total))
    covariance[np.ix_(places, places)] = solution.sigma0**2 * (noise.T @ noise)
    return covariance


def _states(solution: LensSolution) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Indices of the lenses' parameters in mrcal's state, and in :func:`parameter_covariance`."""
    inputs = solution.optimization_inputs
    states: list[int] = []
    places: list[int] = []
    start = 0
    first = 0 if inputs["do_optimize_intrinsics_core"] else 4
    for number, lens in enumerate(solution.lenses):
        index = mrcal.state_index_intrinsics(number, **inputs)
        count = len(lens.intrinsics) - first
        states += range(index, index + count)
        places += range(start + first, start + first + count)
        start += len(lens.intrinsics)
    for number in range(len(solution.lenses) - 1):
        index = mrcal.state_index_extrinsics(number, **inputs)
        states += range(index, index + 6)
        places += range(start, start + 6)
        start += 6
    return np.array(states), np.array(places)
