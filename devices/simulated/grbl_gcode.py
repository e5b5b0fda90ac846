"""G-code as a simulated GRBL 1.1 controller reads it: words, modal groups, and what it refuses.

Of the language, what a light arm can need; arcs, probing and stored positions are checked for form
and refused as unsupported. Refusals carry the numbers of GRBL's error table.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace

_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))?")
_MM_PER_INCH = 25.4
_MAX_TOOL = 255
_MAX_LINE_NUMBER = 10_000_000
# Commands that exclude one another on a line.
_GROUPS = {
    "motion": {"G0", "G1", "G2", "G3", "G80", "G38.2", "G38.3", "G38.4", "G38.5"},
    "non-modal": {"G4", "G10", "G28", "G28.1", "G30", "G30.1", "G53", "G92", "G92.1"},
    "plane": {"G17", "G18", "G19"},
    "distance": {"G90", "G91"},
    "arc distance": {"G91.1"},
    "feed mode": {"G93", "G94"},
    "units": {"G20", "G21"},
    "cutter": {"G40"},
    "tool length": {"G43.1", "G49"},
    "coordinates": {"G54", "G55", "G56", "G57", "G58", "G59"},
    "path": {"G61"},
    "flow": {"M0", "M1", "M2", "M30"},
    "spindle": {"M3", "M4", "M5"},
    "coolant": {"M7", "M8", "M9"},
}
_GROUP_OF = {command: group for group, commands in _GROUPS.items() for command in commands}
_VALUES = set("FIJKLNPRSTXYZ")
_UNSUPPORTED = {"G2", "G3", "G10", "G28", "G28.1", "G30", "G30.1", "G43.1"} | {
    command for command in _GROUPS["motion"] if command.startswith("G38")
}


class RefusedLineError(Exception):
    """A line that the parser refuses, with the number of the error."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"error:{code}")


@dataclass(frozen=True)
class Modes:
    """What stays in force from line to line."""

    motion: str = "G0"
    coordinates: str = "G54"
    plane: str = "G17"
    units: str = "G21"
    distance: str = "G90"
    feed_mode: str = "G94"
    flow: str = ""
    spindle: str = "M5"
    coolant: frozenset[str] = frozenset()
    tool: int = 0
    feed: float = 0.0
    spindle_speed: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __str__(self) -> str:
        """As ``[GC:…]`` tells them."""
        flow = f" {self.flow}" if self.flow else ""
        coolant = " ".join(sorted(self.coolant)) or "M9"
        return (
            f"{self.motion} {self.coordinates} {self.plane} {self.units} {self.distance} "
            f"{self.feed_mode}{flow} {self.spindle} {coolant} T{self.tool} F{self.feed:.0f} "
            f"S{self.spindle_speed:.0f}"
        )


@dataclass(frozen=True)
class Block:
    """One line, read.

    Attributes
    ----------
    modes : Modes
        In force from now on.
    target : (float, float, float) or None
        Machine coordinates to move to.
    feed : float or None
        Units per second; None for a rapid move.
    dwell_s : float
    """

    modes: Modes
    target: tuple[float, float, float] | None = None
    feed: float | None = None
    dwell_s: float = 0.0


@dataclass
class _Words:
    """Words of a line, checked one by one."""

    commands: dict[str, str] = field(default_factory=dict)
    values: dict[str, float] = field(default_factory=dict)
    takes_axes: str = ""

    @property
    def axes(self) -> dict[int, float]:
        return {"XYZ".index(k): v for k, v in self.values.items() if k in "XYZ"}


def read_block(
    line: str, modes: Modes, position: tuple[float, float, float], *, mist: bool = False
) -> Block:
    """Read a line of G-code.

    Parameters
    ----------
    line : str
        Upper case, without spaces and comments.
    modes : Modes
        In force.
    position : (float, float, float)
        Where the queued motion ends, machine coordinates.
    mist : bool
        Whether the firmware knows M7.

    Raises
    ------
    RefusedLineError
        With GRBL's number for what is wrong.
    """
    words = _read_words(line, mist)
    return _interpret(words, modes, position)


def read_jog(line: str, modes: Modes, position: tuple[float, float, float]) -> Block:
    """Read a jog, the part behind ``$J=``; nothing of it stays in force.

    Raises
    ------
    RefusedLineError
        With GRBL's number for what is wrong.
    """
    words = _read_words(line, False)
    if (
        words.commands.keys() - {"units", "distance", "non-modal"}
        or words.commands.get("non-modal", "G53") != "G53"
    ):
        raise RefusedLineError(16)
    if "F" not in words.values:
        raise RefusedLineError(22)
    jog_modes = replace(modes, motion="G1", feed_mode="G94")
    if not words.axes:
        raise RefusedLineError(26)
    block = _interpret(words, jog_modes, position)
    return replace(block, modes=modes)


def _read_words(line: str, mist: bool) -> _Words:
    words, at = _Words(), 0
    while at < len(line):
        match = _WORD.match(line, at)
        if match is None:
            raise RefusedLineError(1)
        letter, number = match[1], match[2]
        if number is None:
            raise RefusedLineError(2)
        at = match.end()
        if letter in "GM":
            _read_command(words, letter, float(number), mist)
        else:
            _read_value(words, letter, float(number))
    return words


