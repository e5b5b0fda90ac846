from __future__ import annotations

import shutil
from collections import namedtuple

import numpy as np
import pytest
from tiny_rig import TinyCamera, TinyScene, tiny_rig

from acquisition.disk_space import bytes_needed, frame_bytes
from acquisition.errors import SessionError
from acquisition.journal import FrameSkipped, read_journal
from acquisition.patterns import WHITE
from acquisition.photograph_plan import PhotographChoices, plan_photographs
from acquisition.plan import Plan, PlannedFrame, Purpose
from acquisition.recorded_frames import open_for_replay, recording_of
from acquisition.recording import record_plan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from devices.errors import DeviceError
from devices.interfaces import ArmPose
from devices.replay import replay_rig
from devices.rig import Rig

CHOICES = {
    "exposures_s": (0.05, 0.1, 0.2, 0.4),
    "code_exposures_s": (0.1,),
    "poses": 3,
    "steps": 3,
    "period_px": 32.0,
    "reference_every": 2,
}


def plan_for(**changed):
    return plan_photographs(tiny_rig(), PhotographChoices(**(CHOICES | changed)))


def record(folder, plan, *, scene=None, rig=None, **options):
    with SessionWriter.create(folder, plan) as writer:
        record_plan(writer, rig or tiny_rig(scene), **options)
    return Session.open(folder)


def test_every_frame_says_what_it_is_a_picture_of(tmp_path):
    session = record(tmp_path / "s", plan_for())
    for frame in session.frames:
        subject = session.recorded[frame.id].subject
        assert subject.lamp_on == frame.lamp_on
        assert subject.camera_position == frame.camera_position
        assert (subject.projection is None) == (frame.pattern is None)
        if frame.arm_pose is not None:
            assert subject.arm_pose == frame.arm_pose
        if frame.purpose is Purpose.DARK:
            assert (session.read_frame(frame.id) == 32).all()


def test_everything_moves_in_the_dark_once_and_is_still_in_the_end(tmp_path):
    scene = TinyScene()
    plan = plan_for()
    record(tmp_path / "s", plan, scene=scene)
    # The devices of the scene assert that it is dark whenever something moves.
    assert scene.dark
    assert scene.log[-2:] == ["stop", "blank"]
    assert scene.log.count("home") == 1
    assert [entry for entry in scene.log if entry.startswith("place")] == [
        "place front",
        "place left",
    ]
    moves = [entry for entry in scene.log if entry.startswith("move")]
    # Neighbouring brackets of one pose need no move: the reference and the first pose after it,
    # from either place. The others are two more poses, the reference between them and at the end.
    assert len(moves) == 1 + 2 * 4


def test_exposures_that_no_pixel_needs_are_left_out_and_the_journal_says_why(tmp_path):
    plan = plan_for()
    session = record(tmp_path / "s", plan)
    skipped = [e for e in read_journal(tmp_path / "s" / "journal.jsonl") if e.event == "skipped"]
    assert skipped
    assert {e.id for e in skipped} | set(session.recorded) == {f.id for f in plan.frames}
    assert all(isinstance(e, FrameSkipped) and e.pixels == 0 for e in skipped)
    brackets = {f.bracket for f in plan.frames if f.bracket}
    for name in brackets:
        frames = [frame for frame in plan.frames if frame.bracket == name]
        assert frames[0].id in session.recorded
        # Half of the pixels at 5000 per second are served at once, the others want the longest.
        taken = [f.exposure_s for f in frames if f.id in session.recorded]
        assert taken == [0.05, 0.4]
        needed = [session.recorded[f.id].needed_by for f in frames[1:] if f.id in session.recorded]
        assert needed[0] > 100


def test_all_exposures_are_taken_where_that_is_asked_for(tmp_path):
    plan = plan_for(adaptive=False)
    session = record(tmp_path / "s", plan)
    assert len(session.recorded) == len(plan.frames)


def test_a_session_is_decoded_from_what_was_recorded_at_one_place(tmp_path):
    session = record(tmp_path / "s", plan_for())
    part = session.plan_of(Purpose.CODE, camera_position="left")
    assert {frame.camera_position for frame in part.frames} == {"left"}
    photographs = session.plan_of(Purpose.PHOTOGRAPH)
    assert all(frame.id in session.recorded for frame in photographs.frames)
    with pytest.raises(SessionError, match="no frame for flat target"):
        session.plan_of(Purpose.FLAT_TARGET)
    with pytest.raises(SessionError, match="with the camera at 'roof'"):
        session.plan_of(Purpose.CODE, camera_position="roof")


def test_targets_are_asked_for_in_the_dark_and_taken_away(tmp_path):
    scene = TinyScene()
    asked = []

    def confirm(request):
        assert scene.dark
        asked.append(request)
        return True

    plan = plan_for(flat_target=True, colour_chart=True)
    record(tmp_path / "s", plan, scene=scene, confirm=confirm)
    assert [request.split()[0] for request in asked] == ["Put", "Take", "Put", "Take"]
    assert "colour chart" in asked[0]
    assert "flat white target" in asked[2]


def test_without_somebody_at_the_desk_targets_wait_for_a_resume(tmp_path):
    plan = plan_for(flat_target=True)
    with (
        pytest.raises(DeviceError, match="nobody confirmed that the flat white target is before"),
        SessionWriter.create(tmp_path / "s", plan) as writer,
    ):
        record_plan(writer, tiny_rig())
    with SessionWriter.resume(tmp_path / "s") as writer:
        record_plan(writer, tiny_rig(), confirm=lambda request: True)
    uninterrupted = record(tmp_path / "u", plan, confirm=lambda request: True)
    assert Session.open(tmp_path / "s").digest == uninterrupted.digest


