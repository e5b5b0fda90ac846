"""Settings of a light arm on a GRBL controller, and the search for such controllers."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field, model_validator

from devices.discovery import Found
from devices.settings import Address, DriverSettings

if TYPE_CHECKING:
    from devices.interfaces import LightArm

_PROBE_BAUD_RATE = 115_200
_PROBE_BOOT_S = 4.0


class LampOutput(StrEnum):
    """Output of the controller that the lamp hangs on."""

    SPINDLE = "spindle"
    SPINDLE_REVERSE = "spindle reverse"
    FLOOD = "flood"
    MIST = "mist"


SPINDLE_OUTPUTS = (LampOutput.SPINDLE, LampOutput.SPINDLE_REVERSE)
"""Outputs whose power can be set."""

Degrees = Annotated[float, Field(ge=-3600, le=3600)]
Seconds = Annotated[float, Field(gt=0, le=3600)]


class GrblSettings(DriverSettings):
    """The ``[arm]`` table of a ``rig.toml`` for an arm on a GRBL 1.1 controller.

    Attributes
    ----------
    port : str
        Serial port. A name under ``/dev/serial/by-id`` outlives replugging.
    baud_rate : int
    azimuth_deg, elevation_deg : (float, float), optional
        Least and largest angle that the arm may take; by default, all that the controller's soft
        limits leave, clear of the end switches by the pull-off distance.
    azimuth_axis, elevation_axis : str
        Letters of the controller's axes.
    azimuth_at_switch_deg, elevation_at_switch_deg : float
        Angle of each axis where its end switch closes.
    azimuth_deg_per_unit, elevation_deg_per_unit : float
        Degrees per unit ("mm") of the controller; negative where the angle falls as the
        controller's coordinate rises. With steps per degree in ``$100`` and ``$101``, 1.
    feed_deg_per_s : float, optional
        No axis goes faster than this in a move; by default, as fast as the controller lets it.
    lamp : LampOutput
        Output that the lamp hangs on.
    lamp_power : float
        Share of full power on the spindle output, 0 to 1; the other outputs only switch.
    lamp_settle_s : float
        Time after which a lamp just lit is constant.
    position_tolerance_deg : float
        How far from its target a move may end.
    motors_hold : bool
        Require the motors to hold while still (``$1=255``). Only a balanced arm may do without.
    boot_timeout_s, reply_timeout_s, lamp_timeout_s : float
        How long the controller may take to start, to answer, and to switch its output.
    move_margin : float
        A move may take this many times the time computed from distance, feed and acceleration,
        and one reply time-out more; homing likewise.
    """

    driver: Literal["grbl"] = "grbl"
    port: Address
    baud_rate: Annotated[int, Field(gt=0)] = 115_200
    azimuth_deg: tuple[Degrees, Degrees] | None = None
    elevation_deg: tuple[Degrees, Degrees] | None = None
    azimuth_axis: Literal["X", "Y", "Z"] = "X"
    elevation_axis: Literal["X", "Y", "Z"] = "Y"
    azimuth_at_switch_deg: Degrees = 0.0
    elevation_at_switch_deg: Degrees = 0.0
    azimuth_deg_per_unit: Degrees = 1.0
    elevation_deg_per_unit: Degrees = 1.0
    feed_deg_per_s: Annotated[float, Field(gt=0)] | None = None
    lamp: LampOutput = LampOutput.SPINDLE
    lamp_power: Annotated[float, Field(gt=0, le=1)] = 1.0
    lamp_settle_s: Annotated[float, Field(ge=0, le=600)] = 0.0
    position_tolerance_deg: Annotated[float, Field(gt=0, le=5)] = 0.05
    motors_hold: bool = True
    boot_timeout_s: Seconds = 6.0
    reply_timeout_s: Seconds = 2.0
    lamp_timeout_s: Seconds = 3.0
    move_margin: Annotated[float, Field(ge=1, le=20)] = 1.5

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.azimuth_axis == self.elevation_axis:
            raise ValueError("azimuth_axis and elevation_axis name the same axis")
        for name in ("azimuth_deg", "elevation_deg"):
            limits = getattr(self, name)
            if limits is not None and not limits[0] < limits[1]:
                raise ValueError(f"{name} must rise from the least to the largest angle")
        if 0 in (self.azimuth_deg_per_unit, self.elevation_deg_per_unit):
            raise ValueError("degrees per unit must not be zero")
        return self

    def open(self) -> LightArm:
        """Connect to the controller; its position is not trusted until the arm is homed.

        Raises
        ------
        DeviceError
            The port cannot be opened, nothing answers there as GRBL 1.1, or the controller's
            settings are not fit for the rig.
        """
        from devices.grbl.light_arm import GrblLightArm

        return GrblLightArm(self)


def find(ports: Iterable[str] | None = None) -> list[Found]:
    """Look for GRBL controllers on serial ports.

    Each port is opened, which starts many boards anew, and asked for its status, which nothing but
    GRBL understands and which moves nothing.

    Parameters
    ----------
    ports : iterable of str, optional
        Ports to look at; by default, all that the system lists with hardware behind them.

    Returns
    -------
    list of Found
        One per port, with what is wrong where no GRBL 1.1 answers.
    """
    addresses = _listed_ports() if ports is None else list(ports)
    if not addresses:
        return []
    with ThreadPoolExecutor(max_workers=len(addresses)) as pool:
        return list(pool.map(_probe, addresses))


def _listed_ports() -> list[str]:
    """Serial ports with hardware behind them."""
    from devices.optional_packages import import_optional

    import_optional("serial", needed_by="the light arm", install=".venv/bin/pip install pyserial")
    from serial.tools.list_ports import comports

    # Built-in ports that do not exist are listed all the same, without hardware.
    return sorted(port.device for port in comports() if port.hwid not in (None, "", "n/a"))


def _probe(address: str) -> Found:
    from devices.errors import DeviceError
    from devices.grbl.greeting import greet
    from devices.grbl.serial_line import SerialLine, open_serial_port

    try:
        line = SerialLine(open_serial_port(address, _PROBE_BAUD_RATE), name=address)
    except DeviceError as error:
        return Found("grbl", address, "", str(error))
    try:
        model = greet(line, name=address, boot_timeout_s=_PROBE_BOOT_S, may_reset=False)
        return Found("grbl", address, model)
    except DeviceError as error:
        return Found("grbl", address, "", str(error))
    finally:
        line.close()
