from __future__ import annotations

import json

import numpy as np
import pytest
from impasto_command import impasto

from acquisition.patterns import Axis
from acquisition.plan import Crop, Imager, Plan
from acquisition.recorded_frames import open_for_replay, recording_of
from acquisition.scan import plan_scan, scan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from devices.errors import NotRecordedError
from devices.replay import replay_rig
from devices.rig import Rig
from devices.simulated.rig import demo_rig
from workstation.demonstration import record_simulated_scan

TOML = '[camera]\ndriver = "simulated"\r\n# with a line end of another system\n'


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A session of few frames, with a rig.toml and a calibration."""
    folder = tmp_path_factory.mktemp("recorded")
    scene = demo_rig(seed=3, camera_width=80)
    rig = Rig(scene.camera, scene.projector, source="simulation")
    plan = plan_scan(rig, exposure_s=0.03, steps=3, axes=(Axis.ROW,))
    (folder / "calibration").mkdir()
    (folder / "calibration" / "camera.txt").write_text("as it was")
    options = {"rig_toml": TOML, "calibration": folder / "calibration"}
    with SessionWriter.create(folder / "s", plan, **options) as writer:
        scan(writer, rig)
    return folder / "s"


def manifest(session):
    return (session / "manifest.sha256").read_text()


def test_a_replay_ends_with_the_same_manifest(recorded, tmp_path):
    done = impasto("replay", recorded, "--out", tmp_path / "new", "--json", tmp_path / "f.json")
    assert done.returncode == 0, done.stderr
    assert "identical to the recording" in done.stdout
    assert manifest(tmp_path / "new") == manifest(recorded)
    assert (tmp_path / "new" / "rig.toml").read_bytes() == TOML.encode()
    figures = json.loads((tmp_path / "f.json").read_text())
    old, new = Session.open(recorded), Session.open(tmp_path / "new")
    assert figures == {"frames": len(old.plan.frames), "digest": old.digest, "identical": True}
    assert new.plan.source == "simulation"
    # The replay is a replay: when its frames were exposed is what the recording says.
    assert [e.wall_time for e in new.recorded.values()] == [
        e.wall_time for e in old.recorded.values()
    ]


def test_a_replay_of_a_replay_is_one_too(recorded, tmp_path):
    assert impasto("replay", recorded, "--out", tmp_path / "one").returncode == 0
    assert impasto("replay", tmp_path / "one", "--out", tmp_path / "two").returncode == 0
    assert manifest(tmp_path / "two") == manifest(recorded)


def test_scans_with_proofs_in_the_middle_replay_too(tmp_path):
    """The demo's scan, at a size where coarse Gray bits look alike, proves frames as it goes."""
    scene = demo_rig(seed=1, camera_width=40)
    record_simulated_scan(scene, tmp_path / "s")
    done = impasto("replay", tmp_path / "s", "--out", tmp_path / "new")
    assert done.returncode == 0, done.stderr
    assert manifest(tmp_path / "new") == manifest(tmp_path / "s")


def cut_off(recorded, folder, frames):
    """A copy of a session whose recording ended after some frames."""
    session = Session.open(recorded)
    with (
        pytest.raises(KeyboardInterrupt),
        SessionWriter.create(folder, session.plan) as writer,
    ):
        for number, frame in enumerate(session.plan.frames):
            if number == frames:
                raise KeyboardInterrupt
            writer.record(
                frame.id, session.read_frame(frame.id), sequence=number, exposure_applied_s=0.03
            )


def test_a_session_cut_off_replays_until_its_first_missing_frame_which_is_named(recorded, tmp_path):
    cut_off(recorded, tmp_path / "cut", 4)
    missing = Session.open(recorded).plan.frames[4].id
    done = impasto("replay", tmp_path / "cut", "--out", tmp_path / "new")
    assert done.returncode == 4
    assert f"'{missing} row fringe of 24 px at 240°' was not recorded" in done.stderr
    assert not (tmp_path / "new").exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut"]
    rig = replay_rig(recording_of(open_for_replay(tmp_path / "cut")))
    with (
        pytest.raises(NotRecordedError),
        SessionWriter.create(tmp_path / "s", Session.open(recorded).plan) as writer,
    ):
        scan(writer, rig)
    assert writer.missing[0] == missing


def test_damage_is_refused_and_nothing_written(recorded, tmp_path):
    import shutil

    shutil.copytree(recorded, tmp_path / "damaged")
    file = tmp_path / "damaged" / "frames" / "0003.png"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    done = impasto("replay", tmp_path / "damaged", "--out", tmp_path / "new")
    assert done.returncode == 3
    assert "0003.png" in done.stderr
    assert not (tmp_path / "new").exists()


def imported(folder, *, crop):
    plan = Plan(
        camera=Imager(width=32, height=24),
        projector=Imager(width=64, height=48),
        crop=Crop(column=0, row=0, width=crop[0], height=crop[1]),
        saturation_level=255,
        frames=({"id": "0000", "pattern": {"kind": "uniform", "level": 1.0}},),
        source="somebody's scanner",
    )
    with SessionWriter.create(folder, plan) as writer:
        writer.record("0000", np.full(crop[::-1], 9, np.uint8), sequence=0)
        writer.finish()


def test_imported_sessions_say_why_they_cannot_be_replayed(tmp_path):
    imported(tmp_path / "whole", crop=(32, 24))
    imported(tmp_path / "cropped", crop=(20, 10))
    for name, message in (
        ("whole", 'imported from "somebody\'s scanner"'),
        ("cropped", "holds 20×10 of a camera's 32×24"),
        ("none", "no such session"),
    ):
        done = impasto("replay", tmp_path / name, "--out", tmp_path / "new")
        assert done.returncode == 3
        assert message in done.stderr
    assert not (tmp_path / "new").exists()


def test_an_existing_folder_is_left_alone(recorded, tmp_path):
    done = impasto("replay", recorded, "--out", tmp_path)
    assert done.returncode == 3
    assert "exists already" in done.stderr


def test_a_replay_into_the_session_that_it_reads_is_refused(recorded):
    done = impasto("replay", recorded, "--out", recorded / "frames" / "again")
    assert done.returncode == 3
    assert "lies in" in done.stderr
    assert Session.open(recorded).recorded
