from __future__ import annotations

import json

import numpy as np
import pytest
import typer

from acquisition.patterns import Axis
from acquisition.session import Session
from calibration.errors import CalibrationError
from calibration.rig_geometry import RigGeometry
from devices.simulated.rig import demo_rig
from workstation.commands.scan import Axes, scan
from workstation.demonstration import true_geometry
from workstation.scan_target import REGISTRATION_SIGMA_PX, panel_sigma


@pytest.fixture(scope="module")
def rig():
    return demo_rig(camera_width=48)


def test_a_height_takes_what_it_moves_the_pattern_by(rig):
    """Held against the simulated lenses: a point on the camera's axis, and one a little nearer."""
    eye = rig.camera_lens.position
    forward = -eye / np.linalg.norm(eye)
    at = eye + np.linalg.norm(eye) * forward
    here, nearer = rig.projector_lens.project(np.stack([at, at - 0.1 * forward]))
    per_mm = np.abs(nearer - here) / 0.1
    sigma = panel_sigma(true_geometry(rig), 0.05)
    # The middle of the panel does not quite meet the canvas where the camera looks.
    assert sigma[Axis.COLUMN] == pytest.approx(0.05 * per_mm[0], rel=0.1)
    assert per_mm[1] < 0.2 * per_mm[0]
    assert sigma[Axis.ROW] == REGISTRATION_SIGMA_PX
    # A coarse target is no finer for either coordinate.
    assert panel_sigma(true_geometry(rig), 50.0)[Axis.ROW] > REGISTRATION_SIGMA_PX


def test_a_projector_behind_the_camera_tells_no_height(rig):
    geometry = true_geometry(rig)
    behind = RigGeometry(
        geometry.camera,
        geometry.projector,
        np.array([0.0, 0.0, 0.0, 0.0, 0.0, 80.0]),
    )
    with pytest.raises(CalibrationError, match="along the same line"):
        panel_sigma(behind, 0.05)


def call_scan(rig_toml, out, **changed):
    """The command as it is, with the defaults of its options."""
    options = {
        "exposure": None,
        "period": 24.0,
        "coarser": None,
        "steps": 8,
        "axes": Axes.COLUMN,
        "inverse": False,
        "target_px": None,
        "target_mm": None,
        "no_skip": False,
        "greys": None,
        "response": None,
        "exact": False,
        "calibration": None,
        "dry_run": False,
        "json": out.parent / "figures.json",
    }
    scan(rig_toml, out, **(options | changed))
    return json.loads((out.parent / "figures.json").read_text())


def test_greys_and_a_target_in_millimetres_go_into_the_plan_of_a_scan(rig, tmp_path, capsys):
    toml = tmp_path / "rig.toml"
    toml.write_text(
        '[camera]\ndriver = "simulated"\n[projector]\ndriver = "simulated"\n[simulation]\n'
        'painting = "small_oil"\ncamera_width = 48\ngamma = 2.2\n'
        "projector_width = 228\nprojector_height = 142\n"
    )
    call_scan(toml, tmp_path / "greys", greys=9, exposure=[17.0, 50.0])
    assert len(Session.open(tmp_path / "greys").recorded) == 9 * 2
    calibration = tmp_path / "calibration"
    calibration.mkdir()
    true_geometry(rig).save(calibration)
    figures = call_scan(
        toml,
        tmp_path / "s",
        response=tmp_path / "greys",
        calibration=calibration,
        target_mm=0.05,
    )
    plan = Session.open(tmp_path / "s").plan
    light = np.array(plan.response.light)
    assert light == pytest.approx(np.linspace(0, 1, 9) ** 2.2, abs=0.01)
    assert plan.metering.column_sigma_px == pytest.approx(
        panel_sigma(true_geometry(rig), 0.05)[Axis.COLUMN]
    )
    assert figures["frames"] + len(figures["skipped"]) == len(plan.frames)
    assert figures["skipped"]
    said = capsys.readouterr().out
    assert f"{len(figures['skipped'])} not needed" in said
    assert figures["skipped"][0]["reason"] in said
    with pytest.raises(typer.BadParameter, match="takes --calibration"):
        call_scan(toml, tmp_path / "u", target_mm=0.05)
