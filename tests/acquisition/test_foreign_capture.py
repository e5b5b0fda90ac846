from __future__ import annotations

import cv2
import numpy as np
import pytest
from synthetic_scan import expose, fringe_patterns, make_plan

from acquisition.errors import CaptureError
from acquisition.foreign_capture import find_capture, read_description, record_capture
from acquisition.patterns import Axis
from acquisition.session import Session

DESCRIPTION = """
name = "test"
camera = { width = 40, height = 30 }
projector = { width = 512, height = 320 }
saturation_level = 255
crop = { column = 5, row = 7 }
white = "w.png"
[[phase_shift]]
axis = "column"
periods = 1
files = ["a.png", "b.png", "c.png"]
"""


@pytest.fixture
def capture(tmp_path):
    plan = make_plan(fringe_patterns(Axis.COLUMN, period=512.0, steps=3), width=16, height=12)
    images = expose(plan, {Axis.COLUMN: np.tile(np.arange(16.0), (12, 1))}, mean=100, modulation=80)
    folder = tmp_path / "files"
    folder.mkdir()
    for name, image in zip("abc", images.values(), strict=True):
        cv2.imwrite(str(folder / f"{name}.png"), image.astype(np.uint8))
    cv2.imwrite(str(folder / "w.png"), np.full((12, 16, 3), 180, np.uint8))
    (tmp_path / "capture.toml").write_text(DESCRIPTION)
    return tmp_path


def bring_in(capture):
    found = find_capture(capture / "files", read_description(capture / "capture.toml"))
    record_capture(found, capture / "session")
    return Session.open(capture / "session")


def test_a_capture_becomes_a_session(capture):
    session = bring_in(capture)
    assert [f.pattern.kind for f in session.plan.frames] == ["phase_shift"] * 3 + ["uniform"]
    assert (session.plan.crop.column, session.plan.crop.row) == (5, 7)
    assert session.plan.frames[1].pattern.shift_rad == pytest.approx(2 * np.pi / 3)
    original = cv2.imread(str(capture / "files" / "b.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(session.read_frame("0001"), original)
    assert (session.read_frame("0003") == 180).all()


def break_colour(folder):
    image = np.full((12, 16, 3), 180, np.uint8)
    image[..., 0] = 20
    cv2.imwrite(str(folder / "files/b.png"), image)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda c: (c / "files/b.png").unlink(), r"b\.png is missing"),
        (lambda c: (c / "files/b.png").write_bytes(b"\x89PNG"), r"b\.png: truncated"),
        (lambda c: cv2.imwrite(str(c / "files/b.png"), np.zeros((9, 16), np.uint8)), "one size"),
        (break_colour, "colour"),
    ],
)
def test_bad_files_are_named_and_leave_no_finished_session(capture, damage, message):
    damage(capture)
    with pytest.raises(CaptureError, match=message):
        bring_in(capture)
    if (capture / "session").exists():
        assert not (capture / "session" / "manifest.sha256").exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("periods = 1", "", "either periods or period_px"),
        ("saturation_level = 255", "", "saturation_level"),
        ('axis = "column"', 'axis = "diagonal"', "axis"),
        ("white", "whit", "whit"),
        ("name = ", "name ", "not TOML"),
        ("column = 5", "column = 30", "outside the sensor"),
    ],
)
def test_bad_descriptions_name_the_key(capture, old, new, message):
    (capture / "capture.toml").write_text(DESCRIPTION.replace(old, new, 1))
    with pytest.raises(CaptureError, match=message):
        bring_in(capture)
