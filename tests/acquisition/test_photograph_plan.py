from __future__ import annotations

import math
from dataclasses import replace

import pytest
from pydantic import ValidationError

from acquisition.errors import SessionError
from acquisition.light_poses import travel
from acquisition.patterns import WHITE
from acquisition.photograph_plan import PhotographChoices, plan_photographs
from acquisition.plan import Bracketing, Plan, PlannedFrame, Purpose
from devices.errors import DeviceError
from devices.interfaces import ArmPose
from devices.rig import Rig
from devices.simulated.rig import demo_rig

CHOICES = PhotographChoices(
    exposures_s=(0.128, 0.008, 0.032), code_exposures_s=(0.03,), poses=7, reference_every=3
)


@pytest.fixture(scope="module")
def rig():
    return demo_rig(camera_width=40).open()


@pytest.fixture(scope="module")
def plan(rig):
    return plan_photographs(rig, CHOICES)


def test_from_every_place_code_comes_first_then_dark_then_light(plan, rig):
    assert plan.camera_positions == rig.camera_positions
    for place in plan.camera_positions:
        purposes = [f.purpose for f in plan.frames if f.camera_position == place]
        codes = purposes.count(Purpose.CODE)
        assert purposes[:codes] == [Purpose.CODE] * codes
        assert purposes[codes : codes + 3] == [Purpose.DARK] * 3
        assert Purpose.CODE not in purposes[codes:]
    places = [frame.camera_position for frame in plan.frames]
    assert places == sorted(places, key=plan.camera_positions.index)


def test_every_pose_has_a_bracket_of_its_own_from_short_to_long(plan, rig):
    lit = [f for f in plan.only(purpose=Purpose.PHOTOGRAPH, camera_position="left").frames]
    poses = list(dict.fromkeys(frame.arm_pose for frame in lit))
    assert len(poses) == 7
    for pose in poses:
        rig.arm.capabilities.limits.check(pose)
        bracket = [frame for frame in lit if frame.arm_pose == pose]
        assert [frame.exposure_s for frame in bracket] == [0.008, 0.032, 0.128]
        assert len({frame.bracket for frame in bracket}) == 1
        assert all(frame.lamp_on and frame.pattern is None for frame in bracket)
    assert len({frame.bracket for frame in lit}) == 7
    limits = rig.arm.capabilities.limits
    home = ArmPose(limits.azimuth[0], limits.elevation[0])
    assert travel(poses, start=home) < 0.7 * travel(sorted(poses, key=str), start=home)


def test_the_reference_pose_comes_first_in_between_and_last(plan):
    light = [
        frame
        for frame in plan.frames
        if frame.camera_position == "front" and frame.lamp_on and frame.exposure_s == 0.008
    ]
    kinds = "".join("r" if f.purpose is Purpose.REFERENCE_POSE else "p" for f in light)
    assert kinds == "rppprppprpr"
    assert len({f.arm_pose for f in light if f.purpose is Purpose.REFERENCE_POSE}) == 1


def test_targets_are_photographed_before_the_camera_leaves_its_first_place(rig):
    plan = plan_photographs(rig, replace(CHOICES, flat_target=True, colour_chart=True))
    for purpose, brackets in ((Purpose.FLAT_TARGET, 7), (Purpose.COLOUR_CHART, 1)):
        frames = plan.only(purpose=purpose).frames
        assert {frame.camera_position for frame in frames} == {"front"}
        assert len({frame.bracket for frame in frames}) == brackets
        assert plan.only(purpose=purpose, camera_position="left") is None
    lit = {f.arm_pose for f in plan.only(purpose=Purpose.PHOTOGRAPH).frames}
    assert {f.arm_pose for f in plan.only(purpose=Purpose.FLAT_TARGET).frames} == lit


def test_least_elevation_and_places_are_kept_to(rig):
    choices = replace(
        CHOICES, least_elevation=math.radians(40), camera_positions=("right", "front")
    )
    plan = plan_photographs(rig, choices)
    assert plan.camera_positions == ("right", "front")
    assert min(f.arm_pose.elevation for f in plan.frames if f.lamp_on) >= math.radians(40)


