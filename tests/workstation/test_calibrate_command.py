from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import check_page
from impasto_command import impasto

from acquisition.scan import plan_scan, scan
from acquisition.session_writer import SessionWriter
from calibration.lens import compose, invert, rt_from_matrix, transform
from calibration.mrcal_solution import load_solution
from calibration.rig_geometry import CAMERA_FILE, PROJECTOR_FILE, RigGeometry
from devices.simulated.board import make_board
from devices.simulated.rig import SimulatedRig
from devices.simulated.scene_objects import PlacedSurface
from devices.simulated.settings import PaintingKind, SimulationSettings
from devices.simulated.surface import Surface
from workstation.demonstration import EXPOSURE_S, true_geometry
from workstation.processing import process_session

BOARD = ("--corners", 14, 10, "--square", 20, "--marker", 15, "--dictionary", "DICT_5X5_1000")
# Tilt about x and y, turn, and place of the board's middle.
POSES = (
    (0.35, 0.0, 0.1, 40, 30, 30),
    (-0.35, 0.0, -0.1, -40, -30, 0),
    (0.0, 0.4, 0.0, -30, 35, 30),
    (0.0, -0.2, 0.15, 40, -30, -40),
    (0.3, 0.3, 0.05, 0, 0, -50),
    (-0.3, 0.25, -0.1, -50, 40, 40),
)


def record(rig: SimulatedRig, out: Path) -> None:
    devices = rig.open()
    plan = plan_scan(devices, exposure_s=EXPOSURE_S, steps=4)
    with SessionWriter.create(out, plan) as writer:
        scan(writer, devices)


@pytest.fixture(scope="module")
def rig():
    rig = SimulationSettings(
        painting=PaintingKind.WHITE,
        camera_width=480,
        projector_width=640,
        projector_height=400,
        positions={"front": (-39.0, 19.0, 710.0)},
    ).build()
    # Its grid as fine as the camera's pixels, twice as coarse as the board of the settings.
    rig.scene.replace_subject(PlacedSurface(make_board(pitch_mm=0.25)))
    return rig


@pytest.fixture(scope="module")
def poses(rig, tmp_path_factory):
    folder = tmp_path_factory.mktemp("poses")
    for number, pose in enumerate(POSES, start=1):
        rig.scene.move_subject(np.array(pose, float))
        record(rig, folder / f"pose-{number}")
    return folder


