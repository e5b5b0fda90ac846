from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from acquisition.errors import SessionError
from acquisition.session import Session
from calibration.lens import rotation
from calibration.opencv_files import write_matrices
from calibration.rig_geometry import RigGeometry
from workstation.commands.import_capture import import_capture
from workstation.destinations import DestinationError

DESCRIPTION = """
name = "test"
camera = { width = 320, height = 240 }
projector = { width = 512, height = 320 }
saturation_level = 255
[[phase_shift]]
axis = "column"
periods = 1
files = { pattern = "#.png", first = 1, last = 3 }
[calibration]
file = "c.xml"
camera_matrix = "K"
camera_distortion = "D"
projector_matrix = "KP"
projector_distortion = "DP"
rotation = "R"
translation = "T"
"""


@pytest.fixture
def capture(tmp_path, rig_geometry):
    folder = tmp_path / "files"
    folder.mkdir()
    for number in (1, 2, 3):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((240, 320), 40 * number, np.uint8))

    def matrix(lens):
        fx, fy, cx, cy = lens.intrinsics[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    matrices = {
        "K": matrix(rig_geometry.camera),
        "D": rig_geometry.camera.intrinsics[4:],
        "KP": matrix(rig_geometry.projector),
        "DP": rig_geometry.projector.intrinsics[4:],
        "R": rotation(rig_geometry.rt_proj_cam),
        "T": rig_geometry.rt_proj_cam[3:],
    }
    write_matrices(folder / "c.xml", matrices)
    (tmp_path / "capture.toml").write_text(DESCRIPTION)
    return tmp_path


def bring_in(capture, **options):
    import_capture(
        capture / "files", capture=capture / "capture.toml", out=capture / "s", **options
    )


def test_the_session_keeps_the_calibration_in_both_forms(capture, rig_geometry):
    bring_in(capture, json=capture / "figures.json")
    session = Session.open(capture / "s")
    assert session.plan.source == "test"
    assert (session.read_frame("0002") == 120).all()
    stored = RigGeometry.load(session.calibration_folder)
    np.testing.assert_allclose(stored.rt_proj_cam, rig_geometry.rt_proj_cam, atol=1e-9)
    np.testing.assert_allclose(stored.camera.intrinsics, rig_geometry.camera.intrinsics, rtol=1e-12)
    original = (capture / "files" / "c.xml").read_bytes()
    assert (session.calibration_folder / "c.xml").read_bytes() == original
    figures = json.loads((capture / "figures.json").read_text())
    assert figures == {"frames": 3, "digest": session.digest}


@pytest.mark.parametrize("name", ["2.png", "c.xml"])
def test_figures_never_replace_what_is_imported(capture, name):
    before = (capture / "files" / name).read_bytes()
    with pytest.raises(DestinationError, match="is what is read from"):
        bring_in(capture, json=capture / "files" / name)
    assert (capture / "files" / name).read_bytes() == before
    assert not (capture / "s").exists()
    bring_in(capture, json=capture / "files" / "figures.json")


def test_importing_twice_gives_the_same_session(capture):
    bring_in(capture)
    first = Session.open(capture / "s").digest
    (capture / "s").rename(capture / "first")
    bring_in(capture)
    assert Session.open(capture / "s").digest == first


def test_what_is_there_is_not_overwritten(capture):
    (capture / "s").mkdir()
    with pytest.raises(SessionError, match="exists already"):
        bring_in(capture)
    assert not list((capture / "s").iterdir())


@pytest.mark.parametrize("failure", [OSError("disk full"), KeyboardInterrupt()])
def test_a_failure_on_the_way_leaves_nothing(capture, monkeypatch, failure):
    before = sorted(capture.iterdir())
    calls = 0

    def encode(*_, **__):
        nonlocal calls
        calls += 1
        if calls == 2:
            raise failure
        return b"picture"

    monkeypatch.setattr("acquisition.session_writer.encode_frame", encode)
    with pytest.raises(type(failure)):
        bring_in(capture)
    assert calls == 2
    assert sorted(capture.iterdir()) == before