def test_the_lamp_warms_up_once_in_each_run(tmp_path):
    scene = TinyScene()
    waits = []

    def wait(seconds):
        assert scene.lamp_on
        waits.append(seconds)

    plan = plan_for(warm_up_s=90.0)
    record(tmp_path / "s", plan, scene=scene, wait=wait)
    assert waits == [90.0]


@pytest.mark.parametrize("frames", [1, 20, 30, 45])
def test_a_failure_leaves_everything_dark_and_can_be_resumed(tmp_path, frames):
    class Failing(TinyCamera):
        def capture(self, exposure_s, *, deadline=None):
            if self.scene.sequence == frames:
                raise KeyboardInterrupt
            return super().capture(exposure_s, deadline=deadline)

    scene = TinyScene()
    plan = plan_for()
    with (
        pytest.raises(KeyboardInterrupt),
        SessionWriter.create(tmp_path / "s", plan) as writer,
    ):
        record_plan(writer, tiny_rig(scene, camera=Failing(scene)))
    assert scene.dark
    assert "stop" in scene.log[-2:]
    with SessionWriter.resume(tmp_path / "s") as writer:
        record_plan(writer, tiny_rig())
    assert Session.open(tmp_path / "s").digest == record(tmp_path / "u", plan).digest


def test_photographs_are_replayed(tmp_path):
    plan = plan_for(flat_target=True)
    session = record(tmp_path / "s", plan, confirm=lambda request: True)
    rig = replay_rig(recording_of(open_for_replay(tmp_path / "s")))
    again = record(tmp_path / "r", plan, rig=rig, confirm=lambda request: True)
    assert again.digest == session.digest
    assert set(again.skipped) == set(session.skipped)


def test_devices_that_the_plan_was_not_made_for_are_refused(tmp_path):
    scene = TinyScene()
    rig = tiny_rig(scene)
    with pytest.raises(DeviceError, match="'front', which this rig has no place for"):
        record(tmp_path / "a", plan_for(), rig=Rig(rig.camera, rig.projector, rig.arm))
    with pytest.raises(DeviceError, match="no light arm"):
        record(tmp_path / "b", plan_for(), rig=Rig(rig.camera, rig.projector, mount=rig.mount))
    with pytest.raises(DeviceError, match="no projector"):
        record(tmp_path / "c", plan_for(), rig=Rig(rig.camera, None, rig.arm, rig.mount))
    frame = plan_for().frames[-1].model_copy(update={"arm_pose": ArmPose(9.0, 0.5)})
    beyond = plan_for().model_copy(update={"frames": (frame,)})
    with pytest.raises(DeviceError, match="outside the arm's limits"):
        record(tmp_path / "d", beyond, rig=rig)
    assert "home" not in scene.log


def test_frames_without_an_exposure_are_not_taken(tmp_path):
    plan = plan_for().model_copy(update={"frames": (PlannedFrame(id="a", pattern=WHITE),)})
    with pytest.raises(DeviceError, match="names no exposure"):
        record(tmp_path / "s", plan)


Usage = namedtuple("Usage", "total used free")


def test_a_disk_too_small_for_the_plan_is_refused_before_anything_moves(tmp_path, monkeypatch):
    scene = TinyScene()
    monkeypatch.setattr(shutil, "disk_usage", lambda place: Usage(10**9, 10**9, 10**7))
    with pytest.raises(SessionError, match=r"stay free for the rest.*free some space"):
        record(tmp_path / "s", plan_for(), scene=scene)
    assert scene.sequence == 0
    assert scene.log == []


def test_a_disk_that_fills_up_stops_the_recording_which_goes_on_later(tmp_path, monkeypatch):
    free = [10**9] * 8
    usage = lambda place: Usage(10**9, 0, free.pop() if free else 10**7)  # noqa: E731
    plan = plan_for()
    with monkeypatch.context() as patched:
        patched.setattr(shutil, "disk_usage", usage)
        with pytest.raises(SessionError, match="frame 0007 may take"):
            record(tmp_path / "s", plan)
    with SessionWriter.resume(tmp_path / "s") as writer:
        assert writer.missing[0] == "0007"
        record_plan(writer, tiny_rig())
    assert Session.open(tmp_path / "s").digest == record(tmp_path / "u", plan).digest


@pytest.mark.parametrize("saturation", [255, 65535])
def test_no_frame_takes_more_room_than_is_reckoned_with(saturation):
    from acquisition.frame_files import encode_frame

    random = np.random.default_rng(1)
    kind = np.uint8 if saturation == 255 else np.uint16
    for width, height in ((1, 1), (37, 5), (640, 480), (1500, 2)):
        plan = Plan.model_validate(
            plan_for().model_dump()
            | {
                "camera": {"width": width, "height": height},
                "crop": {"column": 0, "row": 0, "width": width, "height": height},
                "saturation_level": saturation,
            }
        )
        noise = random.integers(0, saturation + 1, (height, width)).astype(kind)
        assert len(encode_frame(noise, name="noise")) <= frame_bytes(plan)
        assert bytes_needed(plan) == len(plan.frames) * frame_bytes(plan)