@pytest.fixture(scope="module")
def calibrated(rig, poses, tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrated")
    # The true rig as the earlier one: nothing has drifted.
    true_geometry(rig).save(folder / "earlier")
    done = impasto(
        *("calibrate", poses, *BOARD, "--square-sigma", 0.002, "--model", "opencv5"),
        *("--held-out", 2),
        *("--out", folder / "rig", "--report", folder / "report", "--json", folder / "f.json"),
        *("--opencv", folder / "rig.xml", "--earlier", folder / "earlier"),
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_boards_give_the_rig_as_it_truly_is_within_its_uncertainty(rig, calibrated):
    found, true = RigGeometry.load(calibrated / "rig"), true_geometry(rig)
    distance = json.loads((calibrated / "f.json").read_text())["working_distance_mm"]
    x, y = np.meshgrid(np.linspace(-90, 90, 7), np.linspace(-60, 60, 5))
    points = np.stack([x, y, np.full_like(x, distance)], axis=-1)
    for lens, seen in ((found.camera, true.camera), (found.projector, true.projector)):
        assert lens.width == seen.width
        assert np.abs(lens.focal_px / seen.focal_px - 1).max() < 0.003
    ends = [r.projector.project(transform(r.rt_proj_cam, points)) for r in (found, true)]
    assert np.median(np.linalg.norm(ends[0] - ends[1], axis=-1)) < 1.0
    sigma = np.sqrt(np.diag(found.covariance))
    # With the scale of the squares: one in ten thousand of the baseline.
    assert sigma[-3] > 1e-4 * abs(found.rt_proj_cam[3]) * 0.99
    error = np.linalg.norm(found.rt_proj_cam[3:]) - np.linalg.norm(true.rt_proj_cam[3:])
    assert abs(error) < 5 * np.linalg.norm(sigma[-3:]) + 0.1


def test_the_models_carry_what_they_were_solved_from(calibrated):
    for name in (CAMERA_FILE, PROJECTOR_FILE):
        solution = load_solution(calibrated / "rig" / name)
        assert len(solution.rt_ref_board) == len(POSES)
        figures = json.loads((calibrated / "f.json").read_text())
        assert solution.rms_per_point_px == pytest.approx(figures["stereo_px"], rel=1e-6)


def test_matrices_for_opencv_are_those_of_the_rig(calibrated):
    storage = cv2.FileStorage(str(calibrated / "rig.xml"), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("projector_matrix").mat()
    rig = RigGeometry.load(calibrated / "rig")
    np.testing.assert_allclose(matrix[[0, 1], [0, 1]], rig.projector.focal_px)
    np.testing.assert_allclose(storage.getNode("translation").mat().ravel(), rig.rt_proj_cam[3:])


def test_the_report_asks_nothing_of_the_net_and_shows_every_part(calibrated):
    page = (calibrated / "report" / "index.html").read_text()
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)
    assert "url(" not in page
    assert "<script" not in page
    for heading in ("Gates", "Uncertainty", "Residuals", "Coverage", "Cross-validation", "History"):
        assert f"<h2>{heading}</h2>" in page
    assert page.count("data:image/png;base64,") >= 17
    assert "pose-4" in page
    report = json.loads((calibrated / "report" / "report.json").read_text())
    assert report["passed"] is True
    # No length was measured by hand.
    assert [one["gate"] for one in report["not_tested"]] == ["scale"]
    assert "Passed: every gate holds" not in page
    assert "Not tested: scale (no length was measured by hand)" in page
    assert page.count("<strong>not tested</strong>") == 1
    for plane in report["heldout_planes"]:
        assert plane["rms_mm"] < 1.3 * plane["predicted_noise_mm"]
        assert abs(plane["scale_error"]) < 1e-3
    repeated = report["repeatability"]
    assert len(repeated["rms_mm"]) == 2
    ratios = np.divide(repeated["rms_mm"], repeated["predicted_mm"])
    assert ((ratios > 0.7) & (ratios < 1.3)).all()
    assert report["earlier"][0]["over_predicted"] < 2.5
    assert len(report["sessions"]) == len(POSES)


def test_the_report_is_whole_and_reachable_in_a_browser(browser, calibrated):
    check_page(browser, calibrated / "report" / "index.html")


def test_a_relief_scanned_by_the_calibrated_rig_errs_as_much_as_predicted(
    rig, calibrated, tmp_path
):
    x, y = np.meshgrid(np.linspace(-180, 180, 361), np.linspace(140, -140, 281))
    waves = 0.8 * np.sin(x / 22.0) * np.cos(y / 18.0)
    board = rig.scene.subject
    relief = Surface.uniform(
        waves.astype(np.float32), pitch_mm=1.0, canvas_mm=(340.0, 260.0), back_mm=-4.0
    )
    try:
        rig.scene.replace_subject(PlacedSurface(relief))
        record(rig, tmp_path / "scan")
        done = process_session(tmp_path / "scan", calibration=calibrated / "rig")
        field = done.copy.height_field
        at = np.stack(np.meshgrid(field.texel_x_mm(), field.texel_y_mm()), axis=-1)[field.mask]
        points = np.column_stack([at, field.height[field.mask]]).astype(np.float64)
        camera = rig.camera_lens
        in_scene = compose(
            invert(rt_from_matrix(camera.rotation, camera.translation)), field.rt_cam_canvas
        )
        points = transform(in_scene, points)
        points = points[(np.abs(points[:, :2]) < [150, 110]).all(axis=1)]
        error = points[:, 2] - relief.height_at(points[:, 0], points[:, 1])
    finally:
        rig.scene.replace_subject(board)
    # Where the calibration puts the whole is told by its covariance, and no error of the relief.
    plane = np.column_stack([np.ones(len(points)), points[:, :2]])
    bent = error - plane @ np.linalg.lstsq(plane, error, rcond=None)[0]
    calibration_mm = done.figures["calibration_uncertainty"]["height_sigma_mm"]
    predicted = np.sqrt(np.mean(field.variance[field.mask]) + calibration_mm**2)
    assert len(error) > 100_000
    assert 0.85 < np.sqrt(np.mean(bent**2)) / predicted < 1.2
    assert abs(error.mean()) < 0.5


def test_too_few_tilts_are_refused_with_code_5_and_nothing_is_written(poses, tmp_path):
    some = [poses / f"pose-{number}" for number in (2, 2, 4, 1)]
    done = impasto(
        *("calibrate", *some, *BOARD, "--model", "opencv4", "--raw-phases", "--baseline", 300),
        *("--baseline-sigma", 0.5, "--out", tmp_path / "rig", "--json", tmp_path / "f.json"),
    )
    assert done.returncode == 5, done.stderr
    assert "the calibration is refused" in done.stderr
    assert "measure the board" in done.stderr
    assert not (tmp_path / "rig").exists()
    assert json.loads((tmp_path / "f.json").read_text())["passed"] is False


def test_a_model_that_there_is_none_of_is_refused_at_once_even_beside_a_good_one(poses):
    done = impasto("calibrate", poses, *BOARD, "--model", "opencv4", "--model", "nonsense")
    assert done.returncode == 3
    assert "LENSMODEL_NONSENSE is no lens model that can be solved for; there are" in done.stderr


POSE = "a pose of the board"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--out", "rig", "--report", "rig"), "--report rig is or lies in what --out names"),
        (("--opencv", "nowhere/rig.yml"), "there is no folder nowhere"),
        (("--report", "report", "--greys", "nowhere"), "nowhere: no such session"),
        (("--greys", "nowhere"), "--greys and --chart are shown in the report: name --report"),
        (("--earlier", "."), "holds no calibration of camera and projector"),
        (("--report", "report", "--chart", POSE), "name the order of its colours with --mosaic"),
    ],
)
def test_what_cannot_be_read_or_written_is_refused_before_the_solve(
    poses, tmp_path, options, message
):
    named = [poses / "pose-1" if option is POSE else option for option in options]
    done = impasto("calibrate", poses, *BOARD, *named, cwd=tmp_path)
    assert done.returncode in (2, 3, 5)
    assert message in re.sub(r"[\s│]+", " ", done.stderr)
    assert not list(tmp_path.iterdir())


