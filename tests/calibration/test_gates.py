from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from calibration.errors import CalibrationRefusedError
from calibration.gate_limits import Gate
from calibration.gates import KnownDistance, check_calibration
from workstation.benchmarks.degenerate_boards import (
    BOW_MM,
    TRUE_BASELINE_MM,
    calibrated,
    good_boards,
    half_covered,
    other_end_in_one_lens,
    parallel_boards,
    swapped_corners,
    warped_board,
    with_wrong_square,
)


def verdict(report, gate):
    return next(v for v in report.failures if v.gate is gate)


@pytest.fixture(scope="module")
def good():
    return calibrated(good_boards())


@pytest.fixture(scope="module")
def baseline(good):
    return float(np.linalg.norm(good.rig.rt_proj_cam[3:]))


def test_a_good_set_passes_every_gate(good, baseline):
    report = check_calibration(
        good,
        distances=[KnownDistance(baseline, TRUE_BASELINE_MM, 0.2)],
        planes={"pose 1": 1.05, "pose 2": 0.9},
        repeatability={"pose 1": 1.1, "pose 2": 1.1},
    )
    assert report.passed
    assert report.failures == ()
    untested = {Gate.DIFFERENCE, Gate.DRIFT}
    # What moved is told by the board's surface alone.
    assert {v.gate for v in report.verdicts} == set(Gate) - untested - {Gate.MOTION}
    assert {one.gate for one in report.not_tested} == untested
    report.refuse()


def test_what_was_not_tested_is_named_with_what_it_takes(good):
    report = check_calibration(replace(good, models=None))
    assert report.passed
    assert {one.gate: one.why.split()[-2:] for one in report.not_tested} == {
        Gate.HELDOUT: ["four", "poses"],
        Gate.DIFFERENCE: ["six", "poses"],
        Gate.SCALE: ["by", "hand"],
        Gate.PLANE: ["decoded", "whole"],
        Gate.REPEATABILITY: ["held", "out"],
        Gate.DRIFT: ["was", "named"],
    }
    assert "every gate" not in report.sentence()
    assert "Not tested: held-out pose (takes four poses); " in report.sentence()


def test_a_length_that_is_hardly_known_tests_nothing(good, baseline):
    known = KnownDistance(baseline, 300.0, 1e9)
    report = check_calibration(good, distances=[known])
    assert Gate.SCALE not in {v.gate for v in report.verdicts}
    (why,) = (one.why for one in report.not_tested if one.gate == Gate.SCALE)
    assert why.startswith("300 ± 1e+09 mm tell nothing of the squares: measure to 1% or better")


def test_figures_hold_all_that_a_gate_is_judged_by(good):
    parallel = calibrated(parallel_boards())
    unread = {"pose 10": "no board"}
    for calibration in (good, parallel):
        found = check_calibration(
            calibration, repeatability={"pose 1": 4.0}, unread=unread
        ).figures()
        for gate in found["gates"]:
            held = {
                one["name"]: one["value"] >= one["bound"]
                if one["sense"] == "at least"
                else one["value"] <= one["bound"]
                for one in gate["criteria"]
            }
            assert gate["passed"] == all(held.values())
            refused = any(one["refuses"] and not held[one["name"]] for one in gate["criteria"])
            assert gate["outcome"] == (
                "refused" if refused else "holds" if gate["passed"] else "warning"
            )
        assert found["passed"] == all(gate["outcome"] != "refused" for gate in found["gates"])
        outcomes = {gate["gate"]: gate["outcome"] for gate in found["gates"]}
        assert outcomes["repeatability"] == outcomes["views"] == "warning"


def test_poses_without_a_board_are_counted_and_named(good):
    report = check_calibration(good, unread={"pose 10": "no board is seen"})
    assert verdict(report, Gate.VIEWS).remedy == "pose 10 was left out: no board is seen"
    assert report.passed


def test_parallel_boards_are_refused_and_the_missing_tilts_named():
    report = check_calibration(calibrated(parallel_boards()))
    missing = verdict(report, Gate.TILT).remedy
    assert "nearly parallel" in missing
    assert "to the left and to the right and upwards and downwards, by 20° to 40°" in missing
    with pytest.raises(CalibrationRefusedError, match="tilt: the boards are nearly") as e:
        report.refuse()
    assert e.value.exit_code == 5


def test_an_image_covered_on_the_left_alone_is_refused_and_the_right_named():
    report = check_calibration(calibrated(half_covered()))
    refused = verdict(report, Gate.COVERAGE)
    assert "of the camera's image; record poses that fill the right of it" in refused.remedy
    with pytest.raises(CalibrationRefusedError, match=r"coverage: .* fill the right"):
        report.refuse()


def test_a_pose_whose_corners_are_counted_from_another_end_in_one_lens_is_left_out_by_name():
    calibration = calibrated(other_end_in_one_lens())
    assert [view.name for view in calibration.rejected_views] == ["pose 5"]
    assert calibration.solution.rms_per_point_px < 0.2
    report = check_calibration(calibration)
    assert "pose 5 was left out: camera and projector see" in verdict(report, Gate.VIEWS).remedy
    assert report.passed


def test_a_pose_with_two_corners_swapped_is_left_out_by_name():
    calibration = calibrated(swapped_corners())
    report = check_calibration(calibration)
    assert "pose 3 was left out: its corners are" in verdict(report, Gate.VIEWS).remedy
    assert report.passed


def test_a_wrong_square_is_refused_by_a_known_baseline_and_the_right_one_named(good):
    report = with_wrong_square(good)
    assert "squares of 20.0" in verdict(report, Gate.SCALE).remedy
    with pytest.raises(CalibrationRefusedError, match=r"20\.200 mm were given: measure the board"):
        report.refuse()


def test_a_warped_board_is_flagged_and_its_bow_found():
    calibration = calibrated(warped_board())
    np.testing.assert_allclose(np.abs(calibration.solution.warp_mm), BOW_MM, atol=0.1)
    report = check_calibration(calibration)
    assert re.search(r"warped by 1\.[234]\d mm", verdict(report, Gate.WARP).remedy)
    assert report.passed


def test_the_worst_plane_is_refused_if_rougher_than_its_noise(good):
    report = check_calibration(good, planes={"pose 1": 1.0, "pose 7": 3.0, "pose 2": 1.2})
    said = verdict(report, Gate.PLANE).remedy
    assert "the board of pose 7 comes out 3.0 times rougher than its noise" in said
    assert not report.passed


@pytest.mark.parametrize(("ratio", "passed"), [(4.0, True), (7.0, False), (float("nan"), False)])
def test_boards_that_differ_by_more_than_predicted_are_flagged_and_by_much_refused(
    good, ratio, passed
):
    report = check_calibration(good, repeatability={"pose 1": 1.0, "pose 2": ratio})
    assert "the board of pose 2 differs" in verdict(report, Gate.REPEATABILITY).remedy
    assert report.passed == passed
