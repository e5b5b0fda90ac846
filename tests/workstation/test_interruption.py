from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from devices.errors import DeviceError
from render.errors import RenderError
from workstation import command_line

WORK = """
import signal, sys, time
{before}
from workstation.interruption import watch_for_interruption
watch_for_interruption()
{after}
try:
    print("ready", flush=True)
    for _ in range(400):
        time.sleep(0.01)
    print("went on", flush=True)
except KeyboardInterrupt:
    print("leaving", flush=True)
    for _ in range(50):
        time.sleep(0.01)
    print("left", flush=True)
"""
UNBLOCK = "signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})"


def start(*, before: str = "", after: str = "") -> subprocess.Popen[str]:
    code = WORK.format(before=before, after=after)
    running = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert running.stdout is not None
    assert running.stdout.readline() == "ready\n"
    return running


@pytest.mark.parametrize("after", ["", UNBLOCK], ids=["blocked", "let through by a library"])
def test_a_signal_interrupts_once_and_the_way_out_not_at_all(ending_signal, after):
    with start(after=after) as running:
        running.send_signal(ending_signal)
        assert running.stdout.readline() == "leaving\n"
        running.send_signal(ending_signal)
        running.send_signal(signal.SIGTERM)
        assert running.stdout.readline() == "left\n"
    assert running.returncode == 0


def test_what_is_done_is_put_in_place_whatever_comes():
    late = "from workstation.interruption import too_late_to_stop\ntoo_late_to_stop()"
    with start(after=late) as running:
        running.send_signal(signal.SIGINT)
        assert running.stdout.readline() == "went on\n"
    assert running.returncode == 0


def test_a_closing_terminal_that_is_to_be_ignored_is_ignored():
    with start(before="signal.signal(signal.SIGHUP, signal.SIG_IGN)") as running:
        running.send_signal(signal.SIGHUP)
        assert running.stdout.readline() == "went on\n"
    assert running.returncode == 0


def ended(monkeypatch, error, *, requested):
    """Exit code of a command that ends with an error, after a request to stop or without one."""

    def broken(**named):
        raise error

    monkeypatch.setattr(command_line, "app", broken)
    monkeypatch.setattr(command_line, "watch_for_interruption", lambda: None)
    monkeypatch.setattr("workstation.commands.register", lambda app: None)
    monkeypatch.setattr(command_line, "was_requested", lambda: requested)
    with pytest.raises(SystemExit) as end:
        command_line.main()
    return end.value.code


@pytest.mark.parametrize(
    "error", [ImportError("numpy failed to import"), RenderError("OpenGL cannot be loaded")]
)
def test_an_import_that_an_interruption_broke_ends_as_interrupted(monkeypatch, capsys, error):
    code = ended(monkeypatch, error, requested=True)
    assert code == command_line.EXIT_INTERRUPTED
    assert "nothing half-written" in capsys.readouterr().err


def test_an_import_that_is_broken_by_itself_is_told(monkeypatch, capsys):
    with pytest.raises(ImportError, match="numpy"):
        ended(monkeypatch, ImportError("numpy failed to import"), requested=False)
    assert ended(monkeypatch, RenderError("no OpenGL"), requested=False) == 3
    assert "no OpenGL" in capsys.readouterr().err


def test_where_compiled_code_has_no_place_the_way_out_is_told(monkeypatch, capsys):
    # As numba says it where neither the program's folder nor the home can be written to.
    code = "from numba import njit\ndef f(): pass\nf.__code__ = f.__code__.replace("
    code += "co_filename='/proc/none.py')\nnjit(f, cache=True)"
    environment = {"PATH": os.environ["PATH"], "HOME": "/proc/none"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment
    )
    said = done.stderr.splitlines()[-1].removeprefix("RuntimeError: ")
    assert ended(monkeypatch, RuntimeError(said), requested=False) == 3
    assert "NUMBA_CACHE_DIR" in capsys.readouterr().err
    with pytest.raises(RuntimeError, match="defect"):
        ended(monkeypatch, RuntimeError("a defect"), requested=False)


def test_a_device_that_could_not_be_stopped_is_told_after_an_interruption_too(monkeypatch, capsys):
    assert ended(monkeypatch, DeviceError("the lamp stays lit"), requested=True) == 4
    assert "the lamp stays lit" in capsys.readouterr().err
