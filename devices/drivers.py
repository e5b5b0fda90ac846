"""The drivers there are, by the names that ``rig.toml`` knows them by.

A driver's module is imported when a rig names it or a search tries it, never before: nobody pays
for, or fails on, hardware that is not theirs.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from devices.discovery import Found
from devices.settings import DriverSettings


class DeviceKind(StrEnum):
    """What a device is; also the name of its table in ``rig.toml``."""

    ARM = "arm"
    PROJECTOR = "projector"
    MOUNT = "mount"
    CAMERA = "camera"


@dataclass(frozen=True)
class Driver:
    """A driver, and where its settings are.

    Attributes
    ----------
    name : str
        As in ``rig.toml``.
    kind : DeviceKind
    module : str
        Module that holds its settings and, where devices can be searched for, ``find``.
    settings : str
        Name of the :class:`~devices.settings.DriverSettings` in that module.
    searched : bool
        Whether the module has ``find() -> list[Found]``.
    """

    name: str
    kind: DeviceKind
    module: str
    settings: str
    searched: bool = True

    def settings_class(self) -> type[DriverSettings]:
        """The driver's settings.

        Raises
        ------
        ImportError
            The driver is not part of this installation.
        """
        found: type[DriverSettings] = getattr(importlib.import_module(self.module), self.settings)
        return found

    def find(self) -> list[Found]:
        """Look for the driver's devices.

        Raises
        ------
        DeviceError
            A package is missing, or the system cannot be searched.
        """
        search: Callable[[], list[Found]] = importlib.import_module(self.module).find
        return search()


SIMULATED = "simulated"

DRIVERS = (
    Driver("grbl", DeviceKind.ARM, "devices.grbl.settings", "GrblSettings"),
    Driver("dlpc350", DeviceKind.PROJECTOR, "devices.dlpc350.settings", "Dlpc350Settings"),
    Driver("hdmi", DeviceKind.PROJECTOR, "devices.hdmi.settings", "HdmiSettings"),
    Driver("aravis", DeviceKind.CAMERA, "devices.aravis.settings", "AravisSettings"),
    Driver("gphoto2", DeviceKind.CAMERA, "devices.gphoto2.settings", "Gphoto2Settings"),
    Driver("opencv", DeviceKind.CAMERA, "devices.opencv.settings", "OpencvSettings"),
    Driver("manual", DeviceKind.MOUNT, "devices.manual_mount", "ManualMountSettings", False),
    *(Driver(SIMULATED, kind, "devices.rig_file", "SimulatedDevice", False) for kind in DeviceKind),
)


def find_driver(kind: DeviceKind, name: str) -> Driver | None:
    """The driver of a name; None if there is none."""
    return next((d for d in DRIVERS if d.kind == kind and d.name == name), None)


def names_of_drivers(kind: DeviceKind) -> list[str]:
    """Names of the drivers for one kind of device."""
    return [driver.name for driver in DRIVERS if driver.kind == kind]


def nearest(name: str, known: list[str]) -> str:
    """``"; did you mean …?"`` if a known name is near, else what is known."""
    close = difflib.get_close_matches(name, known, n=1)
    if close:
        return f"; did you mean {close[0]}?"
    return f"; known are {', '.join(sorted(known))}" if known else ""
