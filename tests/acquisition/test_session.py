from __future__ import annotations

import numpy as np
import pytest
from synthetic_scan import expose, fringe_patterns, make_plan

from acquisition.errors import SessionError
from acquisition.journal import SkipReason, StopReason, read_journal
from acquisition.patterns import Axis
from acquisition.plan import Bracketing
from acquisition.recorded_frames import open_for_replay
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


def test_a_torn_last_line_is_tolerated_a_torn_middle_one_refused(tmp_path, plan, frames):
    writer = SessionWriter.create(tmp_path / "s", plan)
    writer.record("0000", frames["0000"], sequence=1)
    writer.record("0001", frames["0001"], sequence=2)
    journal = tmp_path / "s" / "journal.jsonl"
    whole = journal.read_bytes()
    journal.write_bytes(whole[:-20])
    del writer
    assert SessionWriter.resume(tmp_path / "s").missing == ["0001", "0002"]
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
    del writer
    journal = tmp_path / "s" / "journal.jsonl"
    journal.write_bytes(journal.read_bytes()[:-1])
    resume_all(tmp_path / "s", frames)
    np.testing.assert_array_equal(Session.open(tmp_path / "s").read_frame("0000"), frames["0000"])


def test_a_frame_lost_while_the_recording_lay_still_is_taken_again(tmp_path, plan, frames):
    writer = SessionWriter.create(tmp_path / "s", plan)
    writer.record("0000", frames["0000"], sequence=1)
    del writer
    (tmp_path / "s" / "frames" / "0000.png").unlink()
    (tmp_path / "s" / "frames").rmdir()
    assert SessionWriter.resume(tmp_path / "s").missing == ["0000", "0001", "0002"]


def test_a_session_is_recorded_by_one_process_at_a_time(tmp_path, plan, frames):
    with SessionWriter.create(tmp_path / "s", plan) as writer:
        writer.record("0000", frames["0000"], sequence=1)
        before = sorted((f, f.stat().st_size) for f in (tmp_path / "s").rglob("*"))
        with pytest.raises(SessionError, match="is being recorded by another process"):
            SessionWriter.resume(tmp_path / "s")
        assert sorted((f, f.stat().st_size) for f in (tmp_path / "s").rglob("*")) == before
        record_rest(writer, frames)
    Session.open(tmp_path / "s")


@pytest.mark.parametrize("name", ["plan.json", "rig.toml", "calibration/c.cameramodel"])
def test_what_a_recording_began_with_is_checked_before_it_goes_on(tmp_path, plan, frames, name):
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "c.cameramodel").write_text("f = 1.5")
    options = {"rig_toml": "a = 1.5\n", "calibration": tmp_path / "c"}
    with SessionWriter.create(tmp_path / "s", plan, **options) as writer:
        writer.record("0000", frames["0000"], sequence=1)
    file = tmp_path / "s" / name
    content = file.read_bytes()
    # Files that mean something else, and are files of their kind yet.
    changed = content.replace(b'": 6', b'": 7', 1) if name == "plan.json" else content[:-2] + b"4\n"
    assert changed != content
    journal = (tmp_path / "s" / "journal.jsonl").read_bytes()
    for damage in (changed, None):
        file.unlink() if damage is None else file.write_bytes(damage)
        for opened in (SessionWriter.resume, open_for_replay):
            with pytest.raises(SessionError, match=f"{file.name}.*(altered since|missing)"):
                opened(tmp_path / "s")
    assert (tmp_path / "s" / "journal.jsonl").read_bytes() == journal
    file.write_bytes(content)
    resume_all(tmp_path / "s", frames)
    Session.open(tmp_path / "s")


def test_what_the_journal_says_last_of_a_frame_holds(tmp_path, plan, frames):
    """Skipped the second time, where the frames that told of it were lost and taken anew."""
    optional = plan.model_copy(
        update={
            "bracketing": Bracketing(),
            "frames": tuple(
                frame.model_copy(
                    update={
                        "exposure_s": 0.1 * (1 + n),
                        "bracket": "b",
                        "pattern": plan.frames[0].pattern,
                    }
                )
                for n, frame in enumerate(plan.frames)
            ),
        }
    )
    with SessionWriter.create(tmp_path / "s", optional) as writer:
        for frame_id in ("0000", "0001"):
            writer.record(frame_id, frames[frame_id], sequence=1)
    (tmp_path / "s" / "frames" / "0001.png").unlink()
    with SessionWriter.resume(tmp_path / "s") as writer:
        writer.skip("0001", reason=SkipReason.SERVED, pixels=0, saturating=0)
    with SessionWriter.resume(tmp_path / "s") as writer:
        assert writer.missing == ["0002"]
        assert list(open_for_replay(tmp_path / "s").recorded) == ["0000"]
        record_rest(writer, frames)
    opened = Session.open(tmp_path / "s")
    assert set(opened.recorded) == {"0000", "0002"}
    assert set(opened.skipped) == {"0001"}


@pytest.mark.parametrize("end", [b"\r", b"\x0b", b"\x0c", b"\x1c", b"\x1e"])
def test_other_ends_of_lines_in_the_manifest_are_told(session, end):
    file = session / "manifest.sha256"
    content = file.read_bytes()
    last = len(content) - 1
    for place in (content.index(b"\n"), last):
        file.write_bytes(content[:place] + end + content[place + 1 :])
        with pytest.raises(SessionError, match=r"manifest\.sha256"):
            Session.open(session)


def test_of_two_recordings_that_begin_at_once_the_second_is_refused(
    tmp_path, plan, frames, monkeypatch
):
    out = tmp_path / "s"
    out.mkdir()  # an empty folder is no hindrance
    (tmp_path / "c").mkdir()

    def begin_another(source, destination):
        monkeypatch.undo()
        record_all(out, plan, frames)

    monkeypatch.setattr("acquisition.session_writer._copy_files", begin_another)
    with pytest.raises(SessionError, match="exists already"):
        SessionWriter.create(out, plan, calibration=tmp_path / "c")
    np.testing.assert_array_equal(Session.open(out).read_frame("0000"), frames["0000"])
    assert {f.name for f in tmp_path.iterdir()} == {"s", "c"}


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
