from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic_scan import expose, fringe_patterns, make_plan

from acquisition.capture_description import Channel, NumberedFiles, read_description
from acquisition.errors import CaptureError
from acquisition.foreign_capture import find_capture, read_picture, record_capture
from acquisition.patterns import Axis
from acquisition.session import Session

CAPTURES = Path(__file__).parents[2] / "fixtures" / "captures"
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
        (break_colour, 'colour.*"mean"'),
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
        ("crop = {", 'crop = { file = "crop.json",', "crop: .*either column and row, or file"),
        ('"b.png"', '"a.png"', "a.png: one file cannot be two patterns"),
        ("periods = 1", "periods = inf", "phase_shift.0.periods"),
        ("periods = 1", "periods = 1e-320", "patterns of no use .period_px"),
        ("periods = 1", "periods = 1\norigin_rad = nan", "phase_shift.0.origin_rad"),
        ("periods = 1", "periods = 1\nshifts_rad = [0, 1]", "3 files but 2 shifts_rad"),
        (', "c.png"', "", "phase_shift.0.files"),
        ('["a.png", "b.png", "c.png"]', '{ pattern = "a.png", first = 0, last = 2 }', "pattern"),
        (
            '["a.png", "b.png", "c.png"]',
            '{ pattern = "#.png", first = 0, last = 5, step = 2 }',
            "do not lead from 0 to 5",
        ),
        (
            '["a.png", "b.png", "c.png"]',
            '{ pattern = "#.png", first = 0, last = 2147483648 }',
            "more than 10000 files",
        ),
    ],
)
def test_bad_descriptions_name_the_key(capture, old, new, message):
    (capture / "capture.toml").write_text(DESCRIPTION.replace(old, new, 1))
    with pytest.raises(CaptureError, match=message):
        bring_in(capture)


def test_a_description_nested_without_end_is_refused(capture):
    (capture / "capture.toml").write_text(f"name = {'[' * 5000}")
    with pytest.raises(CaptureError, match="brackets in brackets"):
        bring_in(capture)


def test_numbers_take_the_place_of_the_marks():
    def names(**numbers):
        return NumberedFiles(pattern="f##.png", **numbers).names

    assert names(first=8, last=11) == ("f08.png", "f09.png", "f10.png", "f11.png")
    assert names(first=5, last=1, step=-2) == ("f05.png", "f03.png", "f01.png")


def test_steps_are_spread_evenly_and_codes_are_numbered(capture):
    folder = capture / "files"
    (capture / "capture.toml").write_text(
        DESCRIPTION.replace("periods = 1", "period_px = 99\nfalling = true\ngamma = 0.8")
        + """
[[gray]]
axis = "row"
step_px = 4
offset = 0.5
threshold = "inverse"
files = { pattern = "g#.png", first = 0, last = 2 }
inverse_files = { pattern = "g#.png", first = 3, last = 5 }
"""
    )
    for number in range(6):
        cv2.imwrite(str(folder / f"g{number}.png"), np.full((12, 16), number, np.uint8))
    session = bring_in(capture)
    patterns = [frame.pattern for frame in session.plan.frames]
    steps = patterns[:3]
    assert [s.shift_rad for s in steps] == pytest.approx([0, -2 * np.pi / 3, -4 * np.pi / 3])
    assert {s.fringe for s in steps} == {("column", 99.0, 0.0, 0.8)}
    bits = patterns[3:9]
    assert [(b.bit, b.inverse) for b in bits] == [
        *((bit, False) for bit in range(3)),
        *((bit, True) for bit in range(3)),
    ]
    assert {b.code for b in bits} == {("row", 3, 4.0, 0.5)}
    assert [session.read_frame(f.id)[0, 0] for f in session.plan.frames[3:9]] == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_channel_of_a_colour_picture_is_taken_when_it_is_named(tmp_path, dtype):
    blue, green, red = np.random.default_rng(0).integers(0, 200, (3, 6, 5)).astype(dtype)
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([blue, green, red]))
    for channel, expected in (
        (Channel.RED, red),
        (Channel.GREEN, green),
        (Channel.BLUE, blue),
        (Channel.MEAN, np.round((blue.astype(float) + green + red) / 3)),
    ):
        picture = read_picture(tmp_path / "a.png", channel=channel)
        assert picture.dtype == dtype
        np.testing.assert_array_equal(picture, expected)
    cv2.imwrite(str(tmp_path / "grey.png"), green)
    np.testing.assert_array_equal(read_picture(tmp_path / "grey.png", channel=Channel.RED), green)


