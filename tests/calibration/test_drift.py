from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.drift import compare_with_earlier
from calibration.errors import CalibrationError
from calibration.gate_limits import Gate
from calibration.gates import check_calibration
from calibration.mrcal_solve import solve_lenses
from calibration.procam import ProcamOptions, calibrate_procam
from calibration.uncertainty import rig_covariance
from workstation.benchmarks.simulated_boards import BOARD, CAMERA, PROJECTOR, simulate_boards

MODEL = "LENSMODEL_OPENCV4"


@pytest.fixture(scope="module")
def rigs():
    found = []
    for seed in range(6):
        boards = simulate_boards(9, seed=100 + seed)
        solution = solve_lenses(boards.views, BOARD, [CAMERA, PROJECTOR], model=MODEL)
        joint = rig_covariance(solution)
        found.append(replace(joint.rig, covariance=joint.covariance))
    return found


def test_two_calibrations_of_one_rig_differ_as_much_as_their_uncertainties_explain(rigs):
    pairs = list(zip(rigs[::2], rigs[1::2], strict=True))
    drifts = [compare_with_earlier(a, b, distance_mm=700.0) for a, b in pairs]
    observed = np.sqrt(np.mean([d.shape_rms_mm**2 for d in drifts]))
    predicted = np.sqrt(np.mean([d.predicted_mm**2 for d in drifts]))
    assert observed / predicted == pytest.approx(1, abs=0.45)
    assert max(d.over_predicted for d in drifts) < 2.5


def test_a_rig_has_not_drifted_from_itself(rigs):
    drift = compare_with_earlier(rigs[0], rigs[0], distance_mm=700.0)
    assert drift.shape_rms_mm < 1e-6
    assert drift.camera.rms_px < 1e-6
    assert drift.baseline_mm == 0


def test_a_turned_projector_is_found_and_flagged(rigs):
    pose = rigs[0].rt_proj_cam.copy()
    pose[1] += np.radians(0.5)
    moved = replace(rigs[0], rt_proj_cam=pose)
    drift = compare_with_earlier(moved, rigs[0], distance_mm=700.0)
    assert np.degrees(drift.turn_rad) == pytest.approx(0.5, rel=0.05)
    assert drift.over_predicted > 5
    options = ProcamOptions(models=(MODEL,))
    views = simulate_boards(8, seed=1).views
    good = calibrate_procam(views, BOARD, camera=CAMERA, projector=PROJECTOR, options=options)
    report = check_calibration(good, drift=drift)
    assert [v.gate for v in report.failures] == [Gate.DRIFT]
    assert "the rig is not what it was" in report.failures[0].remedy
    assert report.passed


def test_a_longer_baseline_is_a_change_of_scale(rigs):
    pose = rigs[0].rt_proj_cam.copy()
    pose[3:] *= 1.002
    drift = compare_with_earlier(replace(rigs[0], rt_proj_cam=pose), rigs[0], distance_mm=700.0)
    assert drift.scale == pytest.approx(0.002, rel=0.02)
    assert drift.baseline_mm == pytest.approx(0.002 * np.linalg.norm(pose[3:]), rel=0.01)


def test_without_covariance_the_change_is_told_but_not_judged(rigs):
    bare = replace(rigs[0], covariance=None)
    drift = compare_with_earlier(bare, replace(rigs[1], covariance=None), distance_mm=700.0)
    assert np.isnan(drift.predicted_mm)
    assert drift.shape_rms_mm > 0


def test_another_camera_is_refused(rigs, rig_geometry):
    with pytest.raises(CalibrationError, match="no drift of one rig can be told from two"):
        compare_with_earlier(rigs[0], rig_geometry, distance_mm=700.0)
