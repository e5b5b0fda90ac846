from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from blistered_board import BOARD, NOISE_PX, RIG, SHEAR, TURN, poses, printed_corners, simulated

from acquisition.plan import Imager
from calibration.board_views import BoardView
from calibration.errors import CalibrationError, CalibrationRefusedError
from calibration.gate_limits import Gate
from calibration.gates import check_calibration
from calibration.lens import compose, transform
from calibration.procam import ProcamOptions, rejected_corners
from calibration.rig_geometry import RigGeometry
from calibration.surface_files import SURFACE_FILE, save_surface, solve_saved_surface
from workstation import calibration_report, calibration_run
from workstation.board_poses import BoardPoses
from workstation.calibration_extras import Extras
from workstation.calibration_messages import messages_on_rig
from workstation.calibration_report import write_report
from workstation.calibration_run import RigAsked, run_calibration
from workstation.rig_calibration import calibrate_rig

OPTIONS = ProcamOptions(models=("LENSMODEL_OPENCV4",), board_shape=True)


@pytest.fixture(scope="module")
def measured():
    rng = np.random.default_rng(2)
    corners, samples = simulated(rng, drift=TURN)
    views = []
    for number, (seen, pose) in enumerate(zip(corners, poses(), strict=True)):
        moved = compose(TURN * (number == 1), RIG.rt_proj_cam)
        lit = RIG.projector.project(transform(compose(moved, pose), printed_corners()))
        lit = lit + rng.normal(0, NOISE_PX, lit.shape)
        views.append(BoardView.of(f"pose {number + 1}", [seen, lit], sigma_px=NOISE_PX))
    surfaces = {view.name: one for view, one in zip(views, samples, strict=True)}
    camera, projector = (Imager(width=w, height=h) for w, h in ((1600, 1200), (1280, 800)))
    return BoardPoses(tuple(views), {}, BOARD, False, (), camera, projector, {}, surfaces)


@pytest.fixture(scope="module")
def done(measured):
    return calibrate_rig(measured, options=OPTIONS)


def test_the_rig_is_that_of_the_surface_and_its_error_bars_hold(done):
    calibration = done.calibration
    found = calibration.rig_with_covariance()
    error = (found.parameters - RIG.parameters)[:4]
    sigma = np.sqrt(np.diag(found.covariance))[:4]
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 2
    assert sigma[0] < 3
    # The boards cover the middle alone: the lens is known there, and elsewhere not.
    worst = done.uncertainty[0].worst_sigma_px
    assert worst.min() < 0.05
    assert worst.max() > 1
    # What corners leave in the camera is their noise; in the projector they took no part.
    assert calibration.solution.sigma0 == 1
    camera = calibration.solution.residuals_px[:, 0]
    assert np.sqrt(np.mean(camera**2)) < 1.3 * NOISE_PX
    np.testing.assert_allclose(calibration.views[0].sigma_px[0], NOISE_PX, rtol=0.4)


def test_a_projector_that_moved_is_flagged_by_the_pose_and_the_board_by_its_relief(done):
    verdicts = {v.gate: v for v in done.gates.verdicts}
    assert verdicts[Gate.MOTION].outcome == "warning"
    assert "in pose 2 the projector stood" in verdicts[Gate.MOTION].remedy
    assert verdicts[Gate.WARP].outcome == "warning"
    names = [one.name for one in verdicts[Gate.RESIDUALS].criteria]
    assert "RMS of the surface's blocks, worst pose, px" in names
    assert verdicts[Gate.RESIDUALS].passed


def test_blocks_that_are_off_are_what_is_said_to_be_off(done):
    dense = done.calibration.surface
    rms = dense.sample_rms_px.copy()
    rms[2] = 0.8
    bad = replace(done.calibration, surface=replace(dense, sample_rms_px=rms))
    verdict = next(v for v in check_calibration(bad).failures if v.gate is Gate.RESIDUALS)
    assert "the white of the board is 1.13 px off" in verdict.remedy
    assert "most of all in pose 3" in verdict.remedy


def test_corners_left_out_are_a_share_of_those_that_took_part(done):
    # By the surface the projector's corners take no part: of the camera's 6 % are left out.
    solution = done.calibration.solution
    outliers = np.zeros_like(solution.outliers)
    outliers[:, 0].flat[:12] = True
    solution = replace(solution, outliers=outliers)
    bad = replace(done.calibration, solution=solution, rejected_corners=rejected_corners(solution))
    verdict = next(v for v in check_calibration(bad).failures if v.gate is Gate.RESIDUALS)
    assert verdict.refuses
    assert "6% of the corners were left out" in verdict.remedy