def test_poses_are_never_replaced_by_a_calibration(poses):
    for out in (poses, poses / "pose-1", poses / "pose-1" / "rig"):
        done = impasto("calibrate", poses, *BOARD, "--out", out, "--force")
        assert done.returncode == 3
        assert f"--out {out}" in done.stderr
    assert len(list(poses.glob("*/plan.json"))) == len(POSES)


def test_a_pose_under_two_names_is_refused_with_both(poses, tmp_path):
    copy = tmp_path / "again"
    shutil.copytree(poses / "pose-3", copy)
    done = impasto("calibrate", poses / "pose-1", poses / "pose-3", copy, *BOARD)
    assert done.returncode == 3
    assert "pose-3 and again are the same recording; name each pose once" in done.stderr


def test_boards_that_are_not_there_and_folders_that_hold_nothing_are_named(poses, tmp_path):
    other = ("--corners", 5, 4, "--square", 20, "--marker", 10, "--dictionary", "DICT_4X4_50")
    done = impasto("calibrate", poses / "pose-1", *other)
    assert done.returncode == 3
    assert "the board was measured in 0 of 1 sessions" in done.stderr
    done = impasto("calibrate", tmp_path, "--corners", 5, 4, "--square", 20)
    assert done.returncode == 3
    assert "is no session, nor does it hold any" in done.stderr
