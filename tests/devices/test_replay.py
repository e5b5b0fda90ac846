from __future__ import annotations

import math

import numpy as np
import pytest

from devices.errors import DeviceError, FrameOrderError, NotRecordedError
from devices.interfaces import (
    ArmCapabilities,
    ArmLimits,
    ArmPose,
    CameraCapabilities,
    Projection,
    ProjectorCapabilities,
)
from devices.recording import RecordedFrame, Recording
from devices.replay import replay_rig

POSES = (ArmPose(0.0, math.radians(40)), ArmPose(math.radians(30), math.radians(40)))
PATTERNS = [Projection(f"{n:04d} pattern", np.full((8, 10), 30 * n, np.uint8)) for n in range(3)]


def recorded(number, **options):
    return RecordedFrame(
        id=f"{number:04d}",
        exposure_asked_s=0.1,
        exposure_applied_s=0.099,
        wall_time=1000.0 + number,
        **options,
    )


def picture(frame):
    """Noise of the frame's own."""
    return np.random.default_rng(int(frame.id)).integers(20, 200, (24, 32)).astype(np.uint8)


@pytest.fixture
def recording():
    first, second = PATTERNS[:2]
    shown = {"projection": first.digest, "projection_name": first.name}
    lit = {"lamp_on": True}
    frames = (
        recorded(0, **shown, camera_position="front"),
        recorded(1, projection=second.digest, projection_name=second.name),
        recorded(2, **shown, camera_position="front"),
        recorded(3, **lit, arm_pose=POSES[0], camera_position="front"),
        recorded(4, **lit, arm_pose=POSES[1], camera_position="front"),
        recorded(5, **lit, arm_pose=POSES[1], camera_position="left"),
        recorded(6, arm_pose=POSES[1], camera_position="left"),
    )
    limits = ArmLimits((-0.1, 1.0), (0.5, 1.0))
    return Recording(
        frames=frames,
        load=picture,
        camera=CameraCapabilities("replayed camera", 32, 24, 255, (1e-6, 60.0)),
        projector=ProjectorCapabilities("replayed projector", 10, 8, 1 / 60),
        arm=ArmCapabilities("replayed arm", limits, 0.5),
        toml="[camera]\n",
        source="rig",
    )


@pytest.fixture
def rig(recording):
    with replay_rig(recording) as rig:
        rig.arm.home()
        yield rig


def test_frames_come_as_they_were_taken_under_the_state_of_the_rig(rig, recording):
    rig.show(PATTERNS[0])
    one = rig.capture(0.1)
    rig.show(PATTERNS[1])
    other = rig.capture(0.1)
    rig.blank()
    rig.move_light(POSES[1])
    rig.switch_lamp(True)
    lit = rig.capture(0.1)
    rig.place_camera("left")
    dark = rig.capture(0.1)
    rig.switch_lamp(True)
    left = rig.capture(0.1)
    frames = [one, other, lit, dark, left]
    for frame, number in zip(frames, (0, 1, 4, 6, 5), strict=True):
        np.testing.assert_array_equal(frame.image, picture(recording.frames[number]))
        assert frame.exposure_applied_s == 0.099
        assert frame.wall_time == 1000.0 + number
    assert [frame.sequence for frame in frames] == [1, 2, 3, 4, 5]
    assert left.subject.camera_position == "left"
    assert left.subject.arm_pose == POSES[1]
    assert (rig.source, rig.toml) == ("rig", "[camera]\n")


def test_a_frame_recorded_twice_comes_twice_in_order_and_then_no_more(rig, recording):
    rig.show(PATTERNS[0])
    for number in (0, 2):
        frame = rig.capture(0.1)
        np.testing.assert_array_equal(frame.image, picture(recording.frames[number]))
    with pytest.raises(NotRecordedError, match=r"recorded 2 times \(frame 0002 last\)"):
        rig.capture(0.1)


def test_what_was_not_recorded_is_refused_by_name_with_what_is_near(rig):
    with pytest.raises(NotRecordedError, match=r"'0002 pattern' was not recorded; .*0000 pattern"):
        rig.show(PATTERNS[2])
    with pytest.raises(NotRecordedError, match=r"azimuth 29\.00.* azimuth 30\.00.*azimuth 0\.00"):
        rig.move_light(ArmPose(math.radians(29), math.radians(40)))
    with pytest.raises(NotRecordedError, match="'right' was not recorded; there are front; left"):
        rig.place_camera("right")
    rig.show(PATTERNS[0])
    with pytest.raises(NotRecordedError, match=r"exposure of 0\.4 s; the nearest are 0\.1 s"):
        rig.capture(0.4)
    rig.move_light(POSES[0])
    rig.switch_lamp(True)
    with pytest.raises(NotRecordedError, match=r"lamp on at azimuth 0.*0000: 0000 pat"):
        rig.capture(0.1)


def test_the_same_picture_under_another_name_is_the_same(rig, recording):
    rig.show(Projection("another name", PATTERNS[0].image.copy()))
    np.testing.assert_array_equal(rig.capture(0.1).image, picture(recording.frames[0]))


def test_replayed_frames_are_checked_like_fresh_ones(recording):
    """A recording whose frames are all one picture is refused as a camera would be."""
    from dataclasses import replace

    with replay_rig(replace(recording, load=lambda _: picture(recording.frames[0]))) as rig:
        rig.show(PATTERNS[0])
        rig.capture(0.1)
        rig.show(PATTERNS[1])
        with pytest.raises(FrameOrderError, match="over again"):
            rig.capture(0.1)


def test_a_rig_recorded_without_a_device_has_none(recording):
    from dataclasses import replace

    bare = replace(recording, arm=None, projector=None, frames=(recorded(9),))
    with replay_rig(bare) as rig:
        assert not rig.has_arm
        with pytest.raises(DeviceError, match="no projector"):
            rig.show(PATTERNS[0])
        assert rig.camera_positions == ()
        np.testing.assert_array_equal(rig.capture(0.1).image, picture(bare.frames[0]))
