"""Any operations against any faults: the arm stays safe, in time, and honest about it."""

from __future__ import annotations

import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from devices.grbl.settings import LampOutput
from devices.simulated import arm_trials, grbl_faults
from devices.simulated.arm_trials import Operation, Step, Trial, draw_trial, run_trial

REPLIES = st.integers(0, 260)
COMMANDS = st.integers(0, 40)
SECONDS = st.floats(0, 3)
BACK = st.one_of(st.just(math.inf), st.floats(0, 5))
BYTES = st.integers(0, 255)
AFTER = {"command": COMMANDS, "delay_s": SECONDS}

FAULTS = st.one_of(
    st.builds(grbl_faults.ReplyLost, reply=REPLIES),
    st.builds(grbl_faults.ReplyLate, reply=REPLIES, seconds=SECONDS),
    st.builds(grbl_faults.ReplyMerged, reply=REPLIES),
    st.builds(grbl_faults.ReplySplit, reply=REPLIES, after=st.integers(0, 60), seconds=SECONDS),
    st.builds(grbl_faults.ReplyGarbled, reply=REPLIES, place=st.integers(0, 60), byte=BYTES),
    st.builds(grbl_faults.ReplyRepeated, reply=REPLIES),
    st.builds(grbl_faults.Noise, reply=REPLIES, data=st.binary(min_size=1, max_size=40)),
    st.builds(grbl_faults.CommandLost, command=COMMANDS),
    st.builds(grbl_faults.CommandGarbled, command=COMMANDS, place=st.integers(0, 40), byte=BYTES),
    st.builds(grbl_faults.RealtimeLost, command=st.integers(0, 150)),
    st.builds(grbl_faults.PowerFails, **AFTER),
    st.builds(grbl_faults.Unplugged, **AFTER, back_after_s=BACK),
    st.builds(grbl_faults.FallsSilent, **AFTER, deaf=st.booleans()),
    st.builds(grbl_faults.AlarmTrips, **AFTER, code=st.integers(1, 9)),
    st.builds(grbl_faults.DoorOpens, **AFTER, closes_after_s=BACK),
    st.builds(grbl_faults.LampSticks, **AFTER),
)
SHARES = st.floats(-0.05, 1.05)
STEPS = st.builds(Step, st.sampled_from(Operation), SHARES, SHARES)
TRIALS = st.builds(
    Trial,
    st.lists(STEPS, min_size=1, max_size=6).map(lambda steps: (Step(Operation.HOME), *steps)),
    st.lists(FAULTS, max_size=4).map(tuple),
    st.booleans(),
    st.sampled_from([LampOutput.SPINDLE, LampOutput.SPINDLE_REVERSE, LampOutput.FLOOD]),
)


@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(TRIALS)
def test_no_script_of_faults_makes_the_arm_unsafe(trial):
    assert run_trial(trial).violations == ()


def test_without_faults_everything_is_done():
    steps = [Step(Operation.HOME), Step(Operation.MOVE, 0.2, 0.9), Step(Operation.LAMP_ON)]
    steps += [Step(Operation.MOVE, 0.9, 0.1), Step(Operation.STOP), Step(Operation.MOVE, 0.3, 0.3)]
    verdict = run_trial(Trial(tuple(steps)))
    assert set(verdict.outcomes) == {"done"}
    assert verdict.violations == ()


def test_a_trial_is_the_same_in_every_run():
    for seed in range(20):
        assert draw_trial(seed) == draw_trial(seed)
        assert run_trial(draw_trial(seed)) == run_trial(draw_trial(seed))


def test_every_kind_of_fault_is_drawn():
    kinds = {type(fault).__name__ for seed in range(300) for fault in draw_trial(seed).faults}
    assert kinds == {
        name for name in vars(grbl_faults) if isinstance(getattr(grbl_faults, name), type)
    } - {"AfterCommand"}


@pytest.mark.parametrize(
    ("name", "replacement", "violation"),
    [
        # Lamp left as it is in a move, no waiting for arrival, nothing done after a failure.
        ("extinguish", None, "lit while moving"),
        ("arrival", None, "still moving"),
        ("halt", None, "not sent after"),
    ],
)
def test_the_judge_catches_a_driver_that_is_unsafe(monkeypatch, name, replacement, violation):
    from devices.grbl.lamp import Lamp
    from devices.grbl.light_arm import GrblLightArm

    if name == "extinguish":
        monkeypatch.setattr(Lamp, "extinguish", lambda self, talk, doing: talk.status(doing=doing))
    elif name == "arrival":
        monkeypatch.setattr(
            GrblLightArm,
            "_await_arrival",
            lambda self, targets, arrival, doing: self._talk.status(doing=doing),
        )
    else:
        monkeypatch.setattr(GrblLightArm, "_halt", lambda self: None)
    steps = tuple(
        Step(operation, *shares)
        for operation, *shares in (
            (Operation.HOME,),
            (Operation.LAMP_ON,),
            (Operation.MOVE, 0.9, 0.9),
            (Operation.MOVE, 0.1, 0.1),
        )
    )
    faults = (grbl_faults.CommandLost(command=14),) if name == "halt" else ()
    violations = arm_trials.run_trial(Trial(steps, faults)).violations
    assert any(violation in text for text in violations)