def test_the_crop_is_looked_up_by_the_folder(capture):
    crops = capture / "crop.json"
    text = DESCRIPTION.replace("{ column = 5, row = 7 }", '{ file = "../crop.json" }')
    (capture / "capture.toml").write_text(text)
    crops.write_text(json.dumps({"files": [3, 4, 19, 16], "others": [0, 0, 16, 12]}))
    plan = find_capture(capture / "files", read_description(capture / "capture.toml")).plan
    assert (plan.crop.column, plan.crop.row) == (3, 4)
    for content, message in (
        ('{"others": [0, 0, 16, 12]}', "no crop for files"),
        ("[3, 4, 19, 17]", "16×13, the files are 16×12"),
        ("[3, 4]", "four numbers"),
        ("nothing", "four numbers"),
    ):
        crops.write_text(content)
        with pytest.raises(CaptureError, match=rf"crop\.json.*{message}"):
            find_capture(capture / "files", read_description(capture / "capture.toml"))
    crops.unlink()
    with pytest.raises(CaptureError, match=r"crop\.json: No such file"):
        find_capture(capture / "files", read_description(capture / "capture.toml"))


def real_frames(real_data, name):
    folder = real_data / name
    capture = find_capture(folder, read_description(CAPTURES / f"{name}.toml"))
    read = {frame_id: read_picture(file).astype(float) for frame_id, file in capture.files.items()}
    return [(frame.pattern, read[frame.id]) for frame in capture.plan.frames]


def fringe(steps):
    """Phase less its origin, mean and modulation by the textbook formulas for even steps."""
    sine = sum(image * np.sin(pattern.shift_rad) for pattern, image in steps)
    cosine = sum(image * np.cos(pattern.shift_rad) for pattern, image in steps)
    phase = np.arctan2(-sine, cosine) - steps[0][0].origin_rad
    mean = sum(image for _, image in steps) / len(steps)
    return phase % (2 * np.pi), mean, 2 / len(steps) * np.hypot(sine, cosine)


def gray_cell(bits):
    """Number of the cell from bits of which each turns the next one over."""
    cell = level = 0
    for bit in bits:
        level = bit ^ level
        cell = 2 * cell + level
    return cell


def test_real_relief_gray_code_numbers_half_periods(real_data):
    frames = real_frames(real_data, "slmaster_relief_mono")
    phase, mean, modulation = fringe([f for f in frames if f[0].kind == "phase_shift"])
    cell = gray_cell([(i > mean).astype(int) for p, i in frames if p.kind == "gray"])
    lit = modulation > 10
    # Where the two halves of a period disagree is within a step's blur of their border.
    half = phase[lit] // np.pi
    assert np.mean(half == cell[lit] % 2) > 0.95
    inner = np.abs(np.abs(phase[lit] % np.pi - np.pi / 2)) < 1.2
    assert np.mean((half == cell[lit] % 2)[inner]) > 0.995


def test_real_plane_phase_and_gray_code_count_the_same_columns(real_data):
    frames = real_frames(real_data, "kamino410_gamma_plane")
    direct = [i for p, i in frames if p.kind == "gray" and not p.inverse]
    inverse = [i for p, i in frames if p.kind == "gray" and p.inverse]
    cell = gray_cell([(a > b).astype(int) for a, b in zip(direct, inverse, strict=True)])
    column = 2 * cell + 0.5
    for gamma in (0.75, 1.25):
        steps = [f for f in frames if f[0].kind == "phase_shift" and f[0].gamma == gamma]
        phase, _, modulation = fringe(steps)
        error = np.angle(np.exp(1j * (phase - 2 * np.pi * column / 240)))[modulation > 10]
        # The uncompensated response leaves waves of 0.2 rad, but no bias.
        assert np.sqrt(np.mean(error**2)) < 0.25
        assert abs(np.median(error)) < 0.05
