"""Whether a controller's own settings are fit for a rig: each fault with the line that mends it."""

from __future__ import annotations

import math
from collections.abc import Mapping

from devices.grbl.axes import Axis
from devices.grbl.codes import Setting
from devices.grbl.errors import ControllerSettingsError
from devices.grbl.settings import SPINDLE_OUTPUTS, GrblSettings
from devices.interfaces import ArmLimits

_MACHINE_POSITION = 1
_MOTORS_HOLD = 255
# Slack of an angle in comparisons.
_ROUNDING = 1e-9

NEEDED = (
    frozenset(Setting)
    - {Setting.STEPS_Z, Setting.MAX_RATE_Z, Setting.ACCELERATION_Z}
    - {
        Setting.TRAVEL_Z,
        Setting.ARC_TOLERANCE,
        Setting.PROBE_PIN_INVERT,
    }
)
"""Settings that a reading must hold to be whole."""


def check_fitness(values: Mapping[int, float], settings: GrblSettings) -> None:
    """Refuse a controller that could not keep the arm safe or tell where it is.

    Parameters
    ----------
    values : mapping of int to float
        ``$n`` to value, as read from the controller.
    settings : GrblSettings

    Raises
    ------
    ControllerSettingsError
        With every fault, and how to mend it.
    """
    faults = []
    if not values[Setting.HOMING]:
        faults.append("homing is off, so nobody knows where the arm stands: set $22=1")
    if not values[Setting.SOFT_LIMITS]:
        faults.append("soft limits are off: set $20=1 (after $22=1)")
    if values[Setting.REPORT_INCHES]:
        faults.append("positions are reported in inches: set $13=0")
    if not int(values[Setting.REPORT_OPTIONS]) & _MACHINE_POSITION:
        faults.append("machine positions are not reported: set $10=1")
    if settings.motors_hold and values[Setting.IDLE_DELAY_MS] != _MOTORS_HOLD:
        faults.append(
            "the motors let go when the arm stands, which could then sag: set $1=255 (or "
            "motors_hold = false in rig.toml, if the arm is balanced)"
        )
    if settings.lamp in SPINDLE_OUTPUTS:
        if values[Setting.LASER_MODE]:
            faults.append("laser mode couples the lamp to motion: set $32=0")
        if not values[Setting.SPINDLE_MAX] > 0:
            faults.append("the spindle output, which lights the lamp, has no range: set $30=1000")
    if faults:
        raise ControllerSettingsError(
            "the light arm's controller is not set up for this rig; " + "; ".join(faults)
        )


def arm_limits(azimuth: Axis, elevation: Axis, settings: GrblSettings) -> ArmLimits:
    """Limits of an arm: those asked for, or all that the controller allows.

    Raises
    ------
    ControllerSettingsError
        What is asked for reaches beyond what the controller allows.
    """
    return ArmLimits(
        azimuth=_axis_limits(azimuth, settings.azimuth_deg),
        elevation=_axis_limits(elevation, settings.elevation_deg),
    )


def _axis_limits(axis: Axis, asked: tuple[float, float] | None) -> tuple[float, float]:
    low, high = axis.limits
    if not low < high:
        raise ControllerSettingsError(
            f"the light arm's {axis.name} has no travel beyond its pull-off: raise "
            f"${Setting.TRAVEL_X + axis.number}, or lower $27"
        )
    if asked is None:
        return low, high
    least, largest = math.radians(asked[0]), math.radians(asked[1])
    if least < low - _ROUNDING or largest > high + _ROUNDING:
        raise ControllerSettingsError(
            f"rig.toml lets the {axis.name} go from {asked[0]:g}° to {asked[1]:g}°, and the "
            f"controller from {math.degrees(low):.2f}° to {math.degrees(high):.2f}°: set "
            f"${Setting.TRAVEL_X + axis.number} to the true travel, or correct the limits or the "
            f"angle at the switch in rig.toml"
        )
    return least, largest
