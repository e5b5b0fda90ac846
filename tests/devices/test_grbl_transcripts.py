"""The simulated controller against transcripts of real GRBL 1.1h firmware.

Every byte of the transcripts is sent in its order, and the replies are compared line for line, but
for what depends on how fast the recorded firmware ran, which was built to run on a desktop at some
tenth of its usual speed and answered each line when the next byte came:

* position and speed while a move runs or is held are compared in kind (rising, then constant);
* a status report may come before or after the lines of a command that ends at the same byte, so
  between two bytes the reports and the other lines are compared each in their own order;
* waiting times are left out: before a byte is sent, the controller may finish what the transcript
  shows it to have finished;
* one line is the recording program's own, and no reply (four numbers without brackets);
* the second transcript ends where its firmware fell silent, half a second after its receive buffer
  had overflowed in a hold; real boards answer a reset there, so what follows is not compared.
"""

from __future__ import annotations

import ast
import re
from itertools import pairwise

import pytest

from devices.grbl.codes import ALARMS, REFUSALS, Setting
from devices.grbl.messages import Garbled, parse_line
from devices.simulated.grbl_controller import SimulatedGrblController
from devices.simulated.grbl_memory import FACTORY_SETTINGS
from devices.simulated.grbl_state import Build

FIRMWARE_SPEED = 0.1
NOT_A_REPLY = re.compile(r"\d+, \d+, \d+, [\d.]+")
MOVES = re.compile(r"^<(Run|Hold)")
VARIES = re.compile(r"MPos:[^|]*\|(Bf:[^|]*\|)FS:[^|]*")
SILENT_FROM_S = 13.3


def events(path, until_s=float("inf")):
    """Times with bytes sent, or a line received."""
    for line in path.read_text().splitlines():
        direction, time_s, *text = line.split(" ", 2)
        text = text[0] if text else ""
        if float(time_s) >= until_s:
            return
        if direction == "<":
            yield float(time_s), None, text
        elif re.fullmatch(r"b'.*'", text):
            yield float(time_s), ast.literal_eval(text), None
        else:
            yield float(time_s), text.encode() + b"\n", None


def replay(path, until_s=float("inf")):
    """What the transcript and the simulation received, between each two bytes sent."""
    controller = SimulatedGrblController(
        FACTORY_SETTINGS,
        build=Build(replies_lag=True, active_inputs="PXYZRHS", homing_cycles=((2,), (0, 1))),
    )
    before_s, now_s = 0.0, 0.0
    expected, got = [[]], [controller.replies()]
    if next(iter(events(path)))[1] is not None:
        got[0].clear()  # recorded from a byte on, not from power-up
    for time_s, sent, received in events(path, until_s):
        if sent is None:
            if NOT_A_REPLY.fullmatch(received):
                continue
            expected[-1].append(received)
            waited = 0
            while len(got[-1]) < len(expected[-1]) and waited < 200:
                now_s, waited = now_s + 0.05, waited + 1
                controller.advance(now_s)
                got[-1] += controller.replies()
            continue
        now_s += FIRMWARE_SPEED * (time_s - before_s)
        before_s = time_s
        controller.advance(now_s)
        expected.append([])
        got[-1] += controller.replies()
        got.append([])
        controller.receive(sent)
        got[-1] += controller.replies()
    return expected, got


def comparable(line):
    return VARIES.sub(r"MPos:varies|\1FS:varies", line) if MOVES.match(line) else line


def ordered(lines):
    """Reports and other lines, each in their order."""
    reports = [comparable(line) for line in lines if line.startswith("<")]
    return reports, [line for line in lines if not line.startswith("<")]


@pytest.mark.parametrize(
    ("name", "until_s", "least"),
    [("transcript.txt", float("inf"), 70), ("transcript2.txt", SILENT_FROM_S, 25)],
)
def test_the_simulation_answers_as_the_firmware_did(real_data, name, until_s, least):
    expected, got = replay(real_data / "grbl-1.1h-transcripts" / name, until_s)
    assert [ordered(lines) for lines in got] == [ordered(lines) for lines in expected]
    assert sum(map(len, expected)) >= least


def test_a_held_move_slows_down_and_stays(real_data):
    _, got = replay(real_data / "grbl-1.1h-transcripts" / "transcript2.txt", SILENT_FROM_S)
    reports = [line for lines in got for line in lines if MOVES.match(line)]
    places = [float(re.search(r"MPos:([-\d.]+)", line)[1]) for line in reports]
    assert all(a <= b for a, b in pairwise(places))
    still = [place for line, place in zip(reports, places, strict=True) if "Hold:0" in line]
    assert len(still) >= 3
    assert len(set(still)) == 1
    # Far from the end of the move, which a resume during the slowing down would have gone on to.
    assert 0 < still[0] < 5


def test_every_line_of_the_firmware_is_understood(real_data):
    for name in ("transcript.txt", "transcript2.txt"):
        for _, _, received in events(real_data / "grbl-1.1h-transcripts" / name):
            if received and not NOT_A_REPLY.fullmatch(received):
                messages = parse_line(received)
                assert len(messages) == 1
                assert not isinstance(messages[0], Garbled)


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("alarm_codes_en_US.csv", set(ALARMS)),
        ("error_codes_en_US.csv", set(REFUSALS)),
        ("setting_codes_en_US.csv", set(Setting)),
    ],
)
def test_every_code_of_the_documentation_has_a_name(real_data, name, known):
    text = (real_data / "grbl-1.1h-transcripts" / name).read_text()
    codes = {int(code) for code in re.findall(r'^"(\d+)"', text, re.MULTILINE)}
    assert codes
    assert codes <= known
