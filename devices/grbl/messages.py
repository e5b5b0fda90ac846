"""Grammar of what GRBL 1.1 says: acknowledgements, refusals, alarms, reports, settings, notices.

Source: the interface document of GRBL 1.1. A line is a message, or several that lost the line end
between them; whatever else it holds is garbled, and then only the bad news in it is believed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum


class MachineState(StrEnum):
    """First word of a status report."""

    IDLE = "Idle"
    RUN = "Run"
    HOLD = "Hold"
    JOG = "Jog"
    ALARM = "Alarm"
    DOOR = "Door"
    CHECK = "Check"
    HOME = "Home"
    SLEEP = "Sleep"


@dataclass(frozen=True)
class Acknowledged:
    """``ok``: the line was understood, and its motion queued; nothing more."""


@dataclass(frozen=True)
class Refused:
    """``error:n``."""

    code: int


@dataclass(frozen=True)
class Alarm:
    """``ALARM:n``."""

    code: int


@dataclass(frozen=True)
class Banner:
    """Greeting after every start and reset.

    Attributes
    ----------
    name, version : str
        As in ``Grbl 1.1h ['$' for help]``.
    """

    name: str
    version: str


@dataclass(frozen=True)
class SettingValue:
    """``$n=value``."""

    number: int
    value: float


@dataclass(frozen=True)
class ModalState:
    """``[GC:…]``, the modes of the parser.

    Attributes
    ----------
    words : frozenset of str
        Such as ``G90``, ``M5``.
    tool : int
        Number of the tool, which nothing but a ``T`` word changes.
    """

    words: frozenset[str]
    tool: int


@dataclass(frozen=True)
class BuildOptions:
    """``[OPT:codes,blocks,bytes]``.

    Attributes
    ----------
    codes : str
        One character per option that the firmware was built with.
    """

    codes: str


@dataclass(frozen=True)
class Notice:
    """Any other ``[…]`` or start-up line."""

    text: str


@dataclass(frozen=True)
class Garbled:
    """Something that is no message."""

    text: str


@dataclass(frozen=True, kw_only=True)
class StatusReport:
    """``<…>``, the answer to ``?``.

    Attributes
    ----------
    state : MachineState
    substate : int or None
        Of a hold (0: stands still, 1: slowing down) or a door.
    machine_position : tuple of float or None
        In the controller's units; None if it reports work positions.
    feed : float or None
        Speed at this moment, units per minute.
    pins : str
        Inputs that are active, a letter each.
    accessories : str or None
        Outputs that are on, a letter each (S or C spindle, F flood, M mist); None in the reports
        that do not tell, which are most.
    """

    state: MachineState
    substate: int | None = None
    machine_position: tuple[float, ...] | None = None
    feed: float | None = None
    pins: str = ""
    accessories: str | None = None


Message = (
    Acknowledged
    | Refused
    | Alarm
    | Banner
    | SettingValue
    | ModalState
    | BuildOptions
    | Notice
    | Garbled
    | StatusReport
)

_BAD_NEWS = (Refused, Alarm, Banner)
# One message, for lines that hold several. Alternatives do not begin alike.
_TOKEN = re.compile(
    r"ok|error:\d{1,3}|ALARM:\d{1,3}|Grbl\w* \d+\.\d+\w* \[[^\]]*\]|\[[^\[\]<>]*\]|<[^<>\[\]]*>"
    r"|\$\d{1,3}=-?\d+(?:\.\d+)?"
)
_BANNER = re.compile(r"(Grbl\w*) (\d+\.\d+\w*) \[[^\]]*\]")
_STARTUP = re.compile(r">[^<>]*:(?:ok|error:\d{1,3})")
_NUMBER = re.compile(r"-?\d{1,6}(?:\.\d{1,4})?")
_FIELD = re.compile(r"([A-Za-z]+):([-0-9A-Za-z.,:]*)")
_AXES = range(2, 7)
# How many numbers each field of a status report holds.
_COUNTS = {
    "MPos": _AXES,
    "WPos": _AXES,
    "WCO": _AXES,
    "FS": range(2, 3),
    "F": range(1, 2),
    "Bf": range(2, 3),
    "Ov": range(3, 4),
}

_OWN_FIELDS = _COUNTS.keys() | {"Pn", "Ln"}


def parse_line(line: str) -> tuple[Message, ...]:
    """Messages in a line.

    Parameters
    ----------
    line : str
        Without its end. Anything may be in it.

    Returns
    -------
    tuple of Message
        In order. From a line that holds anything else, :class:`Garbled` and the refusals, alarms
        and banners in it.
    """
    line = line.strip()
    if not line:
        return ()
    if _STARTUP.fullmatch(line):
        return (Notice(line),)
    found: list[Message] = []
    clean, end = True, 0
    for token in _TOKEN.finditer(line):
        clean &= token.start() == end
        end = token.end()
        message = _parse_token(token.group())
        clean &= not isinstance(message, Garbled)
        found.append(message)
    if clean and end == len(line):
        return tuple(found)
    return (Garbled(line), *(message for message in found if isinstance(message, _BAD_NEWS)))


def _parse_token(token: str) -> Message:
    """The message of a token that begins and ends like one."""
    if token == "ok":
        return Acknowledged()
    if token.startswith("error:"):
        return Refused(int(token[6:]))
    if token.startswith("ALARM:"):
        return Alarm(int(token[6:]))
    if token.startswith("$"):
        number, value = token[1:].split("=")
        return SettingValue(int(number), float(value))
    if token.startswith("["):
        return _parse_bracket(token)
    if token.startswith("<"):
        return _parse_status(token)
    banner = _BANNER.fullmatch(token)
    return Banner(banner[1], banner[2]) if banner else Garbled(token)


def _parse_bracket(token: str) -> Message:
    kind, _, text = token[1:-1].partition(":")
    if kind == "GC":
        words = text.split()
        tools = [word[1:] for word in words if re.fullmatch(r"T\d{1,3}", word)]
        return ModalState(frozenset(words), int(tools[0])) if len(tools) == 1 else Garbled(token)
    if kind == "OPT":
        return BuildOptions(text.split(",")[0])
    return Notice(token[1:-1])


def _parse_status(token: str) -> Message:
    """A status report, garbled unless each of its fields is well formed and there once."""
    head, *parts = token[1:-1].split("|")
    name, _, substate = head.partition(":")
    if name not in {str(state) for state in MachineState} or not re.fullmatch(r"\d?", substate):
        return Garbled(token)
    fields: dict[str, str] = {}
    for part in parts:
        field = _FIELD.fullmatch(part)
        if field is None or field[1] in fields:
            return Garbled(token)
        fields[field[1]] = field[2]
    numbers = {key: _numbers(fields[key], _COUNTS[key]) for key in _COUNTS if key in fields}
    if None in numbers.values() or not ("MPos" in fields or "WPos" in fields):
        return Garbled(token)
    speeds = numbers.get("FS") or numbers.get("F")
    return StatusReport(
        state=MachineState(name),
        substate=int(substate) if substate else None,
        machine_position=numbers.get("MPos"),
        feed=speeds[0] if speeds else None,
        pins=fields.get("Pn", ""),
        accessories=_accessories(fields),
    )


def _accessories(fields: dict[str, str]) -> str | None:
    """Outputs that a report tells: they come with the overrides, and are left out if none is on.

    A field of another firmware in their place may be theirs with its name altered, and tells
    nothing.
    """
    if "A" in fields:
        return fields["A"]
    return "" if "Ov" in fields and fields.keys() <= _OWN_FIELDS else None


def _numbers(text: str, counts: range) -> tuple[float, ...] | None:
    """Numbers between commas; None if any is malformed, or there are too few or too many."""
    parts = text.split(",")
    if len(parts) not in counts or not all(_NUMBER.fullmatch(part) for part in parts):
        return None
    return tuple(float(part) for part in parts)
