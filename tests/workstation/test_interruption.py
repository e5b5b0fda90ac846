from __future__ import annotations

import signal
import subprocess
import sys

import pytest

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


def test_an_import_that_an_interruption_broke_ends_as_interrupted(monkeypatch, capsys):
    def broken(**named):
        raise ImportError("numpy failed to import")

    monkeypatch.setattr(command_line, "app", broken)
    monkeypatch.setattr(command_line, "watch_for_interruption", lambda: None)
    monkeypatch.setattr("workstation.commands.register", lambda app: None)
    monkeypatch.setattr(command_line, "was_requested", lambda: True)
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    assert ended.value.code == command_line.EXIT_INTERRUPTED
    assert "nothing half-written" in capsys.readouterr().err
    monkeypatch.setattr(command_line, "was_requested", lambda: False)
    with pytest.raises(ImportError, match="numpy"):
        command_line.main()
