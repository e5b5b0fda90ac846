"""The GenICam cameras that there are, and choosing one of them."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from typing import Any

from devices.aravis.gige_vision import connection_problem
from devices.aravis.library import FIREWALL_HINT, load_aravis, named_errors
from devices.discovery import Found
from devices.errors import DeviceError
from devices.usb_tree import USB3_VISION, find_usb_devices

_GIGE_VISION = "GigEVision"


@dataclass(frozen=True)
class Listed:
    """A camera as Aravis lists it.

    Attributes
    ----------
    identifier : str
        What it is opened by.
    serial, address, hardware_address : str
        Other names that it may be chosen by; the hardware address of a GigE camera is its MAC.
    model, protocol : str
    """

    identifier: str
    serial: str
    address: str
    hardware_address: str
    model: str
    protocol: str

    def is_called(self, name: str) -> bool:
        """Whether a name is one of this camera's."""
        names = (self.identifier, self.serial, self.address, self.hardware_address)
        return name.casefold() in (n.casefold() for n in names)

    def problem(self) -> str | None:
        """Why it cannot be controlled; None if nothing forbids it."""
        if self.protocol == _GIGE_VISION and _is_ipv4(self.address):
            return connection_problem(self.address)
        return None


def list_cameras(aravis: Any) -> list[Listed]:
    """Cameras that answer a search, which takes about a second."""
    aravis.update_device_list()
    return [
        Listed(
            identifier=aravis.get_device_id(number) or "",
            serial=aravis.get_device_serial_nbr(number) or "",
            address=aravis.get_device_address(number) or "",
            hardware_address=aravis.get_device_physical_id(number) or "",
            model=" ".join(
                filter(None, (aravis.get_device_vendor(number), aravis.get_device_model(number)))
            ),
            protocol=aravis.get_device_protocol(number) or "",
        )
        for number in range(aravis.get_n_devices())
    ]


def find_cameras() -> list[Found]:
    """Every camera with what is wrong with it, those that Aravis may not open included.

    Raises
    ------
    MissingPackageError
        Aravis is missing.
    """
    listed = list_cameras(load_aravis())
    found = [
        Found("aravis", camera.identifier, f"{camera.model} at {camera.address}", camera.problem())
        for camera in listed
    ]
    for device in find_usb_devices(USB3_VISION):
        problem = device.problem()
        # Aravis lists only what it may open.
        if problem is not None:
            found.append(Found("aravis", device.address, device.model, problem))
    return found


def open_camera(aravis: Any, wanted: str | None) -> Any:
    """Open the camera that is wanted, and control it.

    Parameters
    ----------
    aravis : module
    wanted : str or None
        One of its names; may be left out if there is just one. An IP address needs no search, and
        finds cameras that no search reaches.

    Returns
    -------
    Aravis.Camera

    Raises
    ------
    DeviceError
        There is none, there are several, or another program controls it.
    """
    if wanted is not None and _is_ipv4(wanted):
        identifier, problem = wanted, connection_problem(wanted)
    else:
        chosen = _choose(list_cameras(aravis), wanted)
        identifier, problem = chosen.identifier, chosen.problem()
    if problem is not None:
        raise DeviceError(f"{identifier}: {problem}")
    with named_errors(f"{identifier} cannot be opened"):
        camera = aravis.Camera.new(identifier)
    device = camera.get_device()
    if hasattr(device, "is_controller") and not device.is_controller():
        raise DeviceError(f"{identifier}: another program controls it; close that one")
    return camera


def _choose(listed: list[Listed], wanted: str | None) -> Listed:
    there = ", ".join(camera.identifier for camera in listed) or "none"
    chosen = [camera for camera in listed if wanted is None or camera.is_called(wanted)]
    if len(chosen) > 1:
        raise DeviceError(f"several GenICam cameras ({there}); name one in rig.toml: camera = ...")
    if not chosen:
        called = f" called {wanted}" if wanted else ""
        raise DeviceError(
            f"no GenICam camera{called} answers (found: {there}); {FIREWALL_HINT}, or look for "
            "others with impasto devices"
        )
    return chosen[0]


def _is_ipv4(text: str) -> bool:
    try:
        ipaddress.IPv4Address(text)
    except ValueError:
        return False
    return True
