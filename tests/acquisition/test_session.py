from __future__ import annotations

import os

import numpy as np
import pytest
from synthetic_scan import expose, fringe_patterns, make_plan

from acquisition.errors import SessionError
from acquisition.patterns import Axis
from acquisition.session import Session
from acquisition.session_writer import SessionWriter


class Killed(BaseException):
    """Stands for the end of the process: nothing after it runs."""


@pytest.fixture
def plan():
    return make_plan(fringe_patterns(Axis.COLUMN, period=600.0, steps=3), width=16, height=12)


@pytest.fixture
def frames(plan):
    return expose(plan, {Axis.COLUMN: np.tile(np.arange(16.0) * 9, (12, 1))})


def record_rest(writer, frames):
    for frame_id in writer.missing:
        writer.record(frame_id, frames[frame_id], sequence=int(frame_id) + 1)
    writer.finish()


@pytest.fixture
def session(tmp_path, plan, frames):
    with SessionWriter.create(tmp_path / "session", plan, rig_toml="a = 1\n") as writer:
        record_rest(writer, frames)
    return tmp_path / "session"


def test_frames_come_back_as_recorded(session, plan, frames):
    opened = Session.open(session)
    assert opened.plan == plan
    for frame_id, image in frames.items():
        np.testing.assert_array_equal(opened.read_frame(frame_id), image)


def test_killed_at_any_flush_or_rename_it_resumes_to_the_same_manifest(
    session, tmp_path, plan, frames, monkeypatch
):
    manifest = (session / "manifest.sha256").read_bytes()
    steps = 0
    for fatal in range(200):
        folder = tmp_path / f"killed-{fatal}"
        calls = 0

        def counted(call, fatal=fatal):
            def step(*arguments, **keywords):
                nonlocal calls
                calls += 1
                if calls > fatal:
                    raise Killed
                return call(*arguments, **keywords)

            return step

        writer = None
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", counted(os.fsync))
            patch.setattr("pathlib.Path.replace", counted(type(folder).replace))
            try:
                writer = SessionWriter.create(folder, plan, rig_toml="a = 1\n")
                record_rest(writer, frames)
            except Killed:
                steps += 1
            else:
                break
        if not (folder / "journal.jsonl").exists():
            with pytest.raises(SessionError):
                SessionWriter.resume(folder)
            continue
        try:
            resumed = SessionWriter.resume(folder)
        except SessionError as error:
            # Killed after the last line was written but before the call returned.
            assert "complete" in str(error)
        else:
            record_rest(resumed, frames)
        assert (folder / "manifest.sha256").read_bytes() == manifest
        assert Session.open(folder).digest == Session.open(session).digest
    assert steps > 12


def test_a_torn_last_line_is_tolerated_a_torn_middle_one_refused(tmp_path, plan, frames):
    writer = SessionWriter.create(tmp_path / "s", plan)
    writer.record("0000", frames["0000"], sequence=1)
    writer.record("0001", frames["0001"], sequence=2)
    journal = tmp_path / "s" / "journal.jsonl"
    whole = journal.read_bytes()
    journal.write_bytes(whole[:-20])
    resumed = SessionWriter.resume(tmp_path / "s")
    assert resumed.missing == ["0001", "0002"]
    lines = whole.split(b"\n")
    journal.write_bytes(b"\n".join([lines[0], lines[1][:-9], lines[2], b""]))
    with pytest.raises(SessionError, match="line 2"):
        SessionWriter.resume(tmp_path / "s")


def test_every_altered_byte_is_detected(session):
    random = np.random.default_rng(0)
    files = sorted(f for f in session.rglob("*") if f.is_file() and f.name != "journal.jsonl")
    for _ in range(150):
        file = files[random.integers(len(files))]
        content = bytearray(file.read_bytes())
        content[random.integers(len(content))] ^= int(random.integers(1, 256))
        kept = file.read_bytes()
        file.write_bytes(bytes(content))
        with pytest.raises(SessionError):
            opened = Session.open(session)
            for frame in opened.plan.frames:
                opened.read_frame(frame.id)
        file.write_bytes(kept)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda s: (s / "frames/0001.png").unlink(), r"0001\.png is missing"),
        (lambda s: (s / "frames/extra.png").write_bytes(b"x"), "does not belong"),
        (lambda s: (s / "manifest.sha256").unlink(), "did not finish"),
        (lambda s: (s / "plan.json").unlink(), "not a session"),
        (lambda s: (s / "plan.json").write_text("{}"), "plan.json"),
        (lambda s: (s / "rig.toml").write_text("a = 2\n"), "rig.toml: altered"),
    ],
)
def test_damage_is_named(session, damage, message):
    damage(session)
    with pytest.raises(SessionError, match=message):
        Session.open(session)


def test_a_truncated_frame_is_named(session):
    file = session / "frames" / "0002.png"
    file.write_bytes(file.read_bytes()[:60])
    with pytest.raises(SessionError, match=r"0002\.png"):
        Session.open(session).read_frame("0002")


def test_an_unfinished_session_says_so(tmp_path, plan, frames):
    with pytest.raises(RuntimeError), SessionWriter.create(tmp_path / "s", plan) as writer:
        writer.record("0000", frames["0000"], sequence=1)
        raise RuntimeError("camera fell over")
    with pytest.raises(SessionError, match=r"camera fell over.*1 of 3 frames"):
        Session.open(tmp_path / "s")


def test_frames_of_the_wrong_size_or_name_are_refused(tmp_path, plan, frames):
    writer = SessionWriter.create(tmp_path / "s", plan)
    with pytest.raises(SessionError, match="the plan says"):
        writer.record("0000", frames["0000"][:-1], sequence=1)
    with pytest.raises(SessionError, match="not in the plan"):
        writer.record("9999", frames["0000"], sequence=1)
    with pytest.raises(SessionError, match="still to be captured"):
        writer.finish()
