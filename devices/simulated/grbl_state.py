"""States of a simulated GRBL controller, and what its program keeps in mind about them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum


class State(StrEnum):
    """Of the firmware, as its reports name it."""

    IDLE = "Idle"
    RUN = "Run"
    HOLD = "Hold"
    JOG = "Jog"
    HOME = "Home"
    ALARM = "Alarm"
    CHECK = "Check"
    DOOR = "Door"
    SLEEP = "Sleep"


@dataclass(frozen=True, kw_only=True)
class Build:
    """Which firmware, with what wiring.

    Attributes
    ----------
    version, date : str
    options : str
        Codes of the build options. ``Z``: homing sets the origin; ``M``: M7 is known.
    homing_cycles : tuple of tuple of int
        Axes that home together, one cycle after another. GRBL as it comes lifts Z first.
    replies_lag : bool
        Answer a line only when the next byte comes.
    active_inputs : str
        Letters of inputs that read active whatever happens; X, Y, Z are end switches.
    """

    version: str = "1.1h"
    date: str = "20190830"
    options: str = "V"
    homing_cycles: tuple[tuple[int, ...], ...] = ((0, 1),)
    replies_lag: bool = False
    active_inputs: str = ""


@dataclass
class Flags:
    """Requests that wait for the program to look at them."""

    reset: bool = False
    report: bool = False
    hold: bool = False
    door: bool = False
    cancel: bool = False
    start: bool = False
    stop: bool = False
    sleep: bool = False

    def any(self) -> bool:
        """Whether any is set."""
        return any(getattr(self, flag.name) for flag in fields(self))


@dataclass
class Suspension:
    """Why lines are not looked at, and how far a door's sequence has come."""

    held: bool = False
    jog_cancelled: bool = False
    ajar: bool = False
    parked: bool = False
    restoring: bool = False
    restored: bool = False

    def any(self) -> bool:
        """Whether any is set."""
        return any(getattr(self, field.name) for field in fields(self))