def test_a_real_lamp_warms_up_and_all_exposures_can_be_asked_for(rig):
    assert plan_photographs(rig, CHOICES).lamp_warm_up_s == 0
    real = Rig(rig.camera, rig.projector, rig.arm, rig.mount)
    plan = plan_photographs(real, replace(CHOICES, adaptive=False))
    assert plan.lamp_warm_up_s == 120
    assert plan.bracketing is None
    assert plan_photographs(real, replace(CHOICES, warm_up_s=5)).lamp_warm_up_s == 5


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        ({"poses": 0}, SessionError, "0 light poses"),
        ({"exposures_s": ()}, SessionError, "at least one exposure"),
        ({"exposures_s": (0.1, 0.1)}, SessionError, "only once"),
        ({"exposures_s": (float("nan"),)}, SessionError, "positive"),
        ({"exposures_s": (600.0,)}, DeviceError, "600 s is outside"),
        ({"code_exposures_s": (-1.0,)}, SessionError, "positive"),
        ({"camera_positions": ("roof",)}, SessionError, "no camera position 'roof'; there are fro"),
        ({"camera_positions": ("left", "left")}, SessionError, "only once"),
        ({"camera_positions": ()}, SessionError, "at least one camera position"),
        ({"reference_every": 0}, SessionError, "one pose or more"),
        ({"steps": 2}, SessionError, "three or more"),
    ],
)
def test_what_cannot_be_photographed_is_not_planned(rig, changed, error, message):
    with pytest.raises(error, match=message):
        plan_photographs(rig, replace(CHOICES, **changed))


def test_a_rig_without_an_arm_or_places_says_so(rig):
    with pytest.raises(DeviceError, match="no light arm"):
        plan_photographs(Rig(rig.camera, rig.projector), CHOICES)
    fixed = Rig(rig.camera, rig.projector, rig.arm)
    assert plan_photographs(fixed, CHOICES).camera_positions == ()
    with pytest.raises(SessionError, match=r"\[mount\] table"):
        plan_photographs(fixed, replace(CHOICES, camera_positions=("front",)))


def test_a_plan_of_photographs_survives_json(plan):
    assert Plan.model_validate_json(plan.model_dump_json()) == plan


def test_plans_of_scans_are_written_as_they_were_before_there_were_photographs():
    frame = PlannedFrame(id="a", pattern=WHITE, exposure_s=0.1)
    assert frame.model_dump_json() == (
        '{"id":"a","pattern":{"kind":"uniform","level":1.0},"exposure_s":0.1}'
    )


POSE = ArmPose(0.1, 0.5)


def lit(name, exposure, *, bracket="b", pose=POSE):
    return PlannedFrame(
        id=name,
        pattern=None,
        exposure_s=exposure,
        purpose=Purpose.PHOTOGRAPH,
        arm_pose=pose,
        lamp_on=True,
        bracket=bracket,
    )


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([lit("a", 0.2), lit("b", 0.1)], "exposures of a bracket rise"),
        ([lit("a", 0.1), lit("b", 0.2, pose=ArmPose(0, 1))], "under another light"),
        ([lit("a", 0.1), lit("x", 0.1, bracket="c"), lit("b", 0.2)], "interrupted"),
    ],
)
def test_brackets_that_are_none_are_refused(plan, frames, message):
    with pytest.raises(ValidationError, match=message):
        Plan.model_validate({**plan.model_dump(), "frames": [f.model_dump() for f in frames]})


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"pattern": None}, "a code has a pattern"),
        ({"pattern": None, "purpose": "photograph", "lamp_on": True}, "name one"),
        ({"pattern": WHITE, "bracket": "b"}, "each frame has an exposure"),
        ({"pattern": WHITE, "arm_pose": {"azimuth": float("nan"), "elevation": 0}}, "finite"),
    ],
)
def test_frames_that_cannot_be_taken_are_refused(parts, message):
    with pytest.raises(ValidationError, match=message):
        PlannedFrame(id="a", **parts)


@pytest.mark.parametrize("parts", [{"least_signal": 0}, {"headroom": 1.1}, {"least_share": -0.1}])
def test_rules_of_brackets_are_shares(parts):
    with pytest.raises(ValidationError):
        Bracketing(**parts)
