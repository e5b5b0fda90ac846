from __future__ import annotations

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import DeviceError
from devices.grbl.codes import ALARMS, REFUSALS
from devices.grbl.errors import AlarmError, RefusedError
from devices.grbl.messages import (
    Acknowledged,
    Alarm,
    Banner,
    BuildOptions,
    Garbled,
    MachineState,
    ModalState,
    Notice,
    Refused,
    SettingValue,
    StatusReport,
    parse_line,
)

RUN = "<Run|MPos:1.500,-2.000,0.000|Bf:14,128|FS:420,1000|Pn:XD|Ov:100,100,100|A:SF>"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("ok", Acknowledged()),
        ("error:20", Refused(20)),
        ("ALARM:3", Alarm(3)),
        ("Grbl 1.1h ['$' for help]", Banner("Grbl", "1.1h")),
        ("GrblHAL 1.1f ['$' or '$HELP' for help]", Banner("GrblHAL", "1.1f")),
        ("$110=500.000", SettingValue(110, 500.0)),
        ("[MSG:Caution: Unlocked]", Notice("MSG:Caution: Unlocked")),
        ("[OPT:VZ,15,128]", BuildOptions("VZ")),
        (">G20G54:ok", Notice(">G20G54:ok")),
        (
            "[GC:G80 G54 G17 G21 G90 G94 M5 M9 T17 F0 S0]",
            ModalState(
                frozenset(
                    ["G80", "G54", "G17", "G21", "G90", "G94", "M5", "M9", "T17", "F0", "S0"]
                ),
                17,
            ),
        ),
    ],
)
def test_each_kind_of_line_is_its_message(line, message):
    assert parse_line(line) == (message,)
    assert parse_line(f"  {line}\r") == (message,)


def test_a_status_report_is_read_field_by_field():
    (report,) = parse_line(RUN)
    assert report == StatusReport(
        state=MachineState.RUN,
        machine_position=(1.5, -2.0, 0.0),
        feed=420.0,
        pins="XD",
        accessories="SF",
    )
    (held,) = parse_line("<Hold:1|WPos:0.000,0.000,0.000|FS:0,0>")
    assert (held.state, held.substate) == (MachineState.HOLD, 1)
    assert held.machine_position is None


def test_outputs_are_told_only_beside_the_overrides():
    outputs = [
        parse_line(f"<Idle|MPos:0.000,0.000,0.000|FS:0,0{rest}>")[0].accessories
        for rest in (
            "",
            "|WCO:0.000,0.000,0.000",
            "|Ov:100,100,100",
            "|Ov:100,100,100|A:C",
            "|Ov:100,100,100|Q:C",
        )
    ]
    assert outputs == [None, None, "", "C", None]


def test_no_single_byte_makes_a_lit_lamp_look_dark():
    for place, byte in product(range(len(RUN)), range(256)):
        altered = RUN.encode()[:place] + bytes([byte]) + RUN.encode()[place + 1 :]
        for line in altered.split(b"\n"):
            for message in parse_line(line.decode("ascii", errors="replace")):
                assert not (isinstance(message, StatusReport) and message.accessories == "")


@pytest.mark.parametrize(
    "line",
    [
        "<Idle|MPos:0.000,0.000|FS:0,0",
        "<Idle|MPos:0.000,x.000,0.000|FS:0,0>",
        "<Idle|MPos:0.000|FS:0,0>",
        "<Idle|MPos:0.000,0.000,0.000|MPos:0.000,0.000,0.000>",
        "<Idle|FS:0,0>",
        "<Idly|MPos:0.000,0.000,0.000>",
        "<Hold:12|MPos:0.000,0.000,0.000>",
        "<Idle|MPos:0.000,0.000,nan|FS:0,0>",
        "[GC:G0 G54]",
        "o k",
        "okk",
        "error:",
        "$5",
        "\ufffd\ufffd",
        "5000, 0, 0, 0.000000",
    ],
)
def test_what_is_malformed_is_garbled(line):
    assert parse_line(line) == (Garbled(line),)


def test_lines_that_lost_their_end_between_them_are_both_read():
    assert parse_line("okok") == (Acknowledged(), Acknowledged())
    assert parse_line(f"ok{RUN}") == (Acknowledged(), *parse_line(RUN))
    assert parse_line("error:9ok") == (Refused(9), Acknowledged())


def test_of_a_garbled_line_only_the_bad_news_is_believed():
    messages = parse_line("x<Idle|MPos:0.000,0.000,0.000|FS:0,0>okALARM:1")
    assert messages == (Garbled("x<Idle|MPos:0.000,0.000,0.000|FS:0,0>okALARM:1"), Alarm(1))


@given(st.text(max_size=200))
def test_anything_at_all_can_be_read(text):
    for message in parse_line(text):
        assert message is not None


@given(st.integers(0, len(RUN) - 1), st.characters(codec="ascii"))
def test_a_report_with_a_letter_altered_is_read_alike_or_not_at_all(place, letter):
    """No altered report may raise, or tell a state or outputs that no single letter makes."""
    altered = RUN[:place] + letter + RUN[place + 1 :]
    for message in parse_line(altered):
        if isinstance(message, StatusReport):
            assert message.state is MachineState.RUN


@pytest.mark.parametrize("code", ALARMS)
def test_every_alarm_has_a_name_and_a_remedy(code):
    error = AlarmError(code, "homing")
    assert isinstance(error, DeviceError)
    assert ALARMS[code].name in str(error)
    assert ALARMS[code].remedy in str(error)
    assert "homing" in str(error)


@pytest.mark.parametrize("code", REFUSALS)
def test_every_refusal_has_a_name_and_a_remedy(code):
    error = RefusedError(code, "moving")
    assert REFUSALS[code].name in str(error)
    assert REFUSALS[code].remedy in str(error)


@pytest.mark.parametrize("error", [AlarmError(99, "homing"), RefusedError(99, "homing")])
def test_an_unknown_number_is_told_as_it_is(error):
    assert "99" in str(error)
