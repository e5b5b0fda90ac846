from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from devices.drivers import DRIVERS, DeviceKind, Driver, find_driver
from devices.errors import DeviceError, DeviceLostError, RigFileError
from devices.interfaces import Projection
from devices.manual_mount import ManualMount
from devices.rig_file import read_rig_file
from devices.toml_lines import key_lines, line_of

RIGS = Path(__file__).parents[2] / "fixtures" / "rigs"
SMALL = '[simulation]\npainting = "white"\ncamera_width = 48\n'

# What a driver of this file's own did, in order.
EVENTS: list[str] = []

SPYING = """
from typing import Literal
from devices.errors import DeviceLostError
from devices.settings import DriverSettings
from tests_rig_file_events import EVENTS

class Device:
    lamp_on, pose = False, None
    def switch_lamp(self, on):
        return 0.0
    def __init__(self, name):
        self.name = name
        EVENTS.append(f"open {name}")
    def __getattr__(self, name):
        return lambda *args, **options: None
    def close(self):
        EVENTS.append(f"close {self.name}")
        if self.name.startswith("stubborn"):
            raise DeviceLostError("gone already")

class SpySettings(DriverSettings):
    driver: Literal["spy"]
    name: str = "device"
    fails: bool = False
    nested: "Nested | None" = None
    def open(self):
        if self.fails:
            raise DeviceLostError(f"{self.name} does not answer")
        return Device(self.name)

class Nested(DriverSettings):
    depth: int

SpySettings.model_rebuild()
"""


@pytest.fixture
def spies(monkeypatch, tmp_path):
    """A driver ``spy`` for every kind of device, and what was done with its devices."""
    import types

    EVENTS.clear()
    events = types.ModuleType("tests_rig_file_events")
    events.EVENTS = EVENTS
    monkeypatch.setitem(sys.modules, "tests_rig_file_events", events)
    module = types.ModuleType("tests_rig_file_spies")
    monkeypatch.setitem(sys.modules, "tests_rig_file_spies", module)
    exec(SPYING, module.__dict__)
    spying = tuple(
        Driver("spy", kind, "tests_rig_file_spies", "SpySettings") for kind in DeviceKind
    )
    monkeypatch.setattr("devices.drivers.DRIVERS", (*DRIVERS, *spying))
    return EVENTS


@pytest.fixture
def write(tmp_path):
    def write(text):
        file = tmp_path / "rig.toml"
        file.write_bytes(text.encode())
        return file

    return write


def test_a_simulated_rig_opens_as_one_scene_and_carries_its_text():
    with read_rig_file(RIGS / "simulated.toml").open() as rig:
        assert rig.source == "simulation"
        assert rig.toml == (RIGS / "simulated.toml").read_bytes().decode()
        assert rig.camera_positions == ("front", "left", "right", "above")
        width, height = rig.projector.capabilities.size
        assert rig.camera.capabilities.size == (400, 300)
        rig.show(Projection("white", np.full((height, width), 255, np.uint8)))
        lit = rig.capture(0.02).image
        rig.blank()
        dark = rig.capture(0.02).image
        assert lit.mean() > 3 * dark.mean()
        rig.arm.home()
        rig.switch_lamp(True)
        assert rig.capture(0.02).image.mean() > 1.2 * dark.mean()


@pytest.mark.parametrize("name", [file.name for file in RIGS.glob("*.toml")])
def test_the_examples_are_valid(name):
    path = RIGS / name
    named = tomllib.loads(path.read_text())
    drivers = [find_driver(DeviceKind(k), t["driver"]) for k, t in named.items() if "driver" in t]
    for driver in drivers:
        assert driver is not None
    assert set(read_rig_file(path).devices) == {d.kind for d in drivers}


def test_a_real_arm_and_a_simulated_camera_mix(write, spies):
    text = f'[camera]\ndriver = "simulated"\n[arm]\ndriver = "spy"\nname = "arm"\n{SMALL}'
    with read_rig_file(write(text)).open() as rig:
        assert rig.source == "simulation"
        assert rig.capture(0.01).image.shape == (36, 48)
        assert rig.arm.name == "arm"
        assert not rig.has_projector
        with pytest.raises(DeviceError, match=r"no projector; add a \[projector\] table"):
            rig.show(Projection("black", np.zeros((8, 8), np.uint8)))
    assert spies == ["open arm", "close arm"]


