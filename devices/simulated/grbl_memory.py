"""What a simulated GRBL controller remembers and reports: its settings, and its status line.

Formats, checks and the cadence of the optional fields are those of GRBL 1.1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from devices.simulated.grbl_gcode import RefusedLineError

# Defaults of the generic machine that GRBL 1.1 is built for.
FACTORY_SETTINGS: Mapping[int, float] = {
    0: 10,
    1: 25,
    2: 0,
    3: 0,
    4: 0,
    5: 0,
    6: 0,
    10: 1,
    11: 0.01,
    12: 0.002,
    13: 0,
    20: 0,
    21: 0,
    22: 0,
    23: 0,
    24: 25,
    25: 500,
    26: 250,
    27: 1,
    30: 1000,
    31: 0,
    32: 0,
    **{100 + axis: 250 for axis in range(3)},
    **{110 + axis: 500 for axis in range(3)},
    **{120 + axis: 10 for axis in range(3)},
    **{130 + axis: 200 for axis in range(3)},
}
"""``$n`` to value, as the firmware comes."""

ARM_SETTINGS: Mapping[int, float] = {
    **FACTORY_SETTINGS,
    1: 255,
    20: 1,
    22: 1,
    23: 3,
    24: 120,
    25: 1200,
    26: 50,
    100: 100,
    101: 100,
    110: 3000,
    111: 1800,
    120: 120,
    121: 80,
    130: 360,
    131: 90,
}
"""``$n`` to value for a light arm with one unit to the degree and its switches at the low ends."""

_WHOLE = {0, 1, 2, 3, 4, 5, 6, 10, 13, 20, 21, 22, 23, 26, 30, 31, 32}
_FLAGS = {4, 5, 6, 13, 20, 21, 22, 32}
_SHORTEST_PULSE = 3


class Settings:
    """``$n=value``, checked as GRBL checks them.

    Parameters
    ----------
    values : mapping of int to float
    """

    def __init__(self, values: Mapping[int, float]) -> None:
        self._values = dict(FACTORY_SETTINGS) | dict(values)

    def __getitem__(self, number: int) -> float:
        return self._values[number]

    def store(self, number: int, value: float) -> None:
        """Change a setting.

        Raises
        ------
        RefusedLineError
            With GRBL's number.
        """
        if value < 0:
            raise RefusedLineError(4)
        if number not in self._values:
            raise RefusedLineError(3)
        if number == 0 and value < _SHORTEST_PULSE:
            raise RefusedLineError(6)
        if number == 20 and value and not self._values[22]:
            raise RefusedLineError(10)
        if number == 22 and not value:
            self._values[20] = 0  # no soft limits without homing
        if number in _FLAGS:
            value = float(bool(value))
        self._values[number] = int(value) if number in _WHOLE else value

    def lines(self) -> Iterator[str]:
        """As ``$$`` lists them."""
        for number in sorted(self._values):
            value = self._values[number]
            yield f"${number}={value:.0f}" if number in _WHOLE else f"${number}={value:.3f}"


@dataclass
class ReportCadence:
    """Which status reports carry the optional fields.

    The offset of the work coordinates comes first after a change or a start and then seldom, the
    overrides, with the outputs, in another report.
    """

    until_offset: int = 0
    until_overrides: int = 0

    def outputs_changed(self) -> None:
        """Have the overrides told in the next report."""
        self.until_overrides = 0

    def offset_changed(self) -> None:
        """Have the offset told in the next report."""
        self.until_offset = 0

    def next_fields(self, *, busy: bool) -> tuple[bool, bool]:
        """Whether this report carries the offset, and whether the overrides."""
        offset = overrides = False
        if self.until_offset > 0:
            self.until_offset -= 1
        else:
            offset = True
            self.until_offset = 29 if busy else 9
            self.until_overrides = max(self.until_overrides, 1)  # never both at once
        if self.until_overrides > 0:
            self.until_overrides -= 1
        else:
            overrides = True
            self.until_overrides = 19 if busy else 9
        return offset, overrides