def _read_command(words: _Words, letter: str, number: float, mist: bool) -> None:
    whole, hundredths = int(number), round(100 * (number - int(number)))
    name = f"{letter}{whole}" + (f".{hundredths // 10}" if hundredths else "")
    if name in ("G28", "G30", "G10", "G92", *_GROUPS["motion"] - {"G80"}, "G43.1", "G49"):
        if words.takes_axes:
            raise RefusedLineError(24)
        words.takes_axes = name
    group = _GROUP_OF.get(name)
    if group is None or (name == "M7" and not mist):
        base = f"{letter}{whole}"
        raise RefusedLineError(23 if hundredths and base in _GROUP_OF else 20)
    if group in words.commands:
        raise RefusedLineError(21)
    words.commands[group] = name


def _read_value(words: _Words, letter: str, number: float) -> None:
    if letter not in _VALUES:
        raise RefusedLineError(20)
    if letter == "T" and number > _MAX_TOOL:
        raise RefusedLineError(38)
    if letter in words.values:
        raise RefusedLineError(25)
    if letter in "FNPTS" and number < 0:
        raise RefusedLineError(4)
    words.values[letter] = number


def _interpret(words: _Words, modes: Modes, position: tuple[float, float, float]) -> Block:
    """The block of words that are each in order: here they are held against one another."""
    commands, values, axes = words.commands, dict(words.values), words.axes
    takes = words.takes_axes or ("motion" if axes else "")
    if values.get("N", 0) > _MAX_LINE_NUMBER:
        raise RefusedLineError(27)
    new = _modes_after(commands, values, modes)
    dwell = 0.0
    if commands.get("non-modal") == "G4":
        if "P" not in values:
            raise RefusedLineError(28)
        dwell = values.pop("P")
    if commands.get("non-modal") == "G53" and new.motion not in ("G0", "G1"):
        raise RefusedLineError(30)
    if any(command in _UNSUPPORTED for command in commands.values()):
        raise RefusedLineError(20)
    if takes == "G92":
        return Block(_offset(axes, new, position))
    if commands.get("non-modal") == "G92.1":
        new = replace(new, offset=(0.0, 0.0, 0.0))
    if values.keys() - set("FNSTXYZ"):
        raise RefusedLineError(36)
    if not axes:
        if commands.get("motion") == "G1" and new.feed == 0:
            raise RefusedLineError(22)
        return Block(new, dwell_s=dwell)
    if takes in ("motion", "G0", "G1"):
        return _motion(axes, new, position, machine=commands.get("non-modal") == "G53", dwell=dwell)
    raise RefusedLineError(31)


def _modes_after(commands: dict[str, str], values: dict[str, float], modes: Modes) -> Modes:
    new = replace(
        modes,
        motion=commands.get("motion", modes.motion),
        coordinates=commands.get("coordinates", modes.coordinates),
        plane=commands.get("plane", modes.plane),
        units=commands.get("units", modes.units),
        distance=commands.get("distance", modes.distance),
        feed_mode=commands.get("feed mode", modes.feed_mode),
        flow=commands.get("flow", modes.flow) if commands.get("flow") != "M1" else modes.flow,
        spindle=commands.get("spindle", modes.spindle),
        spindle_speed=values.get("S", modes.spindle_speed),
        tool=int(values.get("T", modes.tool)),
    )
    scale = _MM_PER_INCH if new.units == "G20" else 1.0
    if "F" in values:
        new = replace(new, feed=values["F"] * scale)
    elif new.feed_mode == "G93" or modes.feed_mode == "G93":
        new = replace(new, feed=0.0)
    coolant = commands.get("coolant")
    if coolant == "M9":
        new = replace(new, coolant=frozenset())
    elif coolant is not None:
        new = replace(new, coolant=new.coolant | {coolant})
    return new


def _offset(axes: dict[int, float], new: Modes, position: tuple[float, float, float]) -> Modes:
    """G92: call the present position by other numbers."""
    if not axes:
        raise RefusedLineError(26)
    scale = _MM_PER_INCH if new.units == "G20" else 1.0
    x, y, z = (position[k] - scale * axes[k] if k in axes else new.offset[k] for k in range(3))
    return replace(new, offset=(x, y, z))


def _motion(
    axes: dict[int, float],
    new: Modes,
    position: tuple[float, float, float],
    *,
    machine: bool,
    dwell: float,
) -> Block:
    if new.motion == "G80":
        raise RefusedLineError(31)
    scale = _MM_PER_INCH if new.units == "G20" else 1.0
    target = list(position)
    for axis, value in axes.items():
        value *= scale
        if machine:
            target[axis] = value
        elif new.distance == "G91":
            target[axis] += value
        else:
            target[axis] = value + new.offset[axis]
    x, y, z = target
    if new.motion == "G0":
        return Block(new, (x, y, z), None, dwell)
    if new.feed == 0:
        raise RefusedLineError(22)
    feed = new.feed / 60
    if new.feed_mode == "G93":
        feed *= math.dist(target, position)
    return Block(new, (x, y, z), feed, dwell)
