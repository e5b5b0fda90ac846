from __future__ import annotations

import signal
import subprocess
import sys

import pytest

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


def test_a_closing_terminal_that_is_to_be_ignored_is_ignored():
    with start(before="signal.signal(signal.SIGHUP, signal.SIG_IGN)") as running:
        running.send_signal(signal.SIGHUP)
        assert running.stdout.readline() == "went on\n"
    assert running.returncode == 0
