"""Devices on this computer's USB as Linux lists them: who they are, and whether we may open them.

A camera without permission does not even appear in the lists of the camera libraries; the kernel
lists it all the same. Layout: ``Documentation/ABI/stable/sysfs-bus-usb`` of the Linux kernel;
classes: defined class codes of the USB Implementers Forum.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_SYSFS = Path("/sys/bus/usb/devices")
_NODES = Path("/dev/bus/usb")


@dataclass(frozen=True)
class UsbClass:
    """Class and subclass of an interface."""

    number: int
    subclass: int


STILL_IMAGE = UsbClass(0x06, 0x01)
"""Cameras that speak PTP."""

USB3_VISION = UsbClass(0xEF, 0x05)
"""Cameras that speak USB3 Vision."""


@dataclass(frozen=True)
class UsbDevice:
    """A device that has an interface of some class.

    Attributes
    ----------
    bus, number : int
        As ``lsusb`` gives them.
    model : str
        Manufacturer and product, as far as the device tells.
    node : Path
        Its device file.
    """

    bus: int
    number: int
    model: str
    node: Path

    @property
    def address(self) -> str:
        """``usb:bus,device``, as libgphoto2 writes it."""
        return f"usb:{self.bus:03d},{self.number:03d}"

    def problem(self) -> str | None:
        """Why this user cannot open it, and what to do; None if nothing forbids it."""
        if os.access(self.node, os.R_OK | os.W_OK):
            return None
        return (
            f"no permission for {self.node}; install the udev rules of the camera's library or add "
            'a rule with TAG+="uaccess", then plug the camera in again'
        )


def find_usb_devices(
    wanted: UsbClass, *, sysfs: Path = _SYSFS, nodes: Path = _NODES
) -> list[UsbDevice]:
    """Devices that have an interface of a class.

    Parameters
    ----------
    wanted : UsbClass
    sysfs, nodes : Path
        Where the kernel lists devices, and their device files.

    Returns
    -------
    list of UsbDevice
        Empty where there is no USB.
    """
    found: dict[tuple[int, int], UsbDevice] = {}
    for device in _devices_with(wanted, sysfs):
        try:
            bus, number = int(_read(device / "busnum")), int(_read(device / "devnum"))
        except ValueError:
            continue  # unplugged while we looked
        names = (_read(device / name) for name in ("manufacturer", "product"))
        node = nodes / f"{bus:03d}" / f"{number:03d}"
        found[bus, number] = UsbDevice(bus, number, " ".join(filter(None, names)), node)
    return [found[key] for key in sorted(found)]


def _devices_with(wanted: UsbClass, sysfs: Path) -> Iterator[Path]:
    for interface in sorted(sysfs.glob("*:*")):
        try:
            number = int(_read(interface / "bInterfaceClass"), 16)
            subclass = int(_read(interface / "bInterfaceSubClass"), 16)
        except ValueError:
            continue
        if UsbClass(number, subclass) == wanted:
            # "3-1.2:1.0" is an interface of device "3-1.2".
            yield sysfs / interface.name.partition(":")[0]


def _read(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
