"""A camera in memory behind the interface of the ``gphoto2`` module.

It stands in for the parts of libgphoto2 that need a camera: its tree of settings, its events, its
files and its errors. Constants, error codes and the exception are those of the real module.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import gphoto2
import numpy as np
from digital_negative import digital_negative

JPEG = b"\xff\xd8\xff\xe1 a picture for people"
FOLDER = "/store_00010001/DCIM/100TEST"
ROWS, COLS = 48, 64


def fail(code: int) -> None:
    raise gphoto2.GPhoto2Error(code)


@dataclass
class Setting:
    """One setting; ``takes`` changes what is written to it, as some cameras do."""

    value: str | int
    choices: tuple[str, ...] = ()
    readonly: bool = False
    takes: Callable[[str], str] | None = None

    @property
    def kind(self) -> int:
        if isinstance(self.value, int):
            return gphoto2.GP_WIDGET_TOGGLE
        return gphoto2.GP_WIDGET_RADIO if self.choices else gphoto2.GP_WIDGET_TEXT


def canon() -> dict[str, Setting]:
    times = ("bulb", "30", "10", "1", "0.3", "1/4", "1/10", "1/60", "1/250", "1/8000")
    return {
        "capturetarget": Setting("Memory card", ("Internal RAM", "Memory card")),
        "batterylevel": Setting("75%", readonly=True),
        "iso": Setting("Auto", ("Auto", "50", "100", "200", "6400")),
        "imageformat": Setting(
            "RAW + Large Fine JPEG", ("Large Fine JPEG", "RAW + Large Fine JPEG", "mRAW", "RAW")
        ),
        "autoexposuremode": Setting("Manual", ("P", "AV", "Manual"), readonly=True),
        "drivemode": Setting("Continuous", ("Single", "Continuous", "Timer 10 sec")),
        "aperture": Setting("5.6", ("4", "5.6", "8", "11")),
        "shutterspeed": Setting("1/60", times),
        "mirrorlock": Setting(0),
    }


def nikon() -> dict[str, Setting]:
    times = ("0.0002s", "0.0010s", "0.0166s", "0.1000s", "2.0000s", "Bulb", "Time")
    return {
        "capturetarget": Setting("Internal RAM", ("Internal RAM", "Memory card")),
        "batterylevel": Setting("100%", readonly=True),
        "iso": Setting("200", ("64", "100", "200")),
        "isoauto": Setting("On", ("Off", "On")),
        "imagequality": Setting("NEF+Basic", ("JPEG Basic", "NEF (Raw)", "NEF+Basic")),
        "rawcompression": Setting("Lossy", ("Lossless", "Lossy")),
        "expprogram": Setting("M", ("M", "P", "A"), readonly=True),
        "capturemode": Setting("Single Shot", ("Single Shot", "Burst", "Mirror Up")),
        "longexpnr": Setting("On", ("On", "Off")),
        "f-number": Setting("f/8", ("f/5.6", "f/8")),
        "shutterspeed": Setting("0.0166s", times),
    }


@dataclass
class Body:
    """The camera itself; tests reach into it to see what it did, and to make it fail."""

    settings: dict[str, Setting] = field(default_factory=canon)
    model: str = "Canon EOS Stand-in"
    files: dict[tuple[str, str], bytes] = field(default_factory=dict)
    events: list[tuple[float, int, object]] = field(default_factory=list)
    releases: int = 0
    is_open: bool = False
    claimed: bool = False
    unplugged: bool = False
    can_release: bool = True
    card_full: bool = False
    busy_until: float = 0.0
    delay_s: float = 0.02
    hangs_for: float = 0.0
    cut_downloads: int = 0
    suffix: str = "CR2"
    # What the sensor sees: level at one second.
    picture: Callable[[int, float], bytes] | None = None

    def seconds(self) -> float:
        from devices.gphoto2.exposure_times import parse_exposure_time

        return parse_exposure_time(str(self.settings["shutterspeed"].value)) or 0.0

    def add_file(self, data: bytes, *, suffix: str | None = None, after_s: float = 0.0) -> str:
        name = f"IMG_{len(self.files) + self.releases:04d}.{suffix or self.suffix}"
        self.files[FOLDER, name] = data
        path = Path(FOLDER, name)
        self.events.append((time.monotonic() + after_s, gphoto2.GP_EVENT_FILE_ADDED, path))
        return name

    def release(self) -> None:
        self.releases += 1
        exposed = self.seconds()
        data = (self.picture or raw_picture)(self.releases, exposed)
        changed = "PTP Property d101 changed"
        self.events.append((time.monotonic(), gphoto2.GP_EVENT_UNKNOWN, changed))
        self.add_file(data, after_s=exposed + self.delay_s)
        done = time.monotonic() + exposed + self.delay_s
        self.events.append((done, gphoto2.GP_EVENT_CAPTURE_COMPLETE, None))


def raw_picture(release: int, exposed_s: float) -> bytes:
    """A mosaic that tells which release it is of, and how long it was exposed."""
    image = np.full((ROWS, COLS), 64 + release, np.uint16)
    image[1:] += np.uint16(min(3000, 20_000 * exposed_s))
    return digital_negative(image)


@dataclass
class Path:
    folder: str
    name: str


class Widget:
    def __init__(self, name: str, setting: Setting | None, children: tuple[Widget, ...] = ()):
        self.name, self.setting, self.children = name, setting, children
        self.new = setting.value if setting else None

    def count_children(self) -> int:
        return len(self.children)

    def get_child(self, number: int) -> Widget:
        return self.children[number]

    def get_name(self) -> str:
        return self.name

    def get_type(self) -> int:
        return self.setting.kind if self.setting else gphoto2.GP_WIDGET_SECTION

    def get_readonly(self) -> bool:
        return self.setting.readonly

    def get_value(self) -> str | int:
        return self.new

    def set_value(self, value: str | int) -> None:
        if isinstance(value, int) != isinstance(self.setting.value, int):
            raise TypeError("wrong type for this widget")
        self.new = value

    def count_choices(self) -> int:
        return len(self.setting.choices)

    def get_choice(self, number: int) -> str:
        return self.setting.choices[number]


@dataclass
class FileInfo:
    size: int
    fields: int = gphoto2.GP_FILE_INFO_SIZE

    @property
    def file(self) -> FileInfo:
        return self


@dataclass
class File:
    data: bytes

    def get_data_and_size(self) -> memoryview:
        return memoryview(self.data)


class Module:
    """What the driver takes for the ``gphoto2`` module."""

    def __init__(self, *bodies: Body) -> None:
        self.bodies = bodies or (Body(),)
        self.log: Callable[..., None] | None = None
        module = self

        class Camera:
            @staticmethod
            def autodetect() -> Listing:
                plugged = [body for body in module.bodies if not body.unplugged]
                return Listing([(b.model, module.port_of(b)) for b in plugged])

            def set_port_info(self, port: str) -> None:
                self.port = port

            def set_abilities(self, abilities: Abilities) -> None:
                self.abilities = abilities

            def init(self) -> None:
                self.body = module.bodies[int(self.port[-3:]) - 1]
                if self.body.claimed:
                    fail(gphoto2.GP_ERROR_IO_USB_CLAIM)
                self.check()
                self.body.is_open = True

            def exit(self) -> None:
                self.body.is_open = False

            def check(self) -> None:
                if self.body.hangs_for:
                    time.sleep(self.body.hangs_for)
                if self.body.unplugged:
                    fail(gphoto2.GP_ERROR_IO_USB_FIND)

            def get_config(self) -> Widget:
                self.check()
                leaves = tuple(Widget(n, s) for n, s in self.body.settings.items())
                return Widget("main", None, (Widget("settings", None, leaves),))

            def get_single_config(self, name: str) -> Widget:
                self.check()
                if name not in self.body.settings:
                    fail(gphoto2.GP_ERROR_BAD_PARAMETERS)
                return Widget(name, self.body.settings[name])

            def set_single_config(self, name: str, widget: Widget) -> None:
                self.check()
                setting = self.body.settings[name]
                if setting.readonly:
                    fail(gphoto2.GP_ERROR_NOT_SUPPORTED)
                if setting.choices and widget.new not in setting.choices:
                    fail(gphoto2.GP_ERROR_BAD_PARAMETERS)
                setting.value = setting.takes(widget.new) if setting.takes else widget.new

            def trigger_capture(self) -> None:
                self.check()
                if time.monotonic() < self.body.busy_until:
                    fail(gphoto2.GP_ERROR_CAMERA_BUSY)
                if self.body.card_full:
                    fail(gphoto2.GP_ERROR_NO_SPACE)
                if self.body.settings.get("mirrorlock", Setting(0)).value:
                    if module.log is not None:
                        module.log(gphoto2.GP_LOG_ERROR, b"ptp2", b"mirror is up")
                    fail(gphoto2.GP_ERROR)
                self.body.release()

            def wait_for_event(self, milliseconds: int) -> tuple[int, object]:
                until = time.monotonic() + milliseconds / 1000
                while True:
                    self.check()
                    self.body.events.sort(key=lambda event: event[0])
                    if self.body.events and self.body.events[0][0] <= time.monotonic():
                        return self.body.events.pop(0)[1:]
                    if time.monotonic() >= until:
                        return gphoto2.GP_EVENT_TIMEOUT, None
                    time.sleep(0.002)

            def file_get_info(self, folder: str, name: str) -> FileInfo:
                self.check()
                return FileInfo(len(self.read(folder, name)))

            def file_get(self, folder: str, name: str, kind: int) -> File:
                self.check()
                assert kind == gphoto2.GP_FILE_TYPE_NORMAL
                data = self.read(folder, name)
                if self.body.cut_downloads:
                    self.body.cut_downloads -= 1
                    data = data[:-100]
                return File(data)

            def file_delete(self, folder: str, name: str) -> None:
                self.check()
                self.read(folder, name)
                del self.body.files[folder, name]

            def read(self, folder: str, name: str) -> bytes:
                if (folder, name) not in self.body.files:
                    fail(gphoto2.GP_ERROR_FILE_NOT_FOUND)
                return self.body.files[folder, name]

        self.Camera = Camera

    def __getattr__(self, name: str) -> object:
        if name.startswith("GP") or name == "gp_result_as_string":
            return getattr(gphoto2, name)
        raise AttributeError(name)

    def port_of(self, body: Body) -> str:
        return f"usb:001,{self.bodies.index(body) + 1:03d}"

    def gp_log_add_func(self, level: int, function: Callable[..., None]) -> object:
        self.log = function
        return object()

    def PortInfoList(self) -> Ports:  # noqa: N802
        return Ports()

    def CameraAbilitiesList(self) -> Models:  # noqa: N802
        return Models(self.bodies)


class Listing:
    def __init__(self, pairs: list[tuple[str, str]]) -> None:
        self.pairs = pairs

    def count(self) -> int:
        return len(self.pairs)

    def get_name(self, number: int) -> str:
        return self.pairs[number][0]

    def get_value(self, number: int) -> str:
        return self.pairs[number][1]


class Ports:
    def load(self) -> None: ...

    def lookup_path(self, path: str) -> str:
        return path

    def get_info(self, path: str) -> str:
        return path


@dataclass
class Abilities:
    operations: int


@dataclass
class Models:
    bodies: tuple[Body, ...]

    def load(self) -> None: ...

    def lookup_model(self, model: str) -> Body:
        return next(body for body in self.bodies if body.model == model)

    def get_abilities(self, body: Body) -> Abilities:
        return Abilities(gphoto2.GP_OPERATION_CAPTURE_IMAGE if body.can_release else 0)
