"""Lenses and board poses solved together by mrcal's optimiser.

Poses come first, then the lenses' core, then their distortion, then the board's warp together with
the rejection of outliers. The first lens is the reference frame.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from acquisition.plan import Imager
from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.errors import CalibrationError
from calibration.mrcal_inputs import (
    BOARDS,
    SPLINED,
    cleaned,
    copied,
    inputs_of,
    key_in,
    observations_of,
    optimize,
    settle,
    steps_of,
    take_model,
)
from calibration.mrcal_solution import LensSolution, solution_of
from calibration.view_seeds import check_views, seed_lenses

# A corner whose residual is larger than so many times that of all is left out, if nothing is asked.
OUTLIER_SIGMAS = 5.0


def solve_lenses(
    views: list[BoardView],
    board: Chessboard,
    imagers: list[Imager],
    *,
    model: str,
    board_warp: bool = True,
    outlier_sigmas: float = OUTLIER_SIGMAS,
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
    check_views(views, board, imagers)
    pixels = [np.stack([view.pixels[k] for view in views]) for k in range(len(imagers))]
    seeds = seed_lenses(board, pixels, imagers, stereographic=model.startswith(SPLINED))
    inputs = inputs_of(views, board, imagers, seeds)
    optimize(inputs, {"extrinsics", "frames"}, regularize=False)
    optimize(inputs, {"extrinsics", "frames", "intrinsics_core"}, regularize=False)
    take_model(inputs, model)
    steps = {"extrinsics", "frames", "intrinsics_distortions"}
    if not model.startswith(SPLINED):
        steps.add("intrinsics_core")
    optimize(inputs, steps)
    if board_warp:
        steps.add("calobject_warp")
    settle(inputs, steps, outlier_sigmas)
    return solution_of(inputs, tuple(view.name for view in views))


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
    inputs = copied(solution.optimization_inputs)
    if views is not None:
        if tuple(view.name for view in views) != solution.names:
            raise CalibrationError("a solution is solved again with the views it was made from")
        observations, _ = observations_of(views)
        observations[..., 2] *= np.where(inputs["observations_board"][..., 2] < 0, -1.0, 1.0)
        observations[..., 2] = np.where(observations[..., 2] == 0, -1.0, observations[..., 2])
        inputs["observations_board"] = cleaned(observations)
    settle(inputs, steps_of(inputs), outlier_sigmas)
    return solution_of(inputs, solution.names)


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
    inputs = copied(solution.optimization_inputs)
    kept = [n for n, name in enumerate(solution.names) if name not in names]
    key = key_in(inputs, BOARDS)
    inputs[key] = np.ascontiguousarray(inputs[key][kept])
    observations, indices = observations_of(rest)
    inputs["observations_board"] = cleaned(observations)
    inputs["indices_frame_camintrinsics_camextrinsics"] = indices
    settle(inputs, steps_of(inputs), outlier_sigmas)
    return solution_of(inputs, tuple(view.name for view in rest))


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
