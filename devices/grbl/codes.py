"""Numbers of GRBL 1.1: alarms, refusals and settings, by name.

Numbers and meanings are those of the GRBL 1.1 documentation (its tables of alarm, error and setting
codes); the wording says what to do at this rig.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


@dataclass(frozen=True)
class Meaning:
    """What a number stands for.

    Attributes
    ----------
    name : str
        In a few words.
    remedy : str
        What the person at the rig can do.
    """

    name: str
    remedy: str


ALARMS = {
    1: Meaning("hard limit", "an end switch was hit; free the arm and home it"),
    2: Meaning("soft limit", "the target lies beyond the travel set in $130, $131; home the arm"),
    3: Meaning("reset while moving", "steps may be lost; home the arm"),
    4: Meaning("probe not ready", "the arm has no probe; restart the controller and home the arm"),
    5: Meaning("probe found nothing", "the arm has no probe; restart the controller and home it"),
    6: Meaning("homing interrupted by a reset", "home the arm again"),
    7: Meaning("door opened while homing", "close the door and home the arm again"),
    8: Meaning("end switch stays closed after pull-off", "check its wiring, or raise $27"),
    9: Meaning("end switch not found", "check its wiring, or raise $130 and $131 to the travel"),
    10: Meaning("second switch of an axis not found", "check the wiring of the doubled axis"),
}
"""Alarms by number."""

REFUSALS = {
    1: Meaning("letter expected", "the line was altered on its way; check cable and earth"),
    2: Meaning("bad number", "the line was altered on its way; check cable and earth"),
    3: Meaning("unknown $ command", "the firmware is not GRBL 1.1, or the line was altered"),
    4: Meaning("negative value", "a value must not be negative"),
    5: Meaning("homing is off", "switch homing on with $22=1"),
    6: Meaning("step pulse too short", "$0 must be 3 µs or more"),
    7: Meaning("settings unreadable", "its memory failed and holds defaults; set it up again"),
    8: Meaning("not idle", "wait until the arm stands still"),
    9: Meaning("locked", "the controller is in alarm; home the arm"),
    10: Meaning("soft limits without homing", "switch homing on with $22=1 first"),
    11: Meaning("line too long", "the line was altered on its way; check cable and earth"),
    12: Meaning("step rate too high", "lower $110, $111 or the steps per unit"),
    13: Meaning("door open", "close the safety door"),
    14: Meaning("stored line too long", "shorten the start-up line"),
    15: Meaning("jog beyond travel", "the target lies beyond $130, $131"),
    16: Meaning("invalid jog", "the line was altered on its way; check cable and earth"),
    17: Meaning("laser mode without PWM", "set $32=0"),
    20: Meaning("unsupported command", "the firmware lacks a command, or the line was altered"),
    21: Meaning("commands exclude one another", "the line was altered on its way"),
    22: Meaning("no feed rate", "the line was altered on its way"),
    23: Meaning("whole number expected", "the line was altered on its way"),
    24: Meaning("two commands want the axes", "the line was altered on its way"),
    25: Meaning("word repeated", "the line was altered on its way"),
    26: Meaning("axis words missing", "the line was altered on its way"),
    27: Meaning("invalid line number", "the line was altered on its way"),
    28: Meaning("value missing", "the line was altered on its way"),
    29: Meaning("unknown work coordinates", "the line was altered on its way"),
    30: Meaning("machine coordinates without G0 or G1", "the line was altered on its way"),
    31: Meaning("axis words unused", "the line was altered on its way"),
    32: Meaning("arc without axis words", "the line was altered on its way"),
    33: Meaning("invalid target", "the line was altered on its way"),
    34: Meaning("invalid arc radius", "the line was altered on its way"),
    35: Meaning("arc without offsets", "the line was altered on its way"),
    36: Meaning("words unused", "the line was altered on its way"),
    37: Meaning("tool length on the wrong axis", "the line was altered on its way"),
    38: Meaning("tool number too large", "the line was altered on its way"),
}
"""Refusals (``error:n``) by number."""


class Setting(IntEnum):
    """Settings of the controller that concern the arm."""

    STEP_PULSE_US = 0
    IDLE_DELAY_MS = 1
    STEP_INVERT = 2
    DIRECTION_INVERT = 3
    ENABLE_INVERT = 4
    LIMIT_PINS_INVERT = 5
    PROBE_PIN_INVERT = 6
    REPORT_OPTIONS = 10
    JUNCTION_DEVIATION = 11
    ARC_TOLERANCE = 12
    REPORT_INCHES = 13
    SOFT_LIMITS = 20
    HARD_LIMITS = 21
    HOMING = 22
    HOMING_DIRECTION = 23
    HOMING_FEED = 24
    HOMING_SEEK = 25
    HOMING_DEBOUNCE_MS = 26
    HOMING_PULL_OFF = 27
    SPINDLE_MAX = 30
    SPINDLE_MIN = 31
    LASER_MODE = 32
    STEPS_X = 100
    STEPS_Y = 101
    STEPS_Z = 102
    MAX_RATE_X = 110
    MAX_RATE_Y = 111
    MAX_RATE_Z = 112
    ACCELERATION_X = 120
    ACCELERATION_Y = 121
    ACCELERATION_Z = 122
    TRAVEL_X = 130
    TRAVEL_Y = 131
    TRAVEL_Z = 132


class RealtimeCommand(IntEnum):
    """Single bytes that act at once, in the middle of a line too."""

    RESET = 0x18
    STATUS = ord("?")
    HOLD = ord("!")
    RESUME = ord("~")
    DOOR = 0x84
    CANCEL_JOG = 0x85
