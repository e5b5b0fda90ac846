"""A session survives kills, full and broken disks, and tells every altered byte."""

from __future__ import annotations

import errno
import shutil
from functools import partial

import numpy as np
import pytest
from system_calls import CALLS, failing_at, killed_at, watched
from tiny_rig import tiny_rig

from acquisition.errors import SessionError
from acquisition.photograph_plan import PhotographChoices, plan_photographs
from acquisition.plan import Plan, Purpose
from acquisition.recording import record_plan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter


def small_plan() -> Plan:
    """Code, dark frames, and brackets of which some frames are needed and some are not."""
    choices = PhotographChoices(
        exposures_s=(0.05, 0.1, 0.4),
        code_exposures_s=(0.1,),
        poses=1,
        steps=3,
        period_px=32.0,
        reference_every=9,
    )
    plan = plan_photographs(tiny_rig(), choices)
    by_purpose = {
        purpose: [f for f in plan.frames if f.purpose is purpose and f.camera_position == "front"]
        for purpose in Purpose
    }
    frames = (
        *by_purpose[Purpose.CODE][:2],
        *by_purpose[Purpose.DARK][:1],
        *by_purpose[Purpose.PHOTOGRAPH],
    )
    return plan.model_copy(update={"frames": frames})


@pytest.fixture(scope="module")
def plan():
    return small_plan()


def record(folder, plan):
    with SessionWriter.create(folder, plan, rig_toml="a = 1\n") as writer:
        record_plan(writer, tiny_rig())


def resume(folder):
    with SessionWriter.resume(folder) as writer:
        record_plan(writer, tiny_rig())