def test_a_rig_without_a_camera_does_what_it_can(write, spies):
    with read_rig_file(write('[arm]\ndriver = "spy"\n')).open() as rig:
        assert rig.source == "rig"
        rig.move_light(None)
        with pytest.raises(DeviceError, match=r"no camera; add a \[camera\] table"):
            rig.capture(0.01)


def test_devices_open_with_the_lamp_first_and_the_camera_last(write, spies):
    text = "".join(f'[{k}]\ndriver = "spy"\nname = "{k}"\n' for k in ("camera", "projector", "arm"))
    read_rig_file(write(text)).open().close()
    assert spies[:3] == ["open arm", "open projector", "open camera"]
    assert sorted(spies[3:]) == ["close arm", "close camera", "close projector"]


@pytest.mark.parametrize("name", ["arm", "stubborn arm"])
def test_if_one_device_fails_those_before_it_are_closed(write, spies, name):
    text = (
        f'[arm]\ndriver = "spy"\nname = "{name}"\n'
        '[projector]\ndriver = "spy"\nname = "projector"\n'
        '[camera]\ndriver = "spy"\nfails = true\n'
    )
    rig_file = read_rig_file(write(text))
    with pytest.raises(DeviceLostError, match=r"\[camera\] of .*rig\.toml: device does not answer"):
        rig_file.open()
    assert spies == [f"open {name}", "open projector", "close projector", f"close {name}"]


def test_a_camera_moved_by_hand_is_moved_when_somebody_says_so(write):
    text = '[mount]\ndriver = "manual"\npositions = ["front", "left"]\n'
    questions, answers = [], [False, True]

    def confirm(question):
        questions.append(question)
        return answers.pop(0)

    with read_rig_file(write(text)).open(confirm=confirm) as rig:
        assert rig.camera_positions == ("front", "left")
        rig.place_camera("front")
        assert questions == []
        with pytest.raises(DeviceError, match="nobody confirmed that the camera stands at left"):
            rig.place_camera("left")
        assert rig.subject.camera_position == "front"
        rig.place_camera("left")
        assert rig.subject.camera_position == "left"
        assert questions == ["Move the camera from front to left."] * 2
        with pytest.raises(DeviceError, match=r"no camera position 'top'; rig.toml names front"):
            rig.place_camera("top")
    with pytest.raises(DeviceError, match="nobody confirmed"):
        ManualMount(("front", "left")).place("left")


CAMERA = '[camera]\ndriver = "spy"\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("camera = 3", r"rig.toml, line 1: camera: must be a table: write \[camera\]"),
        ("[camera]\n", "line 1: camera: driver is missing; known are aravis"),
        ('[camera]\ndriver = "aravs"', "line 2: camera.driver: there is no 'aravs'; did you mean"),
        ("[camera]\ndriver = 7", "line 2: camera.driver: there is no 7; known are"),
        ('[camera]\ndriver = "grbl"', "camera.driver: there is no 'grbl'; known are aravis, gph"),
        (f"{CAMERA}\nnmae = 'x'", "line 4: camera.nmae: unknown key; did you mean name"),
        (f"{CAMERA}fails = 1", "line 3: camera.fails: Input should be a valid boolean"),
        (
            f"{CAMERA}name = 2024-05-01T00:00:00",
            "line 3: camera.name: Input should be a",
        ),
        (f"{CAMERA}[camera.nested]\n", "line 3: camera.nested.depth: is missing"),
        (f"{CAMERA}[camera.nested]\ndpth=1\n", "line 4: camera.nested.dpth: unknown key; did you"),
        (f"{CAMERA}nested = {{depth = 'x'}}", "line 3: camera.nested.depth: Input should be"),
        ("[camra]\ndriver = 'spy'", "line 1: camra: unknown table; did you mean camera"),
        ("[stage]\n", "line 1: stage: unknown table; known are arm, camera, mount, projector"),
        ('[arm]\ndriver = "grbl"\nport = ""\n', "line 3: arm.port: "),
        ("[camera\n", r"not TOML \(.*line 1"),
        ("[camera]\ndriver = 'spy'\n[camera]\n", "not TOML"),
        ("", "rig.toml: the file describes no device"),
        ('[mount]\ndriver = "manual"\npositions = []', "line 3: mount.positions: "),
        ('[mount]\ndriver = "manual"\npositions = ["a", "a"]', "mount: positions: a name occurs"),
        (f"[simulation]\nseed = -1\n{CAMERA}", "line 2: simulation.seed: Input should be greater"),
        ("[simulation]\nambient = nan\n", "line 2: simulation.ambient: "),
        ("[simulation]\nprojector_mm = [0, 0, -100]\n", "projector_mm: must be before"),
        ("[simulation]\ngain = 1e308\n", "line 2: simulation.gain: "),
        ("[simulation]\ndsnu_e = 1e308\n", "line 2: simulation.dsnu_e: "),
        ("[simulation.arm]\nlamp_colour = [-1, 0, 0]\n", "line 2: simulation.arm.lamp_colour"),
        (
            "[[arm]]\na = 1\n[[arm]]\n",
            r"line 1: arm: must be a table: write \[arm\]; a rig has one",
        ),
        (f"x = {'[' * 20_000}", "not the TOML of a rig"),
        (f"x = {'9' * 5000}", "not TOML"),
        (f"# {'x' * 300_000}", "larger than 32 KiB"),
    ],
)
def test_what_is_wrong_is_named_by_file_line_and_key(write, spies, text, message):
    with pytest.raises(RigFileError, match=message):
        read_rig_file(write(text))