def test_figures_lines_and_page_say_what_the_surface_showed(done, tmp_path, monkeypatch):
    # The page's other pictures are those of any calibration, and are tried there.
    monkeypatch.setattr(calibration_report, "_pictures", lambda _: defaultdict(list))
    write_report(done, tmp_path)
    surface = json.loads((tmp_path / "report.json").read_text())["surface"]
    shear, sigma = surface["shear_mrad"], surface["shear_sigma_mrad"]
    assert abs(shear - 1000 * SHEAR) < 3 * sigma < 0.2
    turns = {pose["name"]: pose["turn_mrad"] for pose in surface["poses"]}
    assert max(turns, key=turns.get) == "pose 2"
    said = " ".join(messages_on_rig(done).said)
    assert f"printed askew by {shear:+.2f} ± {sigma:.2f} mrad" in said
    assert "moved against one another by up to" in said
    page = (tmp_path / "index.html").read_text()
    assert '<section id="surface-of-the-board">' in page
    assert "Relief of the board" in page


def test_what_was_saved_is_solved_again(done, tmp_path):
    done.calibration.save(tmp_path)
    again, names = solve_saved_surface(tmp_path)
    assert names == done.calibration.solution.names
    loaded = RigGeometry.load(tmp_path)
    sigma = np.sqrt(np.diag(loaded.covariance))
    assert (np.abs(again.rig.parameters - loaded.parameters) < 0.2 * sigma).all()


def test_a_surface_file_that_is_damaged_or_of_another_board_is_refused(done, tmp_path):
    path = tmp_path / SURFACE_FILE
    save_surface(done.calibration.surface, done.calibration.solution.names, path)
    whole = path.read_bytes()
    with np.load(path) as stored:
        arrays = dict(stored)
    for cut in (0, 4, len(whole) // 2, len(whole) - 10):
        path.write_bytes(whole[:cut])
        with pytest.raises(CalibrationError, match="calibrate with --board-shape"):
            solve_saved_surface(tmp_path)
    bent = bytearray(whole)
    bent[len(whole) // 2] ^= 0xFF
    path.write_bytes(bent)
    with pytest.raises(CalibrationError, match="calibrate with --board-shape"):
        solve_saved_surface(tmp_path)
    changes = {"grid": np.array(8), "names": np.array(["one"]), "variance": arrays["tile"]}
    for name, other in changes.items():
        np.savez(path, **(arrays | {name: other}))
        with pytest.raises(CalibrationError, match="calibrate with --board-shape"):
            solve_saved_surface(tmp_path)


class Lights:
    """A light arm that is refused, or cannot be calibrated."""

    def __init__(self, error=None):
        self.error = error
        self.gates = self

    passed = False

    def refuse(self):
        raise CalibrationRefusedError("the calibration is refused. residuals: blurred highlights")

    def figures(self):
        return {"passed": False}

    def calibrate(self, rig, *, begin):
        if self.error:
            raise self.error
        return self


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (None, 5, "light arm: the calibration is refused. residuals: blurred highlights"),
        (CalibrationError("no sphere is seen"), 3, "no sphere is seen"),
    ],
)
def test_a_rig_that_passed_is_kept_where_its_lights_fail(
    done, measured, tmp_path, monkeypatch, error, code, message
):
    passed = replace(done, gates=replace(done.gates, verdicts=()))
    monkeypatch.setattr(calibration_run, "find_sessions", tuple)
    monkeypatch.setattr(calibration_run, "measure_poses", lambda *_, **__: measured)
    monkeypatch.setattr(calibration_run, "calibrate_rig", lambda *_, **__: passed)
    asked = RigAsked(
        sessions=(),
        board=BOARD,
        options=OPTIONS,
        compensate_phases=False,
        held_out=0,
        baseline_mm=None,
        earlier=(),
    )
    extras = Extras(Lights(error), (), None, None)
    outcome = run_calibration(asked, extras, report=None)
    out = tmp_path / "rig"
    outcome.save(out, extras, replace=False)
    assert RigGeometry.load(out).covariance is not None
    assert not (out / "lamps.json").exists()
    with pytest.raises(CalibrationError) as raised:
        outcome.refuse(out)
    assert raised.value.exit_code == code
    assert str(raised.value).startswith(message)
    assert f"are kept in {out}; when this is mended calibrate the lights alone" in str(raised.value)


def test_a_rig_that_is_refused_is_not_written(done, tmp_path):
    bad = replace(
        done,
        gates=replace(
            done.gates,
            verdicts=tuple(
                replace(v, criteria=tuple(replace(c, value=np.nan) for c in v.criteria))
                for v in done.gates.verdicts
            ),
        ),
    )
    outcome = calibration_run.CalibrationOutcome(bad, None, None, {})
    with pytest.raises(CalibrationRefusedError):
        outcome.save(tmp_path / "rig", Extras(None, (), None, None), replace=False)
    assert not (tmp_path / "rig").exists()
