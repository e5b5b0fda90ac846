from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from calibration.rig_geometry import RigGeometry
from devices.simulated.rig import demo_rig
from fitting.copy_files import read_copy
from workstation.demonstration import record_simulated_scan
from workstation.processing import process_session


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    path = tmp_path_factory.mktemp("scan") / "session"
    record_simulated_scan(demo_rig(camera_width=240), path)
    return path


def test_figures_tell_what_is_known_and_what_is_not(session):
    figures = process_session(session).figures
    json.dumps(figures, allow_nan=False)
    assert figures["calibration_uncertainty"].startswith("unknown")
    assert figures["warnings"] == []
    shape = figures["canvas_shape"]
    # The stretcher bows by 0.3 mm; strokes leave it uncertain by some hundredths.
    assert shape["bow_x_mm"] == pytest.approx(0.3, abs=5 * shape["bow_x_sigma_mm"] + 0.15)
    assert 0 < shape["bow_x_sigma_mm"] < 0.3
    assert figures["delta0_mm"] == figures["delta0_proposed_mm"]
    assert min(figures["footprint_mm"]) >= 2 * figures["pitch_mm"] * 0.8
    assert np.shape(figures["height_correlation"]) == (7, 7)
    assert 0 < figures["height_unresolved_mm"] < figures["height_range_mm"][1]


def test_an_uncertain_calibration_shows_in_the_figures(session, tmp_path):
    rig = RigGeometry.load(session / "calibration")
    sigma = np.zeros(len(rig.parameters))
    sigma[-6:] = [1e-3, 1e-3, 1e-3, 0.2, 0.2, 0.2]
    RigGeometry(rig.camera, rig.projector, rig.rt_proj_cam, np.diag(sigma**2)).save(tmp_path)
    figures = process_session(session, calibration=tmp_path).figures
    assert figures["calibration_uncertainty"]["height_sigma_mm"] > 1e-3


def test_the_command_writes_a_picture_beside_the_copy_and_takes_a_seed(session, tmp_path):
    out, figures = tmp_path / "copy", tmp_path / "figures.json"
    arguments = ["process", str(session), "--out", str(out), "--json", str(figures)]
    arguments += ["--seed", "90", "120", "--delta0", "0.4"]
    command = [sys.executable, "-m", "workstation.command_line", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "copy-relief.png").read_bytes().startswith(b"\x89PNG")
    written = json.loads(figures.read_text())
    assert written["delta0_mm"] == 0.4
    assert written["delta0_proposed_mm"] != 0.4
    copy = read_copy(out)
    assert copy.provenance["warnings"] == []
    assert copy.relief.delta0_mm == 0.4


HELD = """
import os, signal, sys, time
from workstation.interruption import interruption_held, watch_for_interruption

watch_for_interruption()
try:
    with interruption_held():
        os.kill(os.getpid(), signal.{signal})
        time.sleep(0.3)
        print("whole", flush=True)
    print("went on", flush=True)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_request_to_stop_waits_for_the_kernels(name):
    done = subprocess.run(
        [sys.executable, "-c", HELD.format(signal=name)],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stdout.split() == ["whole", "interrupted"], done.stderr