def test_everything_that_is_wrong_is_said_at_once(write, spies):
    text = f"{CAMERA}a = 1\nb = 2\n[x]\n[arm]\n"
    with pytest.raises(RigFileError) as error:
        read_rig_file(write(text))
    assert len(str(error.value).splitlines()) == 4


def test_files_that_are_none(tmp_path):
    with pytest.raises(RigFileError, match="No such file"):
        read_rig_file(tmp_path / "none.toml")
    with pytest.raises(RigFileError, match="directory"):
        read_rig_file(tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe[camera]")
    with pytest.raises(RigFileError, match="line 1: not text in UTF-8"):
        read_rig_file(tmp_path / "binary.toml")
    with pytest.raises(RigFileError, match="larger than"):
        read_rig_file(Path("/dev/zero"))


def test_a_text_may_begin_with_a_byte_order_mark(tmp_path):
    (tmp_path / "rig.toml").write_bytes(b"\xef\xbb\xbf[camera]\ndriver = 'simulated'\n")
    rig_file = read_rig_file(tmp_path / "rig.toml")
    assert rig_file.text.startswith("[camera]")


def test_a_driver_that_is_not_installed_is_said_so(write, monkeypatch):
    missing = Driver("absent", DeviceKind.CAMERA, "devices.no_such_module", "Settings")
    monkeypatch.setattr("devices.drivers.DRIVERS", (*DRIVERS, missing))
    with pytest.raises(RigFileError, match=r"camera\.driver: absent cannot be loaded"):
        read_rig_file(write('[camera]\ndriver = "absent"\n'))


def test_lines_of_keys():
    text = """
top = 1
[camera]  # a comment
 driver = "x"
"quoted key" = 2
text = '''
fake = 3
'''
[[projector.stored]]
image = 0
[[projector.stored]]
image = 1
[projector.screen]
a.b = 1
"""
    lines = key_lines(text)
    assert lines["top",] == 2
    assert lines["camera", "driver"] == 4
    assert lines["camera", "quoted key"] == 5
    assert ("camera", "fake") not in lines
    assert lines["projector", "stored", 1, "image"] == 12
    assert lines["projector", "screen", "a", "b"] == 14
    assert line_of(("projector", "stored", 0, "absent"), lines) == 9
    assert line_of(("nowhere",), lines) is None


@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: f"{driver.name} {driver.kind}")
def test_every_driver_has_settings_that_name_it(driver):
    settings = driver.settings_class()
    assert settings.model_fields["driver"].annotation.__args__ == (driver.name,)
    assert settings.model_config["extra"] == "forbid"


def test_no_hardware_s_package_is_imported_before_it_is_used():
    code = (
        "import sys; import workstation.command_line, workstation.commands, devices.rig_file, "
        "devices.drivers, devices.search, devices.probing; from pathlib import Path; "
        f"devices.rig_file.read_rig_file(Path({str(RIGS / 'lab.toml')!r})); "
        "print([m for m in ('gi', 'gphoto2', 'rawpy', 'pyglet', 'usb', 'serial') "
        "if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
