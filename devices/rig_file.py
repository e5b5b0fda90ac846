"""``rig.toml``: which driver fills each place of a rig, and how it is set.

A table for each device (``[camera]``, ``[projector]``, ``[arm]``, ``[mount]``) names its driver and
holds that driver's settings; ``[simulation]`` holds those of the scene that all devices with
``driver = "simulated"`` share. Real and simulated devices mix freely.
"""

from __future__ import annotations

import contextlib
import json
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, ValidationError

from devices.drivers import SIMULATED, DeviceKind, find_driver, names_of_drivers, nearest
from devices.errors import DeviceError, RigFileError
from devices.interfaces import Camera, CameraMount, LightArm, Projector
from devices.manual_mount import ManualMountSettings, nobody_confirms
from devices.rig import Rig
from devices.settings import DriverSettings
from devices.toml_lines import Key, key_lines, line_of

SIMULATION = "simulation"
# No rig needs more; what is larger, or endless, is something else, and could take minutes to read.
_LARGEST_BYTES = 1 << 15


class SimulatedDevice(DriverSettings):
    """A device's table where the simulated scene provides it."""

    driver: Literal["simulated"] = "simulated"


@dataclass(frozen=True)
class RigFile:
    """A rig as its file describes it; nothing is opened yet.

    Attributes
    ----------
    path : Path
    text : str
        The file as it is, for sessions.
    devices : dict
        Settings of each device that has a table, by kind.
    simulation : DriverSettings or None
        The scene that simulated devices share; None if there are none.
    """

    path: Path
    text: str
    devices: dict[DeviceKind, DriverSettings]
    simulation: DriverSettings | None = None

    def is_simulated(self, kind: DeviceKind) -> bool:
        """Whether a device is one of the simulated scene's."""
        return isinstance(self.devices.get(kind), SimulatedDevice)

    def open(
        self,
        *,
        confirm: Callable[[str], bool] = nobody_confirms,
        only: frozenset[DeviceKind] = frozenset(DeviceKind),
    ) -> Rig:
        """Open the rig's devices.

        The arm comes first, whose lamp goes out and whose motion stops with it, then the projector,
        and the camera last. If one fails, those before it are closed.

        Parameters
        ----------
        confirm : callable
            Asks the person at the desk to move the camera; true once that is done.
        only : frozenset of DeviceKind
            Devices to open; all by default.

        Returns
        -------
        Rig
            Without the devices that have no table; it says so when one is used.

        Raises
        ------
        DeviceError
            A device does not answer, or not as it should; the table is named.
        """
        wanted = {kind: s for kind, s in self.devices.items() if kind in only}
        with ExitStack() as opened:
            scene = None
            if any(self.is_simulated(kind) for kind in wanted):
                scene = self._open_scene()
                opened.callback(_close_quietly, scene)
            devices: dict[DeviceKind, Any] = {}
            # DeviceKind is in the order of opening.
            for kind in DeviceKind:
                if kind in wanted:
                    with _naming(self.path, kind):
                        devices[kind] = _open_device(kind, wanted[kind], scene, confirm)
                    if not isinstance(wanted[kind], SimulatedDevice | ManualMountSettings):
                        opened.callback(_close_quietly, devices[kind])
            if scene is not None:
                _close_unused(scene, {kind for kind in wanted if self.is_simulated(kind)})
            rig = self._rig_of(devices, scene)
            opened.pop_all()
        return rig

    def _open_scene(self) -> Rig:
        simulation = self.simulation
        assert simulation is not None
        with _naming(self.path, SIMULATION):
            rig: Rig = simulation.open_rig()  # type: ignore[attr-defined]
        return rig

    def _rig_of(self, devices: dict[DeviceKind, Any], scene: Rig | None) -> Rig:
        camera: Camera | None = devices.get(DeviceKind.CAMERA)
        projector: Projector | None = devices.get(DeviceKind.PROJECTOR)
        arm: LightArm | None = devices.get(DeviceKind.ARM)
        mount: CameraMount | None = devices.get(DeviceKind.MOUNT)
        simulated = scene is not None and self.is_simulated(DeviceKind.CAMERA)
        # What the camera sees is where the frames come from.
        source = scene.source if scene is not None and simulated else "rig"
        return Rig(camera, projector, arm, mount, toml=self.text, source=source)


def read_rig_file(path: Path) -> RigFile:
    """Read a ``rig.toml``.

    Parameters
    ----------
    path : Path

    Returns
    -------
    RigFile

    Raises
    ------
    RigFileError
        The file is missing or not TOML, or a table, driver or key is unknown, missing or wrong;
        every one is named, with its line.
    """
    path = Path(path)
    text = _read_text(path)
    try:
        content = tomllib.loads(text)
    except RecursionError:
        raise RigFileError(f"{path}: not the TOML of a rig (brackets in brackets)") from None
    except ValueError as error:
        raise RigFileError(f"{path}: not TOML ({error})") from None
    reading = _Reading(path, key_lines(text))
    devices: dict[DeviceKind, DriverSettings] = {}
    for name, table in content.items():
        if name in list(DeviceKind):
            kind = DeviceKind(name)
            settings = reading.device(kind, table)
            if settings is not None:
                devices[kind] = settings
        elif name != SIMULATION:
            known = [*DeviceKind, SIMULATION]
            reading.refuse((name,), f"unknown table{nearest(name, [str(k) for k in known])}")
    simulated = any(isinstance(settings, SimulatedDevice) for settings in devices.values())
    simulation = None
    if SIMULATION in content or simulated:
        simulation = reading.simulation(content.get(SIMULATION, {}))
    if not content:
        reading.refuse((), "the file describes no device; begin with a [camera] table")
    reading.finish()
    return RigFile(path, text, devices, simulation)


