"""What can go wrong with an arm on a GRBL controller, each under its own name."""

from __future__ import annotations

from devices.errors import DeviceError
from devices.grbl.codes import ALARMS, REFUSALS


class NotGrblError(DeviceError):
    """Something answers on the port, but not as GRBL 1.1 does."""


class ControllerSettingsError(DeviceError):
    """The controller's own settings are not fit for the rig; the message says how to mend them."""


class AlarmError(DeviceError):
    """The controller stopped with an alarm.

    Attributes
    ----------
    code : int or None
        Number of the alarm; None if only the state was seen.
    """

    def __init__(self, code: int | None, doing: str) -> None:
        self.code = code
        meaning = ALARMS.get(code) if code is not None else None
        number = "an alarm" if code is None else f"alarm {code}"
        what = f" ({meaning.name}): {meaning.remedy}" if meaning else ": home the arm again"
        super().__init__(f"the light arm stopped with {number} while {doing}{what}")


class RefusedError(DeviceError):
    """The controller refused a line.

    Attributes
    ----------
    code : int
        Number of the error.
    """

    def __init__(self, code: int, doing: str) -> None:
        self.code = code
        meaning = REFUSALS.get(code)
        what = f" ({meaning.name}): {meaning.remedy}" if meaning else ""
        super().__init__(f"the light arm's controller refused, error {code}, while {doing}{what}")


class DoorOpenError(DeviceError):
    """The safety door is open, or was opened."""


class ArmResetError(DeviceError):
    """The controller started anew without being asked to; it no longer knows where it stands."""


class PositionUntrustedError(DeviceError):
    """Nobody knows where the arm stands until it is homed."""


class LampError(DeviceError):
    """The lamp is not as it was told to be."""


class StopFailedError(DeviceError):
    """Nothing confirmed that the arm stands still with its lamp out: cut its power."""
