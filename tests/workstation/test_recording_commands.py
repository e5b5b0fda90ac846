from __future__ import annotations

import json
import os
import signal
import subprocess
import time

import cv2
import numpy as np
import pytest
from impasto_command import IMPASTO, impasto

from acquisition.patterns import PhaseShift
from acquisition.plan import Purpose
from acquisition.session import Session

RIG = """
[camera]
driver = "simulated"

[projector]
driver = "simulated"

[arm]
driver = "simulated"

[mount]
driver = "simulated"

[simulation]
painting = "small_oil"
camera_width = 80
projector_width = 456
projector_height = 285
"""
FEW = ("--exposure", 2, "--exposure", 40, "--poses", 3, "--steps", 3, "--position", "left")


ONE_AXIS = ("--axes", "row", "--exposure", 45)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    file = tmp_path_factory.mktemp("rig") / "rig.toml"
    file.write_text(RIG)
    return file


def test_a_scan_at_several_exposures(rig, tmp_path):
    out = tmp_path / "s"
    done = impasto(
        *("scan", rig, "--out", out, "--exposure", 10, "--exposure", 50, "--steps", 3),
        *("--axes", "row", "--inverse", "--no-skip", "--json", tmp_path / "f.json"),
    )
    assert done.returncode == 0, done.stderr
    session = Session.open(out)
    assert (out / "rig.toml").read_text() == RIG
    # 10 and 50 ms made whole periods of 1/60 s.
    fringes = [f for f in session.frames if isinstance(f.pattern, PhaseShift)]
    assert sorted({f.exposure_s for f in fringes}) == pytest.approx([1 / 60, 3 / 60])
    assert len(fringes) == 6
    inverses = [f for f in session.frames if getattr(f.pattern, "inverse", False)]
    assert len(inverses) == 2 * 5
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["frames"] == len(session.frames)
    assert figures["digest"] == session.digest
    by_id = {entry["id"]: entry for entry in figures["contact_sheet"]}
    for frame in session.frames:
        image = session.read_frame(frame.id)
        saturated = float(np.mean(image >= session.plan.saturation_level))
        assert by_id[frame.id]["saturated"] == pytest.approx(saturated)
        assert (by_id[frame.id]["modulation"] is not None) == (frame in fringes)
    # Fringes three times as long exposed are three times as strong, where nothing saturates.
    short, long = (by_id[f.id]["modulation"] for f in fringes[:2])
    assert long / short == pytest.approx(3, rel=0.1)
    sheet = cv2.imread(str(out / "contact-sheet.png"), cv2.IMREAD_UNCHANGED)
    assert sheet.ndim == 2
    assert sheet.max() > 100


def test_photographs_from_one_place(rig, tmp_path):
    out = tmp_path / "s"
    done = impasto("photograph", rig, "--out", out, *FEW, "--json", tmp_path / "f.json")
    assert done.returncode == 0, done.stderr
    session = Session.open(out)
    assert session.plan.camera_positions == ("left",)
    assert {f.purpose for f in session.frames} == {
        Purpose.CODE,
        Purpose.DARK,
        Purpose.PHOTOGRAPH,
        Purpose.REFERENCE_POSE,
    }
    figures = json.loads((tmp_path / "f.json").read_text())
    # The simulated lamp does not drift.
    assert figures["largest_lamp_drift"] < 0.01
    assert "drifted" in done.stdout
    again = impasto("replay", out, "--out", tmp_path / "again")
    assert again.returncode == 0, again.stderr
    assert "identical" in again.stdout
    assert not (tmp_path / "again" / "contact-sheet.png").exists()


