"""Faults of a serial line and of what hangs on it, as plain data.

Replies and commands are counted from the first that passes, from zero, so that a script of faults
is the same in every run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ReplyLost:
    """The n-th reply never comes."""

    reply: int


@dataclass(frozen=True, kw_only=True)
class ReplyLate:
    """The n-th reply, and all behind it, come later."""

    reply: int
    seconds: float


@dataclass(frozen=True, kw_only=True)
class ReplyMerged:
    """The line end of the n-th reply is lost."""

    reply: int


@dataclass(frozen=True, kw_only=True)
class ReplySplit:
    """The n-th reply pauses after some of its bytes."""

    reply: int
    after: int
    seconds: float


@dataclass(frozen=True, kw_only=True)
class ReplyGarbled:
    """A byte of the n-th reply is another."""

    reply: int
    place: int
    byte: int


@dataclass(frozen=True, kw_only=True)
class ReplyRepeated:
    """The n-th reply comes twice."""

    reply: int


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Bytes that nobody sent come before the n-th reply."""

    reply: int
    data: bytes


@dataclass(frozen=True, kw_only=True)
class CommandLost:
    """The n-th line from the host never arrives."""

    command: int


@dataclass(frozen=True, kw_only=True)
class CommandGarbled:
    """A byte of the n-th line from the host arrives as another."""

    command: int
    place: int
    byte: int


@dataclass(frozen=True, kw_only=True)
class RealtimeLost:
    """The n-th single byte that acts at once (status, hold, reset) never arrives."""

    command: int


@dataclass(frozen=True, kw_only=True)
class AfterCommand:
    """Something that happens a while after the n-th line from the host."""

    command: int
    delay_s: float = 0.0


@dataclass(frozen=True, kw_only=True)
class PowerFails(AfterCommand):
    """The controller loses power for a moment, and greets anew."""


@dataclass(frozen=True, kw_only=True)
class Unplugged(AfterCommand):
    """The port goes away; the controller goes on with what it was told.

    Attributes
    ----------
    back_after_s : float
        When it is plugged in again; infinite for never.
    """

    back_after_s: float = math.inf


@dataclass(frozen=True, kw_only=True)
class FallsSilent(AfterCommand):
    """Nothing is heard from the controller any more.

    Attributes
    ----------
    deaf : bool
        Whether it hears nothing either.
    """

    deaf: bool = False


@dataclass(frozen=True, kw_only=True)
class AlarmTrips(AfterCommand):
    """Something stops the machine dead.

    Attributes
    ----------
    code : int
        Number of the alarm.
    """

    code: int = 1


@dataclass(frozen=True, kw_only=True)
class DoorOpens(AfterCommand):
    """The safety door opens, and closes later.

    Attributes
    ----------
    closes_after_s : float
        Infinite for never.
    """

    closes_after_s: float = math.inf


@dataclass(frozen=True, kw_only=True)
class LampSticks(AfterCommand):
    """From then on the lamp's output stays as it is."""


Fault = (
    ReplyLost
    | ReplyLate
    | ReplyMerged
    | ReplySplit
    | ReplyGarbled
    | ReplyRepeated
    | Noise
    | CommandLost
    | CommandGarbled
    | RealtimeLost
    | PowerFails
    | Unplugged
    | FallsSilent
    | AlarmTrips
    | DoorOpens
    | LampSticks
)
