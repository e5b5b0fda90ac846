"""A metered scan is recorded, cut off, resumed and replayed like any other."""

from __future__ import annotations

import shutil

import pytest

from acquisition.decoding import decode
from acquisition.errors import SessionError
from acquisition.journal import FrameRecorded, SkipReason, read_journal
from acquisition.patterns import Axis, PhaseShift, Uniform
from acquisition.plan import Metering, Purpose
from acquisition.recorded_frames import open_for_replay, recording_of
from acquisition.recording import record_plan
from acquisition.scan import plan_response_scan, plan_scan, scan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from devices.replay import replay_rig
from devices.rig import Rig
from devices.simulated.settings import PaintingKind, SimulationSettings


@pytest.fixture(scope="module")
def devices():
    rig = SimulationSettings(
        painting=PaintingKind.SMALL_OIL, camera_width=64, projector_width=228, projector_height=142
    ).build()
    return Rig(rig.camera, rig.projector, prove_light=False, source="simulation")


@pytest.fixture(scope="module")
def session(devices, tmp_path_factory):
    folder = tmp_path_factory.mktemp("metered") / "s"
    plan = plan_scan(
        devices,
        exposure_s=(1 / 60, 3 / 60),
        axes=(Axis.ROW,),
        metering=Metering(row_sigma_px=0.2),
    )
    with SessionWriter.create(folder, plan) as writer:
        scan(writer, devices)
    return Session.open(folder)


def test_what_is_left_out_stands_in_the_journal_with_its_reason(session):
    assert session.skipped
    assert {e.id for e in session.skipped.values()} <= session.plan.optional_frames
    assert session.recorded.keys() | session.skipped.keys() == {f.id for f in session.plan.frames}
    for entry in session.skipped.values():
        assert entry.reason in set(SkipReason)
        assert entry.pixels <= session.plan.metering.least_share * 64 * 48
    needed = [e.needed_by for e in session.recorded.values() if e.needed_by is not None]
    assert needed
    assert max(needed) > 64


def test_flats_and_the_metered_steps_come_first(session):
    by_id = {f.id: f for f in session.plan.frames}
    events = read_journal(session.path / "journal.jsonl")
    taken = [by_id[e.id].pattern for e in events if isinstance(e, FrameRecorded)]
    assert all(isinstance(pattern, Uniform) for pattern in taken[:4])
    assert all(isinstance(pattern, PhaseShift) for pattern in taken[4:8])
    turns = sorted(pattern.shift_rad / 6.283185307179586 for pattern in taken[4:8])
    assert turns == pytest.approx([0, 0.25, 0.5, 0.75])


def test_it_is_decoded_from_what_was_recorded(session):
    found = decode(session.plan_of(Purpose.CODE), session.read_frame)
    assert found.valid.mean() > 0.8


def test_cut_off_at_any_step_of_the_journal_it_ends_the_same(session, tmp_path, monkeypatch):
    # Nothing fails here; flushing a thousand small files would only take its time.
    monkeypatch.setattr("os.fsync", lambda descriptor: None)
    lines = (session.path / "journal.jsonl").read_bytes().splitlines(keepends=True)
    recording = recording_of(session)
    for kept in range(1, len(lines)):
        folder = tmp_path / "cut"
        shutil.copytree(session.path, folder)
        (folder / "manifest.sha256").unlink()
        torn = lines[kept][: len(lines[kept]) // 2] if kept % 2 else b""
        (folder / "journal.jsonl").write_bytes(b"".join(lines[:kept]) + torn)
        with replay_rig(recording) as rig, SessionWriter.resume(folder) as writer:
            record_plan(writer, rig)
        again = Session.open(folder)
        assert again.digest == session.digest
        for one, other in ((again.recorded, session.recorded), (again.skipped, session.skipped)):
            assert one.keys() == other.keys()
        for name, entry in again.recorded.items():
            assert entry.needed_by == session.recorded[name].needed_by
        for name, entry in again.skipped.items():
            told = session.skipped[name]
            assert (entry.reason, entry.pixels) == (told.reason, told.pixels)
        shutil.rmtree(folder)


def test_it_is_replayed_to_the_same_session(session, tmp_path):
    with (
        replay_rig(recording_of(open_for_replay(session.path))) as rig,
        SessionWriter.create(tmp_path / "again", session.plan) as writer,
    ):
        record_plan(writer, rig)
    assert Session.open(tmp_path / "again").digest == session.digest


def test_without_metering_the_full_set_is_taken(session, devices, tmp_path):
    plan = session.plan.model_copy(update={"metering": None})
    with SessionWriter.create(tmp_path / "s", plan) as writer:
        scan(writer, devices)
    assert not Session.open(tmp_path / "s").skipped
    writer = SessionWriter.create(tmp_path / "t", plan)
    with pytest.raises(SessionError, match="none that the plan allows"):
        writer.skip(plan.frames[-1].id, reason=SkipReason.PRECISE, pixels=0, saturating=0)


def test_greys_are_recorded_like_a_scan(devices, tmp_path):
    plan = plan_response_scan(devices, greys=5, exposure_s=(1 / 60,))
    with SessionWriter.create(tmp_path / "s", plan) as writer:
        scan(writer, devices)
    levels = sorted(frame.pattern.level for frame in Session.open(tmp_path / "s").frames)
    assert levels == pytest.approx([0, 0.25, 0.5, 0.75, 1])
