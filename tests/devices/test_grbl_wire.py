"""What each fault does to the bytes on the line, and to what hangs on it."""

from __future__ import annotations

import pytest

from devices.simulated.grbl_controller import SimulatedGrblController
from devices.simulated.grbl_faults import (
    AlarmTrips,
    CommandGarbled,
    CommandLost,
    DoorOpens,
    FallsSilent,
    LampSticks,
    Noise,
    PowerFails,
    RealtimeLost,
    ReplyGarbled,
    ReplyLate,
    ReplyLost,
    ReplyMerged,
    ReplyRepeated,
    ReplySplit,
    Unplugged,
)
from devices.simulated.grbl_memory import FACTORY_SETTINGS
from devices.simulated.grbl_wire import SimulatedWire

GREETING = b"\r\nGrbl 1.1h ['$' for help]\r\n"  # reply 0
BUILD = b"[VER:1.1h.20190830:]\r\n"  # reply 1
OPTIONS = b"[OPT:V,15,128]\r\n"  # reply 2
OK = b"ok\r\n"  # reply 3
ALL = BUILD + OPTIONS + OK


def wire(*faults):
    line = SimulatedWire(SimulatedGrblController(FACTORY_SETTINGS), faults)
    assert line.collect(1.0) == b""
    assert line.collect(1.1) == GREETING
    return line


def asked(*faults, until_s=3.0):
    line = wire(*faults)
    line.send(b"$I\n", 2.0)
    line.collect(2.0)
    return line.collect(until_s)


@pytest.mark.parametrize(
    ("fault", "received"),
    [
        (ReplyLost(reply=2), BUILD + OK),
        (ReplyMerged(reply=2), BUILD + OPTIONS.strip() + OK),
        (ReplyRepeated(reply=3), ALL + OK),
        (ReplyGarbled(reply=3, place=1, byte=ord("o")), BUILD + OPTIONS + b"oo\r\n"),
        (Noise(reply=1, data=b"\xff\x00"), b"\xff\x00" + ALL),
        (CommandLost(command=0), b""),
        (CommandGarbled(command=0, place=1, byte=ord("Q")), b"error:2\r\n"),
        (None, ALL),
    ],
)
def test_faults_of_replies_and_commands(fault, received):
    assert asked(*([fault] if fault else [])) == received


def test_what_is_late_holds_back_what_comes_after_it():
    late = ReplyLate(reply=2, seconds=5.0)
    assert asked(late, until_s=6.9) == BUILD
    assert asked(late, until_s=7.1) == ALL
    split = ReplySplit(reply=2, after=4, seconds=5.0)
    assert asked(split, until_s=6.9) == BUILD + OPTIONS[:4]
    assert asked(split, until_s=7.1) == ALL


def test_single_bytes_can_be_lost():
    line = wire(RealtimeLost(command=0))
    line.send(b"?", 2.0)
    line.pass_time(2.0)
    assert line.collect(3.0) == b""
    line.send(b"?", 3.0)
    line.pass_time(3.0)
    assert line.collect(4.0).startswith(b"<Idle")


def test_a_plug_takes_the_port_away_and_brings_it_back():
    line = wire(Unplugged(command=0, delay_s=1.0, back_after_s=2.0))
    line.send(b"M3S100\n", 2.0)
    line.pass_time(2.0)
    assert line.collect(2.5) == OK
    with pytest.raises(OSError, match="disconnected"):
        line.collect(3.5)
    with pytest.raises(OSError, match="disconnected"):
        line.send(b"?", 4.0)
    assert line.attempts[-1].data == b"?"
    assert line.controller.lamp_on
    assert line.collect(5.5) == b""


def test_events_happen_when_they_are_due():
    line = wire(DoorOpens(command=0, delay_s=1.0, closes_after_s=1.0), PowerFails(command=1))
    line.send(b"M3S100\n", 2.0)
    line.pass_time(2.9)
    assert line.controller.lamp_on
    line.pass_time(3.1)
    assert not line.controller.lamp_on
    assert line.controller.state == "Door"
    line.collect(5.0)
    line.send(b"$I\n", 5.0)
    line.pass_time(5.0)
    assert line.collect(6.0).endswith(GREETING)


def test_an_alarm_cuts_a_move():
    line = wire(AlarmTrips(command=0, delay_s=1.0, code=1))
    line.send(b"G1X50F500\n", 2.0)
    line.pass_time(2.9)
    assert line.controller.moving
    line.pass_time(3.1)
    assert not line.controller.moving
    assert b"ALARM:1" in line.collect(4.0)


def test_a_deaf_controller_goes_on_with_what_it_heard():
    line = wire(FallsSilent(command=0, deaf=True))
    line.send(b"G1X50F500\n", 2.0)
    assert line.collect(2.1) == OK
    line.send(b"!\x18?", 2.2)
    assert line.collect(3.0) == b""
    assert line.controller.moving


def test_a_lamp_sticks_lit_or_dark():
    line = wire(LampSticks(command=1))
    for time_s, command in enumerate([b"M3S100\n", b"$I\n", b"M5\n", b"\x18"], start=2):
        line.send(command, float(time_s))
        line.pass_time(time_s + 0.5)
        assert line.controller.lamp_on
