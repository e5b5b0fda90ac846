"""Axes of a light arm on a GRBL controller: machine coordinates to angles, travel, time of a move.

GRBL counts each axis from where its end switch closes: at zero with the whole travel on its
negative side, or, if the switch is found in the negative direction (``$23``), at minus the travel.
Firmware built to set the origin by homing (option Z) counts from the pull-off position instead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from devices.grbl.codes import Setting
from devices.grbl.errors import ControllerSettingsError

ORIGIN_SET_BY_HOMING = "Z"
"""Build option of firmware whose homing sets the machine's origin."""


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One axis, as its controller and its mounting make it.

    Attributes
    ----------
    name : str
        For messages.
    letter : str
        X, Y or Z.
    travel : (float, float)
        Least and largest machine coordinate within the controller's soft limits.
    switch, home : float
        Machine coordinate of the end switch, and of the place where homing ends.
    max_rate, acceleration, steps : float
        Controller's units per second, per second squared, and steps per unit.
    degrees_per_unit : float
        Negative where the angle rises against the machine coordinate.
    degrees_at_switch : float
        Angle at the end switch.
    """

    name: str
    letter: str
    travel: tuple[float, float]
    switch: float
    home: float
    max_rate: float
    acceleration: float
    steps: float
    degrees_per_unit: float
    degrees_at_switch: float

    @property
    def number(self) -> int:
        """Place of the axis in a status report."""
        return "XYZ".index(self.letter)

    @property
    def limits(self) -> tuple[float, float]:
        """Least and largest angle clear of both ends by the pull-off, radians.

        They are equal if the travel is shorter than that.
        """
        pull_off = abs(self.home - self.switch)
        low, high = self.travel
        if abs(low - self.switch) < abs(high - self.switch):
            ends = max(low, self.home), high - pull_off
        else:
            ends = low + pull_off, min(high, self.home)
        if ends[0] > ends[1]:
            ends = ends[0], ends[0]
        first, last = sorted(self.angle(end) for end in ends)
        return first, last

    def angle(self, coordinate: float) -> float:
        """Angle at a machine coordinate, radians."""
        degrees = self.degrees_at_switch + self.degrees_per_unit * (coordinate - self.switch)
        return math.radians(degrees)

    def coordinate(self, angle: float) -> float:
        """Machine coordinate of an angle in radians."""
        return self.switch + (math.degrees(angle) - self.degrees_at_switch) / self.degrees_per_unit


def read_axis(
    settings: Mapping[int, float],
    *,
    name: str,
    letter: str,
    build_options: str,
    degrees_per_unit: float,
    degrees_at_switch: float,
) -> Axis:
    """An axis from the controller's settings.

    Parameters
    ----------
    settings : mapping of int to float
        ``$n`` to value.
    name, letter, degrees_per_unit, degrees_at_switch
        See :class:`Axis`.
    build_options : str
        Codes of the firmware's build options.

    Raises
    ------
    ControllerSettingsError
        A rate, acceleration, resolution or travel is not positive.
    """
    number = "XYZ".index(letter)
    values = {}
    for first in (Setting.STEPS_X, Setting.MAX_RATE_X, Setting.ACCELERATION_X, Setting.TRAVEL_X):
        values[first] = settings[first + number]
        if not values[first] > 0:
            raise ControllerSettingsError(
                f"the light arm's controller has ${first + number}={values[first]:g}, which must "
                f"be positive for the {name}"
            )
    travel, pull_off = values[Setting.TRAVEL_X], settings[Setting.HOMING_PULL_OFF]
    at_low_end = bool(int(settings[Setting.HOMING_DIRECTION]) >> number & 1)
    if ORIGIN_SET_BY_HOMING in build_options:
        span = (0.0, travel) if at_low_end else (-travel, 0.0)
        home = 0.0
        switch = -pull_off if at_low_end else pull_off
    else:
        span = (-travel, 0.0)
        switch = -travel if at_low_end else 0.0
        home = switch + (pull_off if at_low_end else -pull_off)
    return Axis(
        name=name,
        letter=letter,
        travel=span,
        switch=switch,
        home=home,
        max_rate=values[Setting.MAX_RATE_X] / 60,
        acceleration=values[Setting.ACCELERATION_X],
        steps=values[Setting.STEPS_X],
        degrees_per_unit=degrees_per_unit,
        degrees_at_switch=degrees_at_switch,
    )


def travel_time(axes: Sequence[Axis], offsets: Sequence[float], feed: float) -> float:
    """Time of a straight move from rest to rest.

    Speed and acceleration along the path are what the slowest axis allows, as GRBL plans it.

    Parameters
    ----------
    axes : sequence of Axis
    offsets : sequence of float
        How far each axis goes, its controller's units.
    feed : float
        Speed asked for along the path, units per second.

    Returns
    -------
    float
        Seconds.
    """
    length = math.hypot(*offsets)
    if length == 0:
        return 0.0
    shares = [(axis, abs(offset) / length) for axis, offset in zip(axes, offsets, strict=True)]
    speed = min([feed, *(axis.max_rate / share for axis, share in shares if share > 0)])
    acceleration = min(axis.acceleration / share for axis, share in shares if share > 0)
    if length <= speed**2 / acceleration:
        return 2 * math.sqrt(length / acceleration)
    return length / speed + speed / acceleration


def homing_time(axes: Sequence[Axis], settings: Mapping[int, float]) -> float:
    """Longest time that a homing cycle can take, seconds.

    Each axis seeks its switch over one and a half times its travel, pulls off, approaches again
    slowly over up to five pull-offs, and pulls off; the axes may go one after another.
    """
    seek = settings[Setting.HOMING_SEEK] / 60
    locate = settings[Setting.HOMING_FEED] / 60
    pull_off = settings[Setting.HOMING_PULL_OFF]
    if not (seek > 0 and locate > 0):
        raise ControllerSettingsError(
            "the light arm's controller cannot home at no speed: set $24 and $25"
        )
    total = 0.0
    for axis in axes:
        span = axis.travel[1] - axis.travel[0]
        rate = min(seek, axis.max_rate)
        ramp = rate / axis.acceleration
        total += 1.5 * span / rate + 5 * pull_off / min(locate, rate) + 2 * pull_off / rate
        total += 4 * (ramp + settings[Setting.HOMING_DEBOUNCE_MS] / 1000)
    return total
