from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from devices.errors import ImpastoError
from workstation.benchmarks import interruptions
from workstation.benchmarks.interruptions import Command, interrupt, spread_moments

# A command that waits for the signal and takes its time, and then writes two files, which nothing
# cuts off; {late} is what it does when it is struck before.
WORK = """
import signal, sys, time
from pathlib import Path
folder = Path(sys.argv[1])
signal.pthread_sigmask(signal.SIG_BLOCK, {{signal.SIGINT}})
until = time.monotonic() + 0.5
while time.monotonic() < until:
    time.sleep(0.01)
    if signal.SIGINT in signal.sigpending():
        {late}
        sys.exit(130)
(folder / "a").write_text("whole")
(folder / "b").write_text("whole")
"""
# One that never waits for it, and ends in its own way.
LOADING = """
import os, signal, sys, time
signal.signal(signal.SIGINT, lambda number, frame: os._exit(1))
time.sleep(0.3)
for name in "ab":
    open(f"{sys.argv[1]}/{name}", "w").write("whole")
"""


def check(folder):
    for name in ("a", "b"):
        if (folder / name).read_text() != "whole":
            raise ImpastoError(f"{name} is half")


def interrupted(tmp_path, monkeypatch, script, times=6):
    # Deaf until it listens: a bare interpreter that is struck leaves what it may.
    deaf = ["/bin/sh", "-c", "trap '' INT; exec \"$@\"", "deaf"]
    monkeypatch.setattr(interruptions, "IMPASTO", [*deaf, sys.executable, "-S", "-c", script])
    return interrupt(Command("made up", lambda folder: [str(folder)], check), tmp_path, times=times)


def test_a_command_that_leaves_nothing_is_found_to(tmp_path, monkeypatch):
    done = interrupted(tmp_path, monkeypatch, WORK.format(late="pass"))
    assert done.wrong == []
    assert len(done.moments_s) == 6
    # Over all of the run time, in equal parts of it.
    assert min(done.moments_s) < done.lasting_s / 3
    assert max(done.moments_s) > done.lasting_s / 2


@pytest.mark.parametrize(
    ("late", "said"),
    [
        ('(folder / "a").write_text("whole")', "left a"),
        ('[(folder / n).write_text("half") for n in "ab"]', "a is half"),
        ('sys.exit("because")', "ended with 1: because"),
        ('[(folder / n).write_text("whole") for n in "abc"]', "left a, b, c"),
    ],
)
def test_what_is_left_half_is_found(tmp_path, monkeypatch, late, said):
    done = interrupted(tmp_path, monkeypatch, WORK.format(late=late), times=4)
    # Struck before it waits for the signal it goes on, and all it makes is whole.
    assert done.wrong
    assert all(said in wrong for wrong in done.wrong)


def test_a_command_that_is_struck_while_it_loads_may_end_with_an_error(tmp_path, monkeypatch):
    done = interrupted(tmp_path, monkeypatch, LOADING)
    assert done.wrong == []
    assert len(done.moments_s) == 6


def test_a_command_that_fails_by_itself_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(interruptions, "IMPASTO", [sys.executable, "-S", "-c", "1 / 0"])
    done = interrupt(Command("made up", lambda folder: [], check), tmp_path, times=3)
    assert "ZeroDivisionError" in done.wrong[0]
    assert done.moments_s == []


def test_what_is_left_on_is_found_however_a_run_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(interruptions, "IMPASTO", [sys.executable, "-S", "-c", "1 / 0"])
    writes = 'import sys; [open(f"{sys.argv[1]}/{name}", "w").write("whole") for name in "ab"]'
    command = Command(
        "made up",
        lambda folder: [str(folder)],
        check,
        program=(sys.executable, "-S", "-c", writes),
        afterwards=lambda folder: "left on" if (folder / "a").is_file() else None,
    )
    done = interrupt(command, tmp_path, times=1)
    assert "left on" in done.wrong[0]


LIGHTS_UP = """
import sys
from workstation import command_line
from workstation.benchmarks import watched_lamp
def command():
    from devices.interfaces import ArmPose
    from devices.simulated.light_arm import ArmMechanism
    ArmMechanism(ArmPose(0, 1)).lamp_on = {lit}
    sys.exit({code})
command_line.main = command
sys.argv = ["impasto", sys.argv[1]]
watched_lamp.main()
"""


@pytest.mark.parametrize(("lit", "code"), [(True, 130), (False, 130), (True, 0)])
def test_whether_the_lamp_is_lit_in_the_end_is_told(tmp_path, lit, code):
    file = tmp_path / "lamp"
    script = LIGHTS_UP.format(lit=lit, code=code)
    ended = subprocess.run([sys.executable, "-c", script, str(file)], check=False)
    assert ended.returncode == code
    assert file.read_text() == ("lit" if lit else "dark")


def test_moments_are_spread_over_all_of_the_time():
    found = np.sort(spread_moments(50, 10.0, np.random.default_rng(0)))
    assert (found // 0.2 == np.arange(50)).all()
