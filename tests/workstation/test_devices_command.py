from __future__ import annotations

import io
import json
import os
import pty
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from impasto_command import IMPASTO, impasto

from devices.search import SEARCHED
from devices.simulated.grbl_controller import SimulatedGrblController
from devices.simulated.grbl_port import SimulatedGrblPort
from workstation.commands.devices import _print_table
from workstation.confirmation import confirm_at_desk

RIGS = Path(__file__).parents[2] / "fixtures" / "rigs"
SMALL = '[simulation]\npainting = "white"\ncamera_width = 48\n'


def test_help_shows_an_example():
    done = impasto("devices", "--help")
    assert "Example:" in done.stdout
    assert "impasto devices rig.toml" in done.stdout


def test_a_search_tells_what_every_driver_found(tmp_path):
    done = impasto("devices", "--json", tmp_path / "f.json", "--limit", "30")
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "f.json").read_text())
    assert {entry["driver"] for entry in figures} == {driver.name for driver in SEARCHED}
    for entry in figures:
        assert set(entry) == {"driver", "kind", "missing", "problem", "found"}
        assert entry["driver"] in done.stdout
        for found in entry["found"]:
            assert set(found) == {"address", "model", "problem"}
    assert "searching for devices" in done.stderr
    assert "searching for devices" not in done.stdout


def test_a_missing_package_is_information_and_no_error(tmp_path, monkeypatch):
    for name in ("gphoto2", "serial"):
        (tmp_path / f"{name}.py").write_text("raise ImportError('not here')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    words = [str(IMPASTO), "devices", "--json", str(tmp_path / "f.json")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    figures = {e["driver"]: e for e in json.loads((tmp_path / "f.json").read_text())}
    for driver, package in (("gphoto2", "gphoto2"), ("grbl", "pyserial")):
        assert f"pip install {package}" in figures[driver]["missing"]
        assert figures[driver]["problem"] is None
        assert figures[driver]["found"] == []
    assert "not installed: " in done.stdout


def test_a_driver_that_takes_too_long_is_given_up_and_said_so(tmp_path):
    done = impasto("devices", "--json", tmp_path / "f.json", "--limit", "0.1")
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "f.json").read_text())
    assert len(figures) == len(SEARCHED)
    assert any("did not answer within 0.1 s" in (entry["problem"] or "") for entry in figures)


def test_devices_of_a_rig_that_answer_are_listed(tmp_path):
    done = impasto("devices", RIGS / "simulated.toml", "--json", tmp_path / "f.json")
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "f.json").read_text())
    assert [entry["device"] for entry in figures] == ["arm", "projector", "mount", "camera"]
    assert all(entry["problem"] is None and entry["driver"] == "simulated" for entry in figures)
    for text in ("400×300", "912×570", "position unknown until homed", "front, left, right"):
        assert text in done.stdout


def test_a_real_arm_on_a_simulated_line_answers_beside_a_simulated_camera(tmp_path):
    with SimulatedGrblPort(SimulatedGrblController()) as port:
        arm = f'[arm]\ndriver = "grbl"\nport = "{port.address}"\n'
        text = f'[camera]\ndriver = "simulated"\n{arm}{SMALL}'
        (tmp_path / "rig.toml").write_text(text)
        done = impasto("devices", tmp_path / "rig.toml")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "48×36" in done.stdout


def test_a_device_that_does_not_answer_ends_with_exit_code_4_and_the_others_are_told(tmp_path):
    text = (
        '[camera]\ndriver = "simulated"\n[arm]\ndriver = "grbl"\nport = "/dev/ttyNOPE"\n'
        f'[projector]\ndriver = "hdmi"\nscreen = "HDMI-1"\nwidth = 912\nheight = 1140\n{SMALL}'
    )
    (tmp_path / "rig.toml").write_text(text)
    done = impasto("devices", tmp_path / "rig.toml", "--json", tmp_path / "f.json")
    assert done.returncode == 4
    assert "arm, projector of 3 devices did not answer" in done.stderr
    figures = {e["device"]: e for e in json.loads((tmp_path / "f.json").read_text())}
    assert figures["camera"]["problem"] is None
    assert figures["camera"]["model"] == "simulated camera"
    assert "/dev/ttyNOPE" in figures["arm"]["problem"]
    assert "[projector] of" in figures["projector"]["problem"]


@pytest.mark.parametrize("limit", ["nan", "inf", "0", "-1"])
def test_a_time_that_would_never_come_is_a_wrong_use(limit):
    done = impasto("devices", "--limit", limit)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


def test_a_pipe_gets_lines_that_need_no_folding(capsys):
    problem = "a long sentence that says what is wrong, where, and what to do next; " * 2
    _print_table(("driver", "state"), [("grbl", problem.strip())])
    assert problem.strip() in capsys.readouterr().out


def test_a_bad_rig_file_ends_with_exit_code_3(tmp_path):
    (tmp_path / "rig.toml").write_text('[camera]\ndriver = "simulatd"\n')
    done = impasto("devices", tmp_path / "rig.toml")
    assert done.returncode == 3
    assert "line 2: camera.driver: there is no 'simulatd'; did you mean simulated?" in done.stderr


def test_an_interrupted_search_ends_at_once(ending_signal):
    running = subprocess.Popen(
        [str(IMPASTO), "devices"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert running.stderr is not None
    running.stderr.readline()
    time.sleep(0.3)
    running.send_signal(ending_signal)
    assert running.wait(timeout=20) == 130


@pytest.mark.parametrize(
    ("typed", "done"),
    [("\n", True), ("done\n", True), ("no\n", False), ("N\n", False), ("", False)],
)
def test_somebody_at_the_desk_confirms_a_move(monkeypatch, capsys, typed, done):
    master, slave = pty.openpty()
    with os.fdopen(slave, "r") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        writer = threading.Thread(target=os.write, args=(master, typed.encode() or b"\x04"))
        writer.start()
        assert confirm_at_desk("Move the camera.") is done
        writer.join()
    os.close(master)
    asked = capsys.readouterr()
    assert "Move the camera." in asked.err
    assert asked.out == ""


def test_nobody_at_the_desk_confirms_nothing(monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))
    assert confirm_at_desk("Move the camera.") is False
    assert "Nobody is at the desk" in capsys.readouterr().err
