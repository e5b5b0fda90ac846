"""Figures of a rig's calibration as plain JSON: for ``--json``, the report and the rig's folder."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import numpy as np

from calibration.lens import Lens, rotation
from calibration.procam import LENS_NAMES
from calibration.recording_gates import covered_cells, normal_spread_deg
from workstation.rig_calibration import CalibratedRig, HeldoutPlane
from workstation.surface_figures import surface_figures

FIGURES_FILE = "calibration.json"


def calibration_figures(done: CalibratedRig) -> dict[str, Any]:
    """Everything that the report shows, as numbers.

    Returns
    -------
    dict
        Lengths in mm, angles in degrees. Numbers that are not known are NaN.
    """
    calibration, poses = done.calibration, done.poses
    solution, board = calibration.solution, calibration.board
    sigma = np.sqrt(np.maximum(np.diag(calibration.covariance().covariance), 0.0))
    counts = [len(lens.intrinsics) for lens in solution.lenses]
    cuts = np.split(sigma, np.cumsum(counts))
    baseline = float(np.linalg.norm(calibration.rig.rt_proj_cam[3:]))
    return {
        "software": f"impasto {version('impasto')}",
        **done.gates.figures(),
        "model": calibration.rig.camera.model,
        "models": _models(done),
        "board": {
            "columns": board.columns,
            "rows": board.rows,
            "square_mm": board.square_mm,
            "square_sigma_mm": board.square_sigma_mm,
            "bow_mm": None if calibration.surface else solution.warp_mm.tolist(),
            "shape_rms_mm": None
            if calibration.shape is None
            else calibration.shape.rms_mm.tolist(),
        },
        "working_distance_mm": calibration.working_distance_mm,
        "stereo_px": solution.rms_per_point_px,
        "sigma0": solution.sigma0,
        "degrees_of_freedom": solution.degrees,
        "lenses": {
            name: _lens(done, number, lens, cuts[number])
            for number, (name, lens) in enumerate(zip(LENS_NAMES, solution.lenses, strict=True))
        },
        "rt_proj_cam": calibration.rig.rt_proj_cam.tolist(),
        "rt_proj_cam_sigma": cuts[2].tolist(),
        "baseline_mm": baseline,
        "heights": _heights(done),
        "heldout_planes": [_plane(plane) for plane in done.planes],
        "repeatability": _repeatability(done),
        "poses": _poses(done),
        "tilt_spread_deg": normal_spread_deg(calibration).tolist(),
        "unreconstructed": [{"name": pose.name, "why": pose.why} for pose in done.unreconstructed],
        "unread": [{"name": pose.name, "why": pose.why} for pose in poses.unread],
        "rejected_poses": [
            {"name": view.name, "rms_px": view.rms_px, "why": view.why}
            for view in calibration.rejected_views
        ],
        "rejected_corners": [str(corner) for corner in calibration.rejected_corners],
        "earlier": [_drift(done, number) for number in range(len(done.earlier))],
        "sessions": poses.digests,
        "surface": surface_figures(calibration),
        "seconds": done.seconds,
    }


def rms_by_lens(done: CalibratedRig, number: int) -> float:
    """Root mean square distance per point of one lens, px."""
    solution = done.calibration.solution
    left = solution.residuals_px[:, number][solution.inliers[:, number]]
    return float(np.sqrt(np.mean(np.sum(left**2, axis=-1))))


def tilts_deg(done: CalibratedRig) -> np.ndarray:
    """(views, 2) tilt of each board to the right and downwards against the camera, degrees."""
    normals = np.array([rotation(rt)[:, 2] for rt in done.calibration.solution.rt_ref_board])
    normals *= np.where(normals[:, 2:] < 0, -1.0, 1.0)
    return np.degrees(np.arctan2(normals[:, :2], normals[:, 2:]))


def _models(done: CalibratedRig) -> list[dict[str, Any]]:
    choice = done.calibration.models
    if choice is None:
        return []
    return [
        {
            "model": score.model,
            "heldout": score.mean,
            "standard_error": score.standard_error,
            "chosen": score.model == choice.chosen,
            "why": score.why,
        }
        for score in choice.scores
    ]


def _lens(done: CalibratedRig, number: int, lens: Lens, sigma: np.ndarray) -> dict[str, Any]:
    worst = done.uncertainty[number].worst_sigma_px
    difference = done.differences[number].rms_px if done.differences else float("nan")
    solution = done.calibration.solution
    noise = np.median([view.sigma_px[number] for view in done.calibration.views])
    return {
        "width": lens.width,
        "height": lens.height,
        "intrinsics": lens.intrinsics.tolist(),
        "intrinsics_sigma": sigma.tolist(),
        "rms_px": rms_by_lens(done, number),
        "corners": int(solution.inliers[:, number].sum()),
        "left_out": int(solution.outliers[:, number].sum()),
        "corner_sigma_px": float(noise) * solution.sigma0,
        "uncertainty_px": {
            "median": float(np.median(worst)),
            "largest": float(worst.max()),
        },
        "split_difference_px": difference,
        "covered_share": float(covered_cells(done.calibration, number).mean()),
    }


def _heights(done: CalibratedRig) -> dict[str, Any] | None:
    if done.heights is None:
        return None
    return {
        "sigma_rms_mm": done.heights.rms_mm,
        "sigma_largest_mm": float(done.heights.sigma_mm.max()),
        "scale_sigma": done.heights.scale_sigma,
    }


def _plane(plane: HeldoutPlane) -> dict[str, Any]:
    relief = plane.relief
    return {
        "pose": plane.pose,
        "rms_mm": relief.plane_rms_mm,
        "smoothed_rms_mm": float(np.sqrt(np.nanmean(relief.height_mm**2))),
        "noise_mm": relief.noise_mm,
        "predicted_noise_mm": relief.predicted_noise_mm,
        "off_share": relief.off_share,
        "scale_error": relief.scale_error,
    }


def _repeatability(done: CalibratedRig) -> dict[str, Any] | None:
    found = done.repeatability
    if found is None:
        return None
    return {
        "rms_mm": found.rms_mm.tolist(),
        "predicted_mm": done.predicted_repeatability_mm.tolist(),
        "detrended_rms_mm": found.detrended_rms_mm.tolist(),
    }


def _poses(done: CalibratedRig) -> list[dict[str, Any]]:
    calibration = done.calibration
    solution = calibration.solution
    middle = solution.board_points.reshape(-1, 3).mean(axis=0)
    heldout = np.full(len(calibration.views), np.nan)
    if calibration.models is not None:
        heldout = calibration.models.score.heldout_over_noise
    rows = []
    for number, (view, tilt) in enumerate(zip(calibration.views, tilts_deg(done), strict=True)):
        rt = solution.rt_ref_board[number]
        squares = np.sum(solution.residuals_px[number] ** 2, axis=-1)
        kept = solution.inliers[number]
        rms = [float(np.sqrt(np.mean(s[k]))) for s, k in zip(squares, kept, strict=True) if k.any()]
        rows.append(
            {
                "name": view.name,
                "distance_mm": float((rotation(rt) @ middle + rt[3:])[2]),
                "tilt_deg": tilt.tolist(),
                "rms_px": rms,
                "corners": [int(k.sum()) for k in kept],
                "left_out": int(solution.outliers[number].sum()),
                "heldout_over_noise": float(heldout[number]),
            }
        )
    return rows


def _drift(done: CalibratedRig, number: int) -> dict[str, Any]:
    before = done.earlier[number]
    return {
        "name": before.name,
        "shape_rms_mm": before.drift.shape_rms_mm,
        "predicted_mm": before.drift.predicted_mm,
        "over_predicted": before.drift.over_predicted,
        "scale": before.drift.scale,
        "baseline_mm": before.drift.baseline_mm,
        "turn_deg": float(np.degrees(before.drift.turn_rad)),
        "camera_px": before.drift.camera.rms_px,
        "projector_px": before.drift.projector.rms_px,
    }
