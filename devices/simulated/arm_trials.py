"""Trials of the light arm's driver: operations against scripts of faults, judged from outside.

A trial is plain data. It runs the real driver on a simulated line in virtual time and holds it
against what truly happened to the arm: never a move outside the limits, never the lamp lit while
anything moves, never an operation longer than its deadline and what stopping takes, a stop and
lights out on the wire after every failure, always a named error, and nothing wrong that was
reported as done.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from devices.deadline import Deadline
from devices.errors import DeviceError
from devices.grbl.errors import PositionUntrustedError, StopFailedError
from devices.grbl.light_arm import GrblLightArm
from devices.grbl.settings import GrblSettings, LampOutput
from devices.interfaces import ArmLimits, ArmPose
from devices.simulated.grbl_controller import SimulatedGrblController
from devices.simulated.grbl_faults import (
    AlarmTrips,
    CommandGarbled,
    CommandLost,
    DoorOpens,
    FallsSilent,
    Fault,
    LampSticks,
    Noise,
    PowerFails,
    RealtimeLost,
    ReplyGarbled,
    ReplyLate,
    ReplyLost,
    ReplyMerged,
    ReplyRepeated,
    ReplySplit,
    Unplugged,
)
from devices.simulated.grbl_machine import Moment
from devices.simulated.grbl_memory import ARM_SETTINGS
from devices.simulated.grbl_port import VirtualClock, VirtualPort
from devices.simulated.grbl_wire import SimulatedWire

# A small quick arm, so that a trial takes little time.
_SETTINGS = {
    **ARM_SETTINGS,
    24: 600,
    25: 2400,
    26: 10,
    110: 3000,
    111: 2400,
    120: 400,
    121: 300,
    130: 40,
    131: 30,
}
_REPLY_S, _LAMP_S = 1.0, 1.0
_DEADLINE_S = 12.0
# Time beyond deadline and stopping that looking at the clock and sending bytes takes.
_SLACK_S = 0.1
_ROUNDING_DEG = 1e-3
# Time in which a reply travels.
_ON_ITS_WAY_S = 0.02
_SETTLED_S = 60.0


class Operation(StrEnum):
    """What a trial does with the arm."""

    HOME = "home"
    MOVE = "move"
    LAMP_ON = "lamp on"
    LAMP_OFF = "lamp off"
    STOP = "stop"
    RECONNECT = "reconnect"
    UNLOCK = "unlock"


@dataclass(frozen=True)
class Step:
    """One operation.

    Attributes
    ----------
    operation : Operation
    azimuth, elevation : float
        Of a move: share of the range, which 0 to 1 lies within.
    """

    operation: Operation
    azimuth: float = 0.5
    elevation: float = 0.5


@dataclass(frozen=True)
class Trial:
    """A script.

    Attributes
    ----------
    steps : tuple of Step
    faults : tuple of Fault
    boots : bool
        Whether the board starts anew when its port is opened.
    lamp : LampOutput
    """

    steps: tuple[Step, ...]
    faults: tuple[Fault, ...] = ()
    boots: bool = False
    lamp: LampOutput = LampOutput.SPINDLE


@dataclass(frozen=True)
class Verdict:
    """What came of a trial.

    Attributes
    ----------
    outcomes : tuple of str
        Of each operation: ``done``, or the name of the error.
    violations : tuple of str
        What must never happen, and did.
    """

    outcomes: tuple[str, ...]
    violations: tuple[str, ...]


def draw_trial(seed: int) -> Trial:
    """A trial drawn at random: mostly sensible sequences, with one to four faults."""
    draw = random.Random(seed)
    steps = [Step(Operation.HOME)] if draw.random() < 0.85 else []
    for _ in range(draw.randint(2, 7)):
        operation = draw.choice(
            [Operation.MOVE] * 4
            + [Operation.LAMP_ON] * 3
            + [Operation.LAMP_OFF, Operation.STOP, Operation.HOME, Operation.RECONNECT]
            + [Operation.UNLOCK]
        )
        steps.append(Step(operation, draw.uniform(-0.05, 1.05), draw.uniform(-0.05, 1.05)))
    faults = tuple(_draw_fault(draw) for _ in range(draw.randint(1, 4)))
    lamp = draw.choice([LampOutput.SPINDLE, LampOutput.SPINDLE_REVERSE, LampOutput.FLOOD])
    return Trial(tuple(steps), faults, draw.random() < 0.3, lamp)


def _draw_fault(draw: random.Random) -> Fault:
    # Some 75 replies and 3 commands pass while the settings are read, and 5 commands per operation.
    reply = draw.randint(0, 70) if draw.random() < 0.15 else draw.randint(70, 260)
    command = draw.randint(0, 40)
    delay = draw.choice([0.0, draw.uniform(0, 0.1), draw.uniform(0, 2)])
    byte = draw.choice([draw.randint(32, 126), draw.randint(0, 255), draw.choice(b"0123456789")])
    after: dict[str, Any] = {"command": command, "delay_s": delay}
    makers: list[Callable[[], Fault]] = [
        lambda: ReplyLost(reply=reply),
        lambda: ReplyLate(reply=reply, seconds=draw.uniform(0, 3)),
        lambda: ReplyMerged(reply=reply),
        lambda: ReplySplit(reply=reply, after=draw.randint(0, 60), seconds=draw.uniform(0, 3)),
        lambda: ReplyGarbled(reply=reply, place=draw.randint(0, 60), byte=byte),
        lambda: ReplyRepeated(reply=reply),
        lambda: Noise(reply=reply, data=draw.randbytes(draw.randint(1, 40))),
        lambda: CommandLost(command=command),
        lambda: CommandGarbled(command=command, place=draw.randint(0, 40), byte=byte),
        lambda: RealtimeLost(command=draw.randint(0, 150)),
        lambda: PowerFails(**after),
        lambda: Unplugged(**after, back_after_s=draw.choice([math.inf, draw.uniform(0, 5)])),
        lambda: FallsSilent(**after, deaf=draw.random() < 0.5),
        lambda: AlarmTrips(**after, code=draw.randint(1, 9)),
        lambda: DoorOpens(**after, closes_after_s=draw.choice([math.inf, draw.uniform(0, 5)])),
        lambda: LampSticks(**after),
    ]
    return draw.choice(makers)()


def run_trial(trial: Trial) -> Verdict:
    """Run a trial, and judge it."""
    return _Run(trial).verdict()


class _Run:
    """A trial that runs."""

    def __init__(self, trial: Trial) -> None:
        self._trial = trial
        self._clock = VirtualClock()
        self._controller = SimulatedGrblController(
            _SETTINGS, lamp_outputs="F" if trial.lamp is LampOutput.FLOOD else "SC"
        )
        self._wire = SimulatedWire(
            self._controller, trial.faults, boot_s=0.3 if trial.boots else None
        )
        self._settings = GrblSettings(
            port="simulated",
            lamp=trial.lamp,
            reply_timeout_s=_REPLY_S,
            lamp_timeout_s=_LAMP_S,
            boot_timeout_s=2.0,
        )
        self._arm: GrblLightArm | None = None
        self._violations: list[str] = []
        self._limits: ArmLimits | None = None

    def verdict(self) -> Verdict:
        outcomes = [self._attempt("connect", self._connect, stops=False)]
        for step in self._trial.steps:
            if self._arm is None:
                outcomes.append(self._attempt("connect", self._connect, stops=False))
            if self._arm is not None:
                outcomes.append(self._do(step))
        if self._arm is not None:
            outcomes.append(self._attempt("close", self._arm.close, stops=False))
            if outcomes[-1] == "done":
                self._check_safe("after close")
        self._clock.now_s += _SETTLED_S
        self._wire.pass_time(self._clock.now_s)
        self._judge_timeline()
        return Verdict(tuple(outcomes), tuple(self._violations))

    def _connect(self) -> None:
        self._arm = GrblLightArm(
            self._settings,
            open_port=lambda: VirtualPort(self._wire, self._clock),
            clock=self._clock,
        )
        self._limits = self._arm.capabilities.limits

    def _do(self, step: Step) -> str:
        arm = self._arm
        assert arm is not None
        by = Deadline(self._clock() + _DEADLINE_S)
        operation = step.operation
        if operation is Operation.RECONNECT:
            closed = self._attempt("close", arm.close, stops=False)
            self._arm = None
            return closed if closed != "done" else self._attempt("connect", self._connect)
        actions: dict[Operation, Callable[[], object]] = {
            Operation.HOME: lambda: arm.home(deadline=by),
            Operation.MOVE: lambda: arm.move_to(self._target(step), deadline=by),
            Operation.LAMP_ON: lambda: arm.switch_lamp(True),
            Operation.LAMP_OFF: lambda: arm.switch_lamp(False),
            Operation.STOP: arm.stop,
            Operation.UNLOCK: arm.unlock,
        }
        outcome = self._attempt(operation, actions[operation], stops=operation != Operation.STOP)
        if outcome == "done":
            self._check_truth(step)
        return outcome

    def _target(self, step: Step) -> ArmPose:
        assert self._limits is not None
        angles = [
            low + share * (high - low)
            for share, (low, high) in (
                (step.azimuth, self._limits.azimuth),
                (step.elevation, self._limits.elevation),
            )
        ]
        return ArmPose(*angles)

    def _attempt(self, name: str, action: Callable[[], object], *, stops: bool = False) -> str:
        """Do something, and look at how it ended."""
        start, sent = self._clock.now_s, len(self._wire.attempts)
        longest = self._arm.longest_stop_s if self._arm is not None else 0.0
        try:
            action()
            outcome = "done"
        except DeviceError as error:
            outcome = type(error).__name__
            refused = isinstance(error, PositionUntrustedError) or "limits" in str(error)
            if stops and not refused:
                self._check_stopped(name, error, sent)
        except Exception as error:
            self._violations.append(f"{name}: unnamed {type(error).__name__}: {error}")
            outcome = "unnamed"
        limit = _DEADLINE_S + longest + _SLACK_S
        if self._clock.now_s - start > limit:
            self._violations.append(
                f"{name} took {self._clock.now_s - start:.1f} s of at most {limit:.1f}"
            )
        return outcome

    def _check_stopped(self, name: str, error: DeviceError, sent: int) -> None:
        """After a failure, hold, reset and lights out were sent, and did what they should."""
        data = b"".join(attempt.data for attempt in self._wire.attempts[sent:])
        unreachable = isinstance(error, StopFailedError)
        needed = [b"!", b"\x18", b"M5M9S0\n"] if self._wire.plugged else []
        missing = [repr(part) for part in needed if part not in data]
        if missing:
            self._violations.append(f"{name}: {', '.join(missing)} not sent after {error!r}")
        if not unreachable:
            self._check_safe(f"after {name} failed")

    def _check_safe(self, when: str) -> None:
        if self._controller.moving:
            self._violations.append(f"moving {when}")
        if self._controller.lamp_on:
            self._violations.append(f"lit {when}")

    def _check_truth(self, step: Step) -> None:
        """What was reported as done was done."""
        arm, controller = self._arm, self._controller
        assert arm is not None
        pose, true = arm.pose, controller.pose
        if controller.moving:
            self._violations.append(f"{step.operation} done, and still moving")
        if step.operation in (Operation.MOVE, Operation.HOME) and pose is not None:
            tolerance = math.radians(self._settings.position_tolerance_deg)
            asked = self._target(step) if step.operation is Operation.MOVE else pose
            for one in (pose, asked):
                if max(abs(one.azimuth - true.azimuth), abs(one.elevation - true.elevation)) > (
                    1.1 * tolerance
                ):
                    self._violations.append(f"{step.operation} done: at {true}, not {one}")
        if arm.lamp_on != controller.lamp_on and not self._just_changed():
            self._violations.append(
                f"{step.operation} done: lamp is {controller.lamp_on}, not {arm.lamp_on}"
            )

    def _just_changed(self) -> bool:
        """Whether the lamp changed by itself so late that no word of it can have come."""
        lit = self._controller.lamp_on
        late_s = sum(getattr(fault, "seconds", 0.0) for fault in self._trial.faults)
        return any(
            moment.lamp_on != lit
            for moment in self._controller.timeline
            if moment.time_s > self._clock.now_s - _ON_ITS_WAY_S - late_s
        )

    def _judge_timeline(self) -> None:
        timeline = self._controller.timeline
        if any(moment.moving and moment.lamp_on for moment in timeline):
            self._violations.append("lit while moving")
        # Nothing but the controller's own limits can catch a target altered on its way.
        altered = any(isinstance(fault, CommandGarbled) for fault in self._trial.faults)
        if self._limits is not None and not altered and any(map(self._strays, timeline)):
            self._violations.append("moved outside the limits")
        if any(self._beyond_travel(moment) for moment in timeline):
            self._violations.append("moved outside the controller's travel")

    def _strays(self, moment: Moment) -> bool:
        assert self._limits is not None
        pose = self._controller.pose_at(moment.place)
        return _moves(moment) and not all(
            low - math.radians(_ROUNDING_DEG) <= angle <= high + math.radians(_ROUNDING_DEG)
            for angle, (low, high) in (
                (pose.azimuth, self._limits.azimuth),
                (pose.elevation, self._limits.elevation),
            )
        )

    def _beyond_travel(self, moment: Moment) -> bool:
        return _moves(moment) and not all(
            -_SETTINGS[130 + axis] - _ROUNDING_DEG <= moment.place[axis] <= _ROUNDING_DEG
            for axis in range(2)
        )


def _moves(moment: Moment) -> bool:
    """Whether queued motion, not a search for the end switches, moves the arm."""
    return moment.moving and not moment.homing
