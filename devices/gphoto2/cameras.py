"""The tethered cameras that there are, and choosing one of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from devices.discovery import Found
from devices.errors import DeviceError
from devices.gphoto2.library import CameraErrors
from devices.usb_tree import STILL_IMAGE, find_usb_devices


@dataclass(frozen=True)
class Listed:
    """A camera as libgphoto2 lists it."""

    model: str
    port: str


def list_cameras(gphoto2: Any, errors: CameraErrors) -> list[Listed]:
    """Cameras that are plugged in."""
    with errors.named("cameras cannot be listed"):
        cameras = gphoto2.Camera.autodetect()
        return [
            Listed(cameras.get_name(number), cameras.get_value(number))
            for number in range(cameras.count())
        ]


def find_cameras(gphoto2: Any) -> list[Found]:
    """Every camera with what is wrong with it, those that libgphoto2 does not know included.

    Each is opened for a moment, which shows whether another program has claimed it.
    """
    errors = CameraErrors(gphoto2)
    listed = list_cameras(gphoto2, errors)
    found = []
    forbidden = {device.address: device.problem() for device in find_usb_devices(STILL_IMAGE)}
    for camera in listed:
        problem = forbidden.get(camera.port) or _problem(gphoto2, errors, camera)
        found.append(Found("gphoto2", camera.port, camera.model, problem))
    ports = {camera.port for camera in listed}
    for device in find_usb_devices(STILL_IMAGE):
        if device.address not in ports:
            problem = device.problem() or "libgphoto2 does not know this camera; update gphoto2"
            found.append(Found("gphoto2", device.address, device.model, problem))
    return found


def choose_camera(listed: list[Listed], wanted: str | None) -> Listed:
    """The camera that is wanted.

    Raises
    ------
    DeviceError
        There is none, or several.
    """
    there = ", ".join(f"{camera.model} at {camera.port}" for camera in listed) or "none"
    chosen = [
        camera
        for camera in listed
        if wanted is None or wanted.casefold() in (camera.model.casefold(), camera.port.casefold())
    ]
    if len(chosen) > 1:
        raise DeviceError(f"several cameras ({there}); name one in rig.toml: camera = ...")
    if not chosen:
        called = f" called {wanted}" if wanted else ""
        raise DeviceError(
            f"no camera{called} is plugged in (found: {there}); switch it on, set its USB mode to "
            "PTP or PC remote, and look at its cable"
        )
    return chosen[0]


def open_camera(gphoto2: Any, errors: CameraErrors, listed: Listed) -> Any:
    """Open a camera that was listed.

    Returns
    -------
    gphoto2.Camera

    Raises
    ------
    DeviceError
        Another program has claimed it, it may not be opened, or it cannot be released from a
        computer.
    """
    for device in find_usb_devices(STILL_IMAGE):
        problem = device.problem() if device.address == listed.port else None
        if problem is not None:
            raise DeviceError(f"{listed.model}: {problem}")
    with errors.named(f"{listed.model} at {listed.port} cannot be opened"):
        camera = gphoto2.Camera()
        ports = gphoto2.PortInfoList()
        ports.load()
        camera.set_port_info(ports.get_info(ports.lookup_path(listed.port)))
        models = gphoto2.CameraAbilitiesList()
        models.load()
        abilities = models.get_abilities(models.lookup_model(listed.model))
        camera.set_abilities(abilities)
        releases = gphoto2.GP_OPERATION_CAPTURE_IMAGE | gphoto2.GP_OPERATION_TRIGGER_CAPTURE
        if not abilities.operations & releases:
            raise DeviceError(
                f"{listed.model} cannot be released from a computer; set its USB mode to PTP or PC "
                "remote, or use another camera"
            )
        camera.init()
    return camera


def _problem(gphoto2: Any, errors: CameraErrors, camera: Listed) -> str | None:
    try:
        opened = open_camera(gphoto2, errors, camera)
        with errors.named(f"{camera.model} cannot be closed"):
            opened.exit()
    except DeviceError as error:
        return str(error)
    return None
