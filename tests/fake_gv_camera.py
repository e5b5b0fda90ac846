"""Aravis's own simulated GigE Vision camera: a process that real cameras' software speaks to."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

PROGRAM = "arv-fake-gv-camera-0.8"
ADDRESS = "127.0.0.1"
SERIAL = "IMPASTO01"
# A small sensor: its frames fit into few packets.
WIDTH, HEIGHT = 256, 192


class FakeCamera:
    """A running camera process."""

    def __init__(self, *options: str) -> None:
        self._options = options
        self.start()

    def start(self) -> None:
        # Dies with its parent, however that ends.
        command = ["setpriv", "--pdeathsig", "KILL", PROGRAM, "-i", ADDRESS, "-s", SERIAL]
        self.process = subprocess.Popen(
            [*command, *self._options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        time.sleep(0.2)
        assert self.process.poll() is None, "the simulated camera did not start"

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def freeze(self) -> None:
        self.process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        self.process.send_signal(signal.SIGCONT)


@contextmanager
def fake_gv_camera(*options: str) -> Iterator[FakeCamera]:
    """One camera at a time on this machine: its port is fixed."""
    if shutil.which(PROGRAM) is None:
        pytest.skip(f"{PROGRAM} is not installed (Debian package aravis-tools)")
    if shutil.which("setpriv") is None:
        pytest.skip("setpriv is not installed (Debian package util-linux)")
    require_aravis()
    with no_fake_camera():
        camera = FakeCamera(*options)
        try:
            yield camera
        finally:
            camera.kill()


@contextmanager
def no_fake_camera() -> Iterator[None]:
    """Nobody else's simulated camera on this machine meanwhile."""
    lock = Path(tempfile.gettempdir()) / f"impasto-fake-gv-camera-{os.getuid()}.lock"
    with lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def require_aravis() -> None:
    from devices.aravis.library import load_aravis
    from devices.errors import MissingPackageError

    try:
        load_aravis()
    except MissingPackageError as error:
        pytest.skip(str(error))


def genicam_of_fake() -> str:
    """The description that the camera carries, with a small sensor."""
    from devices.aravis.library import load_aravis

    text, _ = load_aravis().FakeDevice.new("description").get_genicam_xml()
    for name, size in (("SensorWidth", WIDTH), ("SensorHeight", HEIGHT)):
        text = re.sub(
            rf'<Integer Name="{name}"(.*?)<pValue>{name}Register</pValue>',
            rf'<Integer Name="{name}"\1<Value>{size}</Value>',
            text,
            flags=re.DOTALL,
        )
    return text


def with_features(text: str, category: str, nodes: dict[str, str]) -> str:
    """A description with more features in one of its categories."""
    listed = "".join(f"<pFeature>{name}</pFeature>" for name in nodes if name[0] != "_")
    head = f'<Category Name="{category}"'
    at = text.index(">", text.index(head)) + 1
    text = text[:at] + listed + text[at:]
    return text.replace(
        "</RegisterDescription>", "".join(nodes.values()) + "</RegisterDescription>"
    )


def enumeration(name: str, register: int, *, off: int, on: int) -> dict[str, str]:
    """A feature that is ``Off`` or ``Continuous``, in memory of the camera that nothing uses."""
    return {
        name: f"""<Enumeration Name="{name}">
            <EnumEntry Name="Off"><Value>{off}</Value></EnumEntry>
            <EnumEntry Name="Continuous"><Value>{on}</Value></EnumEntry>
            <pValue>{name}Register</pValue></Enumeration>""",
        f"_{name}": integer_register(f"{name}Register", register),
    }


def constant(name: str, value: int) -> str:
    """An integer that cannot be written."""
    return f'<IntSwissKnife Name="{name}"><Formula>{value}</Formula></IntSwissKnife>'


def integer_register(name: str, register: int) -> str:
    return f"""<IntReg Name="{name}"><Address>{register:#x}</Address><Length>4</Length>
        <AccessMode>RW</AccessMode><pPort>Device</pPort><Sign>Unsigned</Sign>
        <Endianess>BigEndian</Endianess></IntReg>"""
