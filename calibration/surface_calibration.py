"""A calibration from corners, solved on from all of the board's surface.

:mod:`calibration.dense_solve` finds lenses, poses, and the shape of the board; here its outcome
becomes a calibration that is gated, reported and saved as any other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import nan_robust_sigma
from calibration.board_shape import BoardShape
from calibration.cross_validation import CalibrationDifference, calibration_difference
from calibration.dense_solution import DenseSolution
from calibration.dense_solve import solve_densely
from calibration.errors import CalibrationError
from calibration.mrcal_solution import LensSolution
from calibration.procam import ProcamCalibration, rejected_corners, working_distance
from calibration.surface_samples import SurfaceSamples

# The solve's own limit for a corner in the camera, in standard deviations.
_OUTLIER_SIGMAS = 5.0
_LEAST_VIEWS_TO_SPLIT = 6


def calibrate_by_surface(
    calibration: ProcamCalibration, samples: Mapping[str, SurfaceSamples]
) -> ProcamCalibration:
    """Solve on from all of the board's surface.

    Parameters
    ----------
    calibration : ProcamCalibration
        From corners: where the solve starts.
    samples : mapping of str to SurfaceSamples
        By the views' names.

    Returns
    -------
    ProcamCalibration
        Rig, poses, residuals and shape are those by the surface; of the choice of the lens model
        and the views that were left out nothing changes. Corners that the surface's solve gave no
        weight are left out.

    Raises
    ------
    CalibrationError
        The views do not determine the rig.
    """
    views = calibration.views
    dense = solve_densely(
        calibration.rig,
        calibration.solution.rt_ref_board,
        calibration.board,
        [view.pixels[0] for view in views],
        [samples[view.name] for view in views],
    )
    solution, scales = _as_left_by(dense, calibration)
    shape = dense.corner_places - calibration.board.points
    return replace(
        calibration,
        rig=replace(dense.rig, covariance=None),
        solution=solution,
        views=tuple(
            replace(
                view,
                sigma_px=tuple(s * scale for s, scale in zip(view.sigma_px, scales, strict=True)),
            )
            for view in views
        ),
        shape=BoardShape(shape, dense.corner_sigma_mm),
        rejected_corners=rejected_corners(solution),
        working_distance_mm=working_distance(solution),
        surface=dense,
    )


def solved_from_some(dense: DenseSolution, kept: Sequence[int]) -> DenseSolution:
    """Solve again from some of the views, by number.

    Raises
    ------
    CalibrationError
        Fewer than three, or views that do not determine the rig.
    """
    problem = dense.problem
    return solve_densely(
        dense.rig,
        dense.rt_cam_board[list(kept)],
        problem.board,
        [problem.corners[n] for n in kept],
        [problem.samples[n] for n in kept],
    )


def split_surface_difference(
    dense: DenseSolution, *, distance_mm: float
) -> tuple[CalibrationDifference, ...]:
    """Differences of two solves, from every other view each, of camera and projector.

    Parameters
    ----------
    dense : DenseSolution
    distance_mm : float
        As of :func:`~calibration.cross_validation.calibration_difference`.

    Raises
    ------
    CalibrationError
        Fewer than six views, or halves that do not determine the rig.
    """
    count = len(dense.rt_cam_board)
    if count < _LEAST_VIEWS_TO_SPLIT:
        raise CalibrationError(
            f"{count} views cannot be split into two calibrations; record six at least"
        )
    halves = [solved_from_some(dense, range(first, count, 2)) for first in (0, 1)]
    problem = dense.problem
    seen = (
        np.concatenate([corners.reshape(-1, 2) for corners in problem.corners]),
        np.concatenate([one.coordinates for one in problem.samples]),
    )
    return tuple(
        calibration_difference(
            *(half.lenses[number] for half in halves),
            distance_mm=distance_mm,
            covered=where[np.isfinite(where).all(axis=-1)],
        )
        for number, where in enumerate(seen)
    )


def _as_left_by(
    dense: DenseSolution, calibration: ProcamCalibration
) -> tuple[LensSolution, NDArray[np.float64]]:
    """The corners' solution with lenses, poses and residuals of the surface; scales of the noise.

    With the views' noise scaled so, the weighted residuals have unit variance.
    """
    before, views = calibration.solution, calibration.views
    observed = np.array([view.pixels for view in views])
    left = dense.project_corners() - observed
    # The projector's corners take no part: they are held out, and none is too far off to count.
    far = np.abs(left[:, 0]) > _OUTLIER_SIGMAS * nan_robust_sigma(left[:, 0])
    outliers = np.zeros(left.shape[:-1], np.bool_)
    outliers[:, 0] = far.any(axis=-1)
    kept = np.isfinite(left[..., 0]) & ~outliers
    sigma = np.array([view.sigma_px for view in views])
    spent = np.sqrt(max(1.0, 2 * kept.sum() / before.degrees))
    scales = np.array(
        [
            spent * np.sqrt(np.mean((left[:, k][kept[:, k]] / sigma[:, k][kept[:, k], None]) ** 2))
            for k in range(left.shape[1])
        ]
    )
    solution = replace(
        before,
        lenses=dense.lenses,
        rt_lens_ref=np.array([np.zeros(6), dense.rig.rt_proj_cam]),
        rt_ref_board=dense.rt_cam_board,
        warp_mm=np.zeros(2),
        residuals_px=left,
        outliers=outliers,
        sigma0=1.0,
    )
    return solution, scales
