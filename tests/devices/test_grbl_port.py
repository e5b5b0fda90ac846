"""The light arm on a pseudo-terminal that pyserial opens as a real port, in real time."""

from __future__ import annotations

import errno
import math
import os
import pty
import random
import signal
import subprocess
import sys
import threading
import time
import tty
from pathlib import Path

import captures_to_interrupt
import pytest
import serial

from devices.errors import DeviceError, DeviceTimeoutError
from devices.grbl.errors import NotGrblError, PositionUntrustedError, StopFailedError
from devices.grbl.greeting import greet
from devices.grbl.serial_line import SerialLine, open_serial_port
from devices.grbl.settings import GrblSettings, find
from devices.interfaces import ArmPose
from devices.simulated.grbl_controller import SimulatedGrblController
from devices.simulated.grbl_memory import ARM_SETTINGS
from devices.simulated.grbl_port import SimulatedGrblPort

QUICK = {**ARM_SETTINGS, 24: 600, 25: 3000, 26: 10, 110: 3000, 111: 3000, 120: 400, 121: 400}
QUICK |= {130: 50, 131: 40}


def pose(azimuth_deg, elevation_deg):
    return ArmPose(math.radians(azimuth_deg), math.radians(elevation_deg))


def degrees(angles):
    return [math.degrees(angles.azimuth), math.degrees(angles.elevation)]


@pytest.fixture
def controller():
    return SimulatedGrblController(QUICK)


@pytest.fixture
def silent_port():
    """A port with a wire that leads nowhere, and its far end."""
    far, near = pty.openpty()
    tty.setraw(near)
    yield os.ttyname(near), far
    os.close(far)
    os.close(near)


@pytest.mark.parametrize("boot_s", [None, 1.0])
def test_a_session_through_the_operating_system(controller, boot_s):
    with SimulatedGrblPort(controller, time_scale=10, boot_s=boot_s) as port:
        arm = GrblSettings(port=port.address).open()
        arm.home()
        for target in [(30, 20), (45, 5)]:
            arm.move_to(pose(*target))
            assert degrees(controller.pose) == pytest.approx(target, abs=1e-3)
            arm.switch_lamp(True)
            assert controller.lamp_on
        arm.close()
        assert not controller.lamp_on
    assert not any(moment.moving and moment.lamp_on for moment in controller.timeline)


FORGETFUL = """
import math, sys
from devices.grbl.settings import GrblSettings
from devices.interfaces import ArmPose
arm = GrblSettings(port=sys.argv[1]).open()
arm.home()
arm.move_to(ArmPose(math.radians(20), math.radians(10)))
arm.switch_lamp(True)
"""


def test_a_program_that_ends_without_closing_its_arm_leaves_it_dark(controller):
    with SimulatedGrblPort(controller, time_scale=10) as port:
        subprocess.run([sys.executable, "-c", FORGETFUL, port.address], check=True, timeout=60)
        assert any(moment.lamp_on for moment in controller.timeline)
        assert not controller.lamp_on


def test_a_controller_keeps_its_position_from_nobody(controller):
    """Who opens the port next must home, though the controller still counts."""
    with SimulatedGrblPort(controller, time_scale=10) as port:
        arm = GrblSettings(port=port.address).open()
        arm.home()
        arm.close()
        again = GrblSettings(port=port.address).open()
        with pytest.raises(PositionUntrustedError):
            again.move_to(pose(10, 10))
        again.close()


def test_a_plug_that_is_pulled_and_put_back(controller):
    with SimulatedGrblPort(controller, time_scale=2) as port:
        arm = GrblSettings(port=port.address, reply_timeout_s=0.5).open()
        arm.home()
        timer = threading.Timer(0.2, port.unplug)
        timer.start()
        with pytest.raises(StopFailedError, match="cut the power"):
            arm.move_to(pose(49, 39))
        timer.join()
        assert arm.pose is None
        port.plug_in()
        time.sleep(0.1)
        arm.home()
        arm.move_to(pose(20, 20))
        assert degrees(controller.pose) == pytest.approx([20, 20], abs=1e-3)
        arm.close()


def test_a_port_in_use_is_named(controller):
    with SimulatedGrblPort(controller, time_scale=10) as port:
        arm = GrblSettings(port=port.address).open()
        with pytest.raises(DeviceError, match="in use by another program"):
            GrblSettings(port=port.address).open()
        arm.close()


def test_ports_that_are_none_are_named(tmp_path):
    with pytest.raises(DeviceError, match="is not there"):
        open_serial_port(str(tmp_path / "ttyUSB7"), 115_200)
    file = tmp_path / "file"
    file.write_text("no port")
    with pytest.raises(DeviceError, match="no serial port"):
        open_serial_port(str(file), 115_200)


