"""Ctrl-C and polite kills end a command cleanly, wherever they strike.

Two things would spoil that. mrcal resets SIGINT to its default inside its functions, where a real
signal would end the process without undoing anything; and some libraries swallow an exception that
a signal raised inside their callbacks. So the signals are blocked in every thread and waited for by
one of ours, which interrupts the main thread without a signal; and long work asks now and then
whether it was meant to stop.
"""

from __future__ import annotations

import _thread
import signal
import threading
from types import FrameType

_SIGNALS = {signal.SIGINT, signal.SIGTERM}
_requested = threading.Event()


def watch_for_interruption() -> None:
    """Take SIGINT and SIGTERM as requests to stop; call first, from the main thread."""
    signal.signal(signal.SIGINT, _interrupt)
    # Threads started later inherit the mask.
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    threading.Thread(target=_wait_for_signals, daemon=True, name="interruption").start()


def stop_if_requested() -> None:
    """Raise KeyboardInterrupt if a request to stop came and something swallowed it."""
    if _requested.is_set():
        raise KeyboardInterrupt


def _wait_for_signals() -> None:
    while True:
        signal.sigwait(_SIGNALS)
        if _requested.is_set():
            continue  # the way out is not interrupted
        _requested.set()
        _thread.interrupt_main()


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
