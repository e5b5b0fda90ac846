from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from synthetic_scan import expose, fringe_patterns, make_plan

from acquisition.errors import SessionError
from acquisition.journal import StopReason, read_journal
from acquisition.patterns import Axis
from acquisition.session import Session
from acquisition.session_writer import SessionWriter


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


def record_all(folder, plan, frames):
    with SessionWriter.create(folder, plan, rig_toml="a = 1\n") as writer:
        record_rest(writer, frames)


def resume_all(folder, frames):
    with SessionWriter.resume(folder) as writer:
        record_rest(writer, frames)


@pytest.fixture
def session(tmp_path, plan, frames):
    record_all(tmp_path / "session", plan, frames)
    return tmp_path / "session"


def test_frames_come_back_as_recorded(session, plan, frames):
    opened = Session.open(session)
    assert opened.plan == plan
    for frame_id, image in frames.items():
        np.testing.assert_array_equal(opened.read_frame(frame_id), image)


def killed_at(fatal, step):
    """Run ``step`` in a child process that dies at its ``fatal``-th flush or rename, for good."""
    child = os.fork()
    if child == 0:
        calls = 0

        def counted(call):
            def mortal(*arguments, **keywords):
                nonlocal calls
                if calls == fatal:
                    os._exit(9)
                calls += 1
                return call(*arguments, **keywords)

            return mortal

        os.fsync = counted(os.fsync)
        Path.replace = counted(Path.replace)
        Path.rename = counted(Path.rename)
        try:
            step()
        finally:
            os._exit(0)  # whatever happens, this copy of the tests goes no further
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


def test_killed_at_any_flush_or_rename_it_resumes_to_the_same_manifest(
    session, tmp_path, plan, frames
):
    manifest = (session / "manifest.sha256").read_bytes()
    for fatal in range(100):
        folder = tmp_path / f"killed-{fatal}"
        if not killed_at(fatal, lambda f=folder: record_all(f, plan, frames)):
            break
        if not folder.exists():
            with pytest.raises(SessionError, match="not a session"):
                SessionWriter.resume(folder)
            record_all(folder, plan, frames)
        else:
            # Killed again a little later, and resumed in earnest then.
            killed_at(3, lambda f=folder: resume_all(f, frames))
            try:
                resume_all(folder, frames)
            except SessionError as error:
                # Killed after the last line was written but before it was flushed.
                assert "complete" in str(error)
        assert (folder / "manifest.sha256").read_bytes() == manifest
        assert Session.open(folder).digest == Session.open(session).digest
    # Three files of the beginning, three frames and the manifest at three steps each, and a line
    # of the journal after each frame, at the beginning and at the end.
    assert fatal >= 22


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
        (lambda s: (s / "manifest.sha256").unlink(), "damaged, take it from a backup"),
        (lambda s: (s / "manifest.sha256").write_text("x\n"), "line 1: not a digest"),
        (lambda s: (s / "manifest.sha256").write_bytes(b"\xff\xfe"), "not a text file"),
        (lambda s: (s / "journal.jsonl").unlink(), r"journal\.jsonl is missing"),
        (lambda s: (s / "plan.json").unlink(), "not a session"),
        (lambda s: (s / "plan.json").write_text("{}"), "plan.json"),
        (lambda s: (s / "rig.toml").write_text("a = 2\n"), "rig.toml: altered"),
    ],
)
def test_damage_is_named(session, damage, message):
    damage(session)
    with pytest.raises(SessionError, match=message):
        Session.open(session)


def test_a_whole_last_line_without_its_newline_did_not_happen(tmp_path, plan, frames):
    writer = SessionWriter.create(tmp_path / "s", plan)
    writer.record("0000", frames["0000"], sequence=1)
    journal = tmp_path / "s" / "journal.jsonl"
    journal.write_bytes(journal.read_bytes()[:-1])
    resume_all(tmp_path / "s", frames)
    np.testing.assert_array_equal(Session.open(tmp_path / "s").read_frame("0000"), frames["0000"])


def test_a_frame_lost_while_the_recording_lay_still_is_taken_again(tmp_path, plan, frames):
    writer = SessionWriter.create(tmp_path / "s", plan)
    writer.record("0000", frames["0000"], sequence=1)
    (tmp_path / "s" / "frames" / "0000.png").unlink()
    (tmp_path / "s" / "frames").rmdir()
    assert SessionWriter.resume(tmp_path / "s").missing == ["0000", "0001", "0002"]


def test_a_complete_session_is_neither_resumed_nor_overwritten(session, plan):
    with pytest.raises(SessionError, match="complete"):
        SessionWriter.resume(session)
    with pytest.raises(SessionError, match="exists already"):
        SessionWriter.create(session, plan)


def test_the_reason_of_the_end_is_in_the_journal(tmp_path, plan, frames):
    with pytest.raises(KeyboardInterrupt), SessionWriter.create(tmp_path / "s", plan) as writer:
        writer.record("0000", frames["0000"], sequence=1)
        raise KeyboardInterrupt
    assert read_journal(tmp_path / "s" / "journal.jsonl")[-1].reason is StopReason.ABORTED
    resume_all(tmp_path / "s", frames)
    reasons = [
        e.reason for e in read_journal(tmp_path / "s" / "journal.jsonl") if e.event == "stop"
    ]
    assert reasons == [StopReason.ABORTED, StopReason.SUCCESS]


def test_exposures_are_those_applied_or_else_those_asked_for(tmp_path, plan, frames):
    asked = plan.model_copy(
        update={"frames": tuple(f.model_copy(update={"exposure_s": 0.02}) for f in plan.frames)}
    )
    with SessionWriter.create(tmp_path / "s", asked) as writer:
        writer.record("0001", frames["0001"], sequence=1, exposure_applied_s=0.0203)
        record_rest(writer, frames)
    opened = Session.open(tmp_path / "s")
    assert (opened.exposure_s("0000"), opened.exposure_s("0001")) == (0.02, 0.0203)
    with pytest.raises(SessionError, match="0007 was not recorded"):
        opened.exposure_s("0007")


def test_the_calibration_in_force_goes_with_the_session(tmp_path, plan, frames):
    (tmp_path / "rig").mkdir()
    (tmp_path / "rig" / "camera.cameramodel").write_text("f = 1")
    with SessionWriter.create(tmp_path / "s", plan, calibration=tmp_path / "rig") as writer:
        record_rest(writer, frames)
    stored = Session.open(tmp_path / "s").calibration_folder / "camera.cameramodel"
    assert stored.read_text() == "f = 1"
    stored.write_text("f = 2")
    with pytest.raises(SessionError, match=r"camera\.cameramodel: altered"):
        Session.open(tmp_path / "s")


def test_a_truncated_frame_is_named(session):
    file = session / "frames" / "0002.png"
    file.write_bytes(file.read_bytes()[:60])
    with pytest.raises(SessionError, match=r"0002\.png: truncated"):
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