def test_a_port_of_somebody_elses_is_named(monkeypatch):
    def refuse(*args, **options):
        raise serial.SerialException(errno.EACCES, "could not open port: Permission denied")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(DeviceError, match="dialout"):
        open_serial_port("/dev/ttyUSB0", 115_200)


def test_silence_and_strangers_are_told_apart(silent_port):
    address, far = silent_port
    line = SerialLine(open_serial_port(address, 115_200), name=address)
    with pytest.raises(DeviceTimeoutError, match="power"):
        greet(line, name=address, boot_timeout_s=0.5, may_reset=False)
    os.write(far, b"\x00\xfe\x80login: \r\n")
    with pytest.raises(NotGrblError, match="baud rate"):
        greet(line, name=address, boot_timeout_s=0.5, may_reset=False)
    line.close()


def test_the_search_tells_what_is_wrong_with_each_port(controller, silent_port, tmp_path):
    with SimulatedGrblPort(controller, time_scale=10, boot_s=10.0) as port:
        missing = str(tmp_path / "ttyUSB9")
        found = find([port.address, silent_port[0], missing])
    assert [one.address for one in found] == [port.address, silent_port[0], missing]
    assert {one.driver for one in found} == {"grbl"}
    assert (found[0].model, found[0].problem) == ("Grbl 1.1h", None)
    assert "power" in found[1].problem
    assert "not there" in found[2].problem


def test_the_search_moves_nothing(controller):
    with SimulatedGrblPort(controller) as port:
        find([port.address])
        assert set(port.sent) <= set(b"?")


def test_the_search_lists_what_the_system_lists():
    for one in find():
        assert one.problem is not None or one.model


class Interrupted:
    """One capture, and what was so when its signal was sent and after it had ended."""

    def __init__(self, number, delay_s):
        self.number = number
        self.delay_s = delay_s
        self.controller = SimulatedGrblController(QUICK)
        self.port = SimulatedGrblPort(self.controller, time_scale=4)

    def interrupt(self, process, number):
        """Send the signal at a random moment of homing, moving, lighting and capturing."""
        end = time.monotonic() + 30
        while b"$H" not in self.port.sent and time.monotonic() < end:
            time.sleep(0.005)
        time.sleep(self.delay_s)
        self.was_moving, self.was_lit = self.controller.moving, self.controller.lamp_on
        self.sent_s = self.controller.now_s
        os.kill(process, number)

    def judge(self):
        """What was wrong when the process had ended."""
        wrong = []
        if self.controller.moving:
            wrong.append("moving")
        if self.controller.lamp_on:
            wrong.append("lit")
        if any(moment.moving and moment.lamp_on for moment in self.controller.timeline):
            wrong.append("lit while moving")
        last = max(
            (m.time_s for m in self.controller.timeline if m.moving or m.lamp_on), default=0.0
        )
        self.took_s = max(0.0, last - self.sent_s) / 4
        return wrong


def test_an_interrupted_capture_leaves_the_arm_still_and_dark():
    """SIGINT and SIGTERM at fifty random moments of a capture, judged on the controller's side."""
    draw = random.Random(0)
    script = Path(captures_to_interrupt.__file__)
    done = []
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as children:
        try:
            for batch in range(5):
                captures = [Interrupted(10 * batch + k, draw.uniform(0, 1.8)) for k in range(10)]
                print(*[one.port.address for one in captures], file=children.stdin, flush=True)
                processes = [int(children.stdout.readline()) for _ in captures]
                senders = [
                    threading.Thread(
                        target=one.interrupt,
                        args=(process, signal.SIGINT if one.number % 2 else signal.SIGTERM),
                    )
                    for one, process in zip(captures, processes, strict=True)
                ]
                for sender in senders:
                    sender.start()
                for sender in senders:
                    sender.join()
                codes = [int(children.stdout.readline().split()[1]) for _ in captures]
                for one, code in zip(captures, codes, strict=True):
                    done.append((code, one.judge(), one))
                    one.port.close()
        finally:
            children.stdin.close()
    assert [code for code, _, _ in done] == [130] * 50
    assert [wrong for _, wrong, _ in done] == [[]] * 50
    assert sum(one.was_moving for _, _, one in done) >= 10
    assert sum(one.was_lit for _, _, one in done) >= 5
    # Within a wait's slice and the braking, with plenty of room for a busy machine.
    assert max(one.took_s for _, _, one in done) < 5
