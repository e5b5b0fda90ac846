"""The arm as a whole: its two axes and their limits, what moves cost, and how poses are told."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from devices.errors import DeviceError
from devices.grbl.axes import Axis, homing_time, read_axis, travel_time
from devices.grbl.fitness import arm_limits
from devices.grbl.messages import StatusReport
from devices.grbl.settings import GrblSettings
from devices.interfaces import ArmLimits, ArmPose

# Slack of the time in which the arm slows down to a stand.
_SLOW_DOWN_S = 0.5
# Steps by which a position may be off for rounding.
_ROUNDING_STEPS = 1.5


@dataclass(frozen=True, kw_only=True)
class Mechanics:
    """Azimuth and elevation of an arm.

    Attributes
    ----------
    axes : (Axis, Axis)
        Azimuth and elevation.
    limits : ArmLimits
    feed : float
        Speed of moves along the path, the controller's units per second.
    homing_s : float
        Longest time that homing can take.
    tolerance_deg : float
        How far from its target a move may end.
    """

    axes: tuple[Axis, Axis]
    limits: ArmLimits
    feed: float
    homing_s: float
    tolerance_deg: float

    @property
    def speed(self) -> float:
        """Of the slower axis at full feed, rad/s."""
        return math.radians(
            min(min(axis.max_rate, self.feed) * abs(axis.degrees_per_unit) for axis in self.axes)
        )

    @property
    def slow_down_s(self) -> float:
        """Time in which the arm comes to a stand from any speed, with some slack."""
        return _SLOW_DOWN_S + max(axis.max_rate / axis.acceleration for axis in self.axes)

    @property
    def homes(self) -> list[float]:
        """Machine coordinates at which homing ends."""
        return [axis.home for axis in self.axes]

    def coordinates_of(self, pose: ArmPose) -> list[float]:
        """Machine coordinates of a pose."""
        angles = (pose.azimuth, pose.elevation)
        return [axis.coordinate(angle) for axis, angle in zip(self.axes, angles, strict=True)]

    def coordinates_in(self, report: StatusReport) -> list[float]:
        """Machine coordinates that a report tells.

        Raises
        ------
        DeviceError
            It does not tell those of both axes.
        """
        position = report.machine_position
        if position is None or max(axis.number for axis in self.axes) >= len(position):
            raise DeviceError(
                "the light arm's controller does not report the machine position of both axes: "
                "set $10=1"
            )
        return [position[axis.number] for axis in self.axes]

    def pose_in(self, report: StatusReport) -> ArmPose:
        """Pose that a report tells."""
        azimuth, elevation = (
            axis.angle(here)
            for axis, here in zip(self.axes, self.coordinates_in(report), strict=True)
        )
        return ArmPose(azimuth, elevation)

    def is_at(self, report: StatusReport, targets: Sequence[float]) -> bool:
        """Whether a report tells both axes within the tolerance of where they should be."""
        here = self.coordinates_in(report)
        return all(
            abs(at - target)
            <= max(self.tolerance_deg / abs(axis.degrees_per_unit), _ROUNDING_STEPS / axis.steps)
            for axis, at, target in zip(self.axes, here, targets, strict=True)
        )

    def travel_time(self, report: StatusReport, targets: Sequence[float]) -> float:
        """Time of a move from where a report tells the arm to be, seconds."""
        here = self.coordinates_in(report)
        offsets = [target - at for at, target in zip(here, targets, strict=True)]
        return travel_time(self.axes, offsets, self.feed)

    def move_line(self, targets: Sequence[float]) -> str:
        """The line that moves the arm, whatever was sent before.

        A jog, because a jog with any command of an output in it is refused: no altered byte can
        make the line that moves the arm light its lamp. Nor does a target beyond the travel, which
        a jog refuses, lock the controller.
        """
        words = (
            f"{axis.letter}{target:.3f}" for axis, target in zip(self.axes, targets, strict=True)
        )
        return f"$J=G21G90G53{''.join(words)}F{60 * self.feed:.0f}"


def read_mechanics(
    values: Mapping[int, float], *, build_options: str, settings: GrblSettings
) -> Mechanics:
    """The arm from its controller's settings and those of the rig.

    Parameters
    ----------
    values : mapping of int to float
        ``$n`` to value.
    build_options : str
        Codes of the firmware's build options.
    settings : GrblSettings

    Raises
    ------
    ControllerSettingsError
        They do not fit together.
    """
    azimuth = read_axis(
        values,
        name="azimuth",
        letter=settings.azimuth_axis,
        build_options=build_options,
        degrees_per_unit=settings.azimuth_deg_per_unit,
        degrees_at_switch=settings.azimuth_at_switch_deg,
    )
    elevation = read_axis(
        values,
        name="elevation",
        letter=settings.elevation_axis,
        build_options=build_options,
        degrees_per_unit=settings.elevation_deg_per_unit,
        degrees_at_switch=settings.elevation_at_switch_deg,
    )
    axes = (azimuth, elevation)
    if settings.feed_deg_per_s is None:
        feed = math.hypot(*(axis.max_rate for axis in axes))
    else:
        feed = settings.feed_deg_per_s / max(abs(axis.degrees_per_unit) for axis in axes)
    return Mechanics(
        axes=axes,
        limits=arm_limits(azimuth, elevation, settings),
        feed=feed,
        homing_s=homing_time(axes, values),
        tolerance_deg=settings.position_tolerance_deg,
    )