def _read_text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(_LARGEST_BYTES + 1)
    except OSError as error:
        raise RigFileError(f"{path}: {error.strerror}") from None
    if len(content) > _LARGEST_BYTES:
        raise RigFileError(
            f"{path} is larger than {_LARGEST_BYTES // 1024} KiB, which no description of a rig "
            "is; give the rig.toml"
        )
    try:
        # Some editors begin a text with a mark of its byte order.
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise RigFileError(f"{path}, line {line}: not text in UTF-8; save it as UTF-8") from None


class _Reading:
    """Gathers what is wrong with a file, so that all of it is said at once."""

    def __init__(self, path: Path, lines: dict[Key, int]) -> None:
        self._path = path
        self._lines = lines
        self._problems: list[str] = []

    def refuse(self, key: Key, problem: str) -> None:
        line = line_of(key, self._lines)
        where = f"{self._path}" if line is None else f"{self._path}, line {line}"
        dotted = ".".join(map(str, key))
        self._problems.append(": ".join(part for part in (where, dotted, problem) if part))

    def device(self, kind: DeviceKind, table: Any) -> DriverSettings | None:
        """Settings of a device's table; None once it has been refused."""
        known = names_of_drivers(kind)
        if not isinstance(table, dict):
            one = f"; a rig has one {kind}" if isinstance(table, list) else ""
            self.refuse((kind.value,), f"must be a table: write [{kind}]{one}")
            return None
        name = table.get("driver")
        driver = find_driver(kind, name) if isinstance(name, str) else None
        if name is None:
            self.refuse((kind.value,), f"driver is missing; known are {', '.join(sorted(known))}")
            return None
        if driver is None:
            self.refuse((kind.value, "driver"), f"there is no {name!r}{nearest(str(name), known)}")
            return None
        try:
            model = SimulatedDevice if name == SIMULATED else driver.settings_class()
        except ImportError as error:
            self.refuse((kind.value, "driver"), f"{name} cannot be loaded ({error})")
            return None
        return self._validate(model, table, kind.value)

    def simulation(self, table: Any) -> DriverSettings | None:
        """Settings of the simulated scene."""
        from devices.simulated.settings import SimulationSettings

        return self._validate(SimulationSettings, table, SIMULATION)

    def finish(self) -> None:
        """Refuse the file if anything is wrong with it."""
        if self._problems:
            raise RigFileError("\n".join(self._problems))

    def _validate(
        self, model: type[DriverSettings], table: Any, name: str
    ) -> DriverSettings | None:
        try:
            # Through JSON, whose strict types are those of TOML.
            # TOML's dates, which no setting is, become something that no setting takes.
            text = json.dumps(table, default=lambda date: {"date": str(date)})
            return model.model_validate_json(text, strict=True)
        except ValidationError as error:
            for problem in error.errors():
                location = _without_branches(problem["loc"], table)
                if problem["type"] == "extra_forbidden":
                    siblings = _keys_beside(model, location)
                    self.refuse(
                        (name, *location),
                        f"unknown key{nearest(str(location[-1]), siblings)}",
                    )
                else:
                    message = problem["msg"].removeprefix("Value error, ")
                    self.refuse((name, *location), _sentence(message))
            return None


def _sentence(message: str) -> str:
    return "is missing" if message == "Field required" else message


def _without_branches(location: Key, table: Any) -> Key:
    """A location less what pydantic adds for the branches of a union."""
    key: Key = ()
    inside = table
    for number, part in enumerate(location):
        there = (isinstance(inside, dict) and part in inside) or (
            isinstance(inside, list) and isinstance(part, int) and part < len(inside)
        )
        if there:
            inside = inside[part]
            key += (part,)
        elif number == len(location) - 1 and isinstance(inside, dict):
            key += (part,)
    return key


def _keys_beside(model: type[BaseModel], location: Key) -> list[str]:
    """Keys that may stand in the table that a location lies in."""
    for part in location[:-1]:
        if isinstance(part, str) and part in model.model_fields:
            inner = _model_within(model.model_fields[part].annotation)
            if inner is not None:
                model = inner
    return list(model.model_fields)


def _model_within(annotation: Any) -> type[BaseModel] | None:
    """The model that an annotation speaks of: itself, or inside a union, list or tuple."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = (_model_within(part) for part in get_args(annotation))
    return next((model for model in found if model is not None), None)


def _open_device(
    kind: DeviceKind, settings: DriverSettings, scene: Rig | None, confirm: Callable[[str], bool]
) -> Any:
    if isinstance(settings, SimulatedDevice):
        assert scene is not None
        return getattr(scene, kind.value)
    if isinstance(settings, ManualMountSettings):
        return settings.open(confirm=confirm)
    return settings.open()  # type: ignore[attr-defined]


def _close_unused(scene: Rig, used: set[DeviceKind]) -> None:
    """Close the devices of a simulated scene whose places real ones fill."""
    if scene.has_arm and DeviceKind.ARM not in used:
        _close_quietly(scene.arm)
    if scene.has_projector and DeviceKind.PROJECTOR not in used:
        _close_quietly(scene.projector)


@contextlib.contextmanager
def _naming(path: Path, table: str) -> Iterator[None]:
    """Say which table of which file an error is about."""
    try:
        yield
    except DeviceError as error:
        error.args = (f"[{table}] of {path}: {error}",)
        raise


def _close_quietly(device: Any) -> None:
    """Close on the way out of a failure, which is what is to be told."""
    with contextlib.suppress(DeviceError):
        device.close()