@pytest.fixture(scope="module")
def session(plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "s"
    record(folder, plan)
    opened = Session.open(folder)
    assert opened.skipped  # or the tests below would not see to skipping
    return folder


def finish(folder, plan):
    """Begin or resume, whichever is called for, as somebody at the desk would."""
    if not folder.exists():
        record(folder, plan)
        return
    try:
        resume(folder)
    except SessionError as error:
        # Cut off after the last line was written.
        assert "complete" in str(error)


def assert_same(folder, session):
    assert (folder / "manifest.sha256").read_bytes() == (session / "manifest.sha256").read_bytes()
    one, other = Session.open(folder), Session.open(session)
    assert one.digest == other.digest
    assert set(one.skipped) == set(other.skipped)
    assert {e.file: e.sha256 for e in one.recorded.values()} == {
        e.file: e.sha256 for e in other.recorded.values()
    }
    for name in ("needed_by", "subject"):
        assert [getattr(one.recorded[i], name) for i in one.recorded] == [
            getattr(other.recorded[i], name) for i in one.recorded
        ]
    assert not list(folder.rglob("*in-progress*"))


def calls_of_a_recording(folder, plan):
    """Names of the system calls that a whole recording makes, in order."""
    names = []
    with watched(lambda number, name, arguments: names.append(name), CALLS):
        record(folder, plan)
    shutil.rmtree(folder)
    return names


def test_killed_at_any_system_call_it_resumes_to_the_same_manifest(session, tmp_path, plan):
    names = calls_of_a_recording(tmp_path / "counted", plan)
    assert {"open", "write", "fsync", "replace", "rename", "chmod"} <= set(names)
    for fatal, name in enumerate(names):
        folder = tmp_path / "killed"
        assert killed_at(fatal, partial(record, folder, plan), torn=name == "write")
        # And once more, somewhere on its way back.
        killed_at(fatal % 23, partial(finish, folder, plan), torn=fatal % 2 == 0)
        finish(folder, plan)
        assert_same(folder, session)
        shutil.rmtree(folder)
        for left in tmp_path.glob(".*"):
            shutil.rmtree(left)
    assert not killed_at(len(names), partial(record, tmp_path / "last", plan))
    assert_same(tmp_path / "last", session)


@pytest.mark.parametrize(("number", "for_ever"), [(errno.ENOSPC, True), (errno.EIO, False)])
def test_a_disk_that_fails_at_any_write_leaves_what_was_recorded(
    session, tmp_path, plan, number, for_ever
):
    for fatal in range(10_000):
        folder = tmp_path / "failed"
        with failing_at(fatal, number, for_ever=for_ever) as failed:
            try:
                record(folder, plan)
            except SessionError as error:
                said = str(error)
                assert failed()
                assert {errno.ENOSPC: "No space left", errno.EIO: "Input/output"}[number] in said
                assert ("free some space" in said) == (number == errno.ENOSPC)
                assert str(folder) in said
            else:
                if not failed():
                    break
                # Making the folder above, which was there already.
                assert fatal == 0
        if folder.exists():
            so_far = SessionWriter.resume(folder).so_far if is_unfinished(folder) else None
            for frame_id in () if so_far is None else so_far.recorded:
                so_far.read_frame(frame_id)
        finish(folder, plan)
        assert_same(folder, session)
        shutil.rmtree(folder)
        for left in tmp_path.glob(".*"):
            shutil.rmtree(left)
    assert fatal > 80


def is_unfinished(folder):
    try:
        Session.open(folder)
    except SessionError:
        return True
    return False


def test_all_of_2000_altered_bytes_are_told(session, tmp_path):
    """Of any file, by any change; each is undone before the next."""
    folder = tmp_path / "altered"
    shutil.copytree(session, folder)
    files = sorted(f for f in folder.rglob("*") if f.is_file())
    assert {"journal.jsonl", "manifest.sha256", "plan.json", "rig.toml"} < {f.name for f in files}
    sizes = np.array([file.stat().st_size for file in files])
    random = np.random.default_rng(20)
    missed = []
    for trial in range(2000):
        # Half of them anywhere, half in each file as often as in any other.
        weights = sizes / sizes.sum() if trial % 2 else None
        file = files[random.choice(len(files), p=weights)]
        kept = file.read_bytes()
        content = bytearray(kept)
        place = int(random.integers(len(content)))
        content[place] ^= int(random.integers(1, 256))
        file.write_bytes(content)
        try:
            opened = Session.open(folder)
            for frame in opened.frames:
                opened.read_frame(frame.id)
        except SessionError:
            pass
        else:
            missed.append((file.name, place, kept[place], content[place]))
        file.write_bytes(kept)
    assert missed == []
    Session.open(folder)


def journal_lines(folder):
    return (folder / "journal.jsonl").read_bytes().splitlines(keepends=True)


@pytest.mark.parametrize("line", [1, 4, 6])
def test_lines_of_the_journal_that_are_missing_doubled_or_displaced_are_told(
    session, tmp_path, line
):
    lines = journal_lines(session)
    for changed in (
        [*lines[:line], *lines[line + 1 :]],
        [*lines[:line], lines[line], *lines[line:]],
        [*lines[:line], lines[line + 1], lines[line], *lines[line + 2 :]],
        [*lines[:line], lines[line][:-12] + b"\n", *lines[line + 1 :]],
    ):
        folder = tmp_path / "s"
        shutil.copytree(session, folder)
        (folder / "journal.jsonl").write_bytes(b"".join(changed))
        with pytest.raises(SessionError, match=r"journal\.jsonl, line \d+: torn or altered"):
            Session.open(folder)
        shutil.rmtree(folder)


def test_a_journal_torn_anywhere_in_its_last_line_is_resumed(session, tmp_path, plan):
    lines = journal_lines(session)
    for kept in range(len(lines[-1])):
        folder = tmp_path / "s"
        shutil.copytree(session, folder)
        (folder / "journal.jsonl").write_bytes(b"".join(lines[:-1]) + lines[-1][:kept])
        with pytest.raises(SessionError, match="cut off"):
            Session.open(folder)
        resume(folder)
        assert_same(folder, session)
        shutil.rmtree(folder)


def test_sessions_from_before_lines_were_sealed_are_read_and_resumed(session, tmp_path, plan):
    import re

    lines = [re.sub(rb',"seal":"[0-9a-f]{8}"', b"", line) for line in journal_lines(session)]
    folder = tmp_path / "s"
    shutil.copytree(session, folder)
    (folder / "journal.jsonl").write_bytes(b"".join(lines))
    assert Session.open(folder).digest == Session.open(session).digest
    (folder / "journal.jsonl").write_bytes(b"".join(lines[:-3]))
    resume(folder)
    assert_same(folder, session)
    sealed = journal_lines(folder)
    # From the first sealed line on, none is without a seal.
    (folder / "journal.jsonl").write_bytes(b"".join([*sealed, lines[-1]]))
    with pytest.raises(SessionError, match="it has no seal"):
        Session.open(folder)


def test_a_frame_is_only_missing_where_the_plan_allows_it(session, tmp_path, plan):
    opened = Session.open(session)
    strict = plan.model_copy(update={"bracketing": None})
    writer = SessionWriter.create(tmp_path / "s", strict)
    skipped = next(iter(opened.skipped.values()))
    told = {"reason": skipped.reason, "pixels": 0, "saturating": 0}
    with pytest.raises(SessionError, match="none that the plan allows"):
        writer.skip(skipped.id, **told)
    writer = SessionWriter.create(tmp_path / "t", plan)
    with pytest.raises(SessionError, match="none that the plan allows"):
        writer.skip(plan.frames[0].id, **told)
    writer.skip(skipped.id, **told)
    with pytest.raises(SessionError, match="skipped already"):
        writer.skip(skipped.id, **told)
    with pytest.raises(SessionError, match="skipped already"):
        writer.record(skipped.id, np.zeros((16, 20), np.uint16), sequence=1)
