"""Probing the devices of a rig: each is opened, asked what it is, and made to show that it works.

Nothing moves and nothing is lit: the camera takes one frame, the projector is blanked, the arm says
where it stands. Each is probed in a process of its own (:mod:`devices.child_process`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from devices.child_process import call_all
from devices.drivers import DeviceKind
from devices.errors import DeviceError
from devices.interfaces import Camera, CameraMount, LightArm, Projector
from devices.rig import Rig
from devices.rig_file import RigFile

# Exposure of the frame that a camera is made to take.
_EXPOSURE_S = 0.01


@dataclass(frozen=True)
class Probe:
    """What became of probing one device.

    Attributes
    ----------
    kind : DeviceKind
    driver : str
    model : str
        What it says it is; empty if it did not answer.
    detail : str
        What it can do, for people.
    problem : str or None
        What is wrong with it; None if it answers as it should.
    """

    kind: DeviceKind
    driver: str
    model: str = ""
    detail: str = ""
    problem: str | None = None


def probe(
    rig_file: RigFile,
    *,
    limit_s: float = 60.0,
    begin: Callable[[str], None] = lambda device: None,
) -> Iterator[Probe]:
    """Probe every device that a rig's file names, one after the other.

    Parameters
    ----------
    rig_file : RigFile
    limit_s : float
        How long each may take; one that hangs is given up and the next one tried.
    begin : callable, optional
        Called with the name of each device before it is probed.

    Yields
    ------
    Probe
        One per device, in the order in which a rig opens them.
    """
    simulated = tuple(kind for kind in rig_file.devices if rig_file.is_simulated(kind))
    done: dict[DeviceKind, Probe] = {}
    for kind in DeviceKind:
        if kind not in rig_file.devices:
            continue
        begin(kind.value)
        if kind not in done:
            # Simulated devices share their scene, which takes its time to be made.
            together = simulated if kind in simulated else (kind,)
            done |= _probe_together(rig_file, together, limit_s)
        yield done[kind]


def _probe_together(
    rig_file: RigFile, kinds: tuple[DeviceKind, ...], limit_s: float
) -> dict[DeviceKind, Probe]:
    """Probe some devices in a process of their own."""
    (answer,) = call_all({"probe": (_probe_devices, (rig_file, kinds))}, limit_s=limit_s)
    if answer.error is None:
        return {probed.kind: probed for probed in answer.value}
    problem = str(answer.error)
    return {kind: Probe(kind, _driver_of(rig_file, kind), problem=problem) for kind in kinds}


def _probe_devices(rig_file: RigFile, kinds: tuple[DeviceKind, ...]) -> list[Probe]:
    probes = []
    with rig_file.open(only=frozenset(kinds)) as rig:
        for kind in kinds:
            driver = _driver_of(rig_file, kind)
            try:
                probes.append(Probe(kind, driver, *_PROBES[kind](rig)))
            except DeviceError as error:
                probes.append(Probe(kind, driver, problem=str(error)))
    return probes


def _driver_of(rig_file: RigFile, kind: DeviceKind) -> str:
    name: str = rig_file.devices[kind].driver  # type: ignore[attr-defined]
    return name


def _probe_camera(rig: Rig) -> tuple[str, str]:
    camera: Camera = rig.camera
    can = camera.capabilities
    low, high = can.exposure_range_s
    rig.capture(min(max(_EXPOSURE_S, low), high))
    colour = f"{can.bayer} mosaic" if can.bayer is not None else "monochrome"
    return can.model, (
        f"{can.width}×{can.height}, {colour}, saturates at {can.saturation_level}, "
        f"{low:g} to {high:g} s"
    )


def _probe_projector(rig: Rig) -> tuple[str, str]:
    projector: Projector = rig.projector
    can = projector.capabilities
    projector.blank()
    return can.model, f"{can.width}×{can.height}, {1 / can.frame_period_s:.3g} pictures a second"


def _probe_arm(rig: Rig) -> tuple[str, str]:
    arm: LightArm = rig.arm
    can = arm.capabilities
    ranges = (
        f"{name} {math.degrees(low):.4g}° to {math.degrees(high):.4g}°"
        for name, (low, high) in (
            ("azimuth", can.limits.azimuth),
            ("elevation", can.limits.elevation),
        )
    )
    where = "position unknown until homed" if arm.pose is None else f"at {arm.pose}"
    return can.model, f"{', '.join(ranges)}, {where}"


def _probe_mount(rig: Rig) -> tuple[str, str]:
    mount: CameraMount = rig.mount
    return "camera positions", f"{', '.join(mount.positions)}; now at {mount.position}"


_PROBES = {
    DeviceKind.CAMERA: _probe_camera,
    DeviceKind.PROJECTOR: _probe_projector,
    DeviceKind.ARM: _probe_arm,
    DeviceKind.MOUNT: _probe_mount,
}