def test_a_dry_run_says_what_it_costs_and_records_nothing(rig, tmp_path):
    done = impasto(
        *("photograph", rig, "--out", tmp_path / "s", *FEW, "--flat-target", "--dry-run"),
        *("--json", tmp_path / "f.json"),
    )
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "s").exists()
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["frames"] == sum(figures["frames_by_purpose"].values())
    assert figures["frames_by_purpose"]["flat target"] == 6
    # A bracket of two for three poses, three targets, and the reference twice.
    assert figures["optional_frames"] == 8
    parts = ("seconds_frames", "seconds_light", "seconds_by_hand")
    assert figures["seconds"] == pytest.approx(sum(figures[part] for part in parts))
    assert figures["bytes_needed"] > 0.9 * figures["frames"] * 80 * 60 * 2
    assert "8 may turn out not to be needed" in done.stdout
    scan = impasto("scan", rig, "--out", tmp_path / "s", "--dry-run")
    assert scan.returncode == 0
    assert "of which up to 81 may turn out not to be needed" in scan.stdout
    assert "metered for 0.05 px" in scan.stdout
    assert "MB are free" in scan.stdout
    assert not (tmp_path / "s").exists()


def test_everything_is_taken_where_nothing_may_be_skipped(rig, tmp_path):
    out = tmp_path / "s"
    done = impasto("photograph", rig, "--out", out, *FEW, "--exposure", 10, "--no-skip")
    assert done.returncode == 0, done.stderr
    session = Session.open(out)
    assert len(session.frames) == len(session.plan.frames)


def cut_off(rig, out, number, *, after):
    """Record until some frames are there, and send a signal then."""
    words = [IMPASTO, "scan", rig, "--out", out, *ONE_AXIS]
    with subprocess.Popen(
        list(map(str, words)), stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True
    ) as process:
        while process.poll() is None and len(list((out / "frames").glob("0*.png"))) < after:
            time.sleep(0.002)
        os.kill(process.pid, number)
        process.wait(timeout=60)
    return process.returncode


@pytest.fixture(scope="module")
def whole(rig, tmp_path_factory):
    """A scan that nothing cut off."""
    out = tmp_path_factory.mktemp("whole") / "s"
    done = impasto("scan", rig, "--out", out, *ONE_AXIS)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, 130)]
)
def test_a_scan_cut_off_resumes_to_the_same_manifest(rig, whole, tmp_path, number, code):
    out = tmp_path / "cut"
    assert cut_off(rig, out, number, after=3) == code
    told = impasto("resume", out, "--dry-run")
    assert told.returncode == 0
    assert "frames are missing" in told.stdout
    resumed = impasto("resume", out)
    assert resumed.returncode == 0, resumed.stderr
    assert (out / "manifest.sha256").read_text() == (whole / "manifest.sha256").read_text()
    assert (out / "contact-sheet.png").is_file()
    (out / "contact-sheet.png").unlink()
    complete = impasto("resume", out)
    assert complete.returncode == 0
    assert "nothing to resume" in complete.stdout
    assert (out / "contact-sheet.png").is_file()


def test_what_cannot_be_recorded_ends_with_its_exit_code(rig, tmp_path):
    one_pose = (*FEW, "--poses", 1)
    full = tmp_path / "full"
    full.mkdir()
    (full / "notes.txt").write_text("somebody else's")
    cases = [
        (("scan", tmp_path / "none.toml", "--out", tmp_path / "s"), 3, "No such file"),
        (("scan", rig, "--out", tmp_path / "s", "--steps", 2), 2, "steps"),
        (("scan", rig, "--out", tmp_path / "s", "--exposure", 90_000), 4, "outside what"),
        (("scan", rig, "--out", rig.parent), 3, "which is read from"),
        (("scan", rig, "--out", full), 3, "exists already"),
        (("photograph", rig, "--out", tmp_path / "s", "--position", "roof"), 3, "'roof'"),
        (
            ("photograph", rig, "--out", tmp_path / "t", *one_pose, "--flat-target"),
            4,
            "nobody confir",
        ),
        (("resume", tmp_path / "none"), 3, "no such session"),
        (("resume", tmp_path / "t", "--rig", tmp_path / "none.toml"), 3, "no such file"),
    ]
    for arguments, code, message in cases:
        done = impasto(*arguments)
        assert done.returncode == code, (arguments, done.stderr)
        assert message in done.stderr
    assert not (tmp_path / "s").exists()
    # Nobody was at the desk for the target; what was recorded before it stays.
    assert "flat target" in impasto("resume", tmp_path / "t").stderr.replace("white ", "")
