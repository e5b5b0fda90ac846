"""Ctrl-C, polite kills and a terminal that closes end a command cleanly, wherever they strike.

Two things would spoil that. mrcal resets SIGINT to its default inside its functions, where a real
signal would end the process without undoing anything; and some libraries swallow an exception that
a signal raised inside their callbacks. So the signals are blocked in every thread and waited for by
one of ours, which interrupts the main thread without a signal; and long work asks now and then
whether it was meant to stop. Where a library lets the signals through all the same, as
:mod:`multiprocessing` does when it starts a process, their handlers do the same.
"""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
_requested = threading.Event()
_raised = threading.Event()
_held = threading.Event()
_too_late = threading.Event()
_watching = threading.Event()
# Between a request that comes and a command that will not hear any more.
_deciding = threading.Lock()


def watch_for_interruption() -> None:
    """Take SIGINT, SIGTERM and SIGHUP as requests to stop; call first, from the main thread.

    A SIGHUP that is ignored already (``nohup``) stays ignored.
    """
    watched = set(_SIGNALS)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        watched.remove(signal.SIGHUP)
    for number in watched:
        signal.signal(number, _interrupt)
    # Threads started later inherit the mask.
    signal.pthread_sigmask(signal.SIG_BLOCK, watched)
    threading.Thread(
        target=_wait_for_signals, args=(watched,), daemon=True, name="interruption"
    ).start()
    _watching.set()


def was_requested() -> bool:
    """Whether a request to stop came: an error after it may be all that is left of it.

    Libraries of compiled code turn an interruption that strikes while they are loaded into an
    ImportError.
    """
    return _requested.is_set()


def stop_if_requested() -> None:
    """Raise KeyboardInterrupt if a request to stop came and something swallowed it."""
    if _requested.is_set():
        raise KeyboardInterrupt


@contextmanager
def interruption_held() -> Iterator[None]:
    """Let a request to stop wait until the block ends, and raise KeyboardInterrupt there.

    For calls of compiled kernels: an exception that strikes while one is loaded or called is lost
    in it, or takes the process down.
    """
    _held.set()
    try:
        yield
    finally:
        _held.clear()
    stop_if_requested()


def too_late_to_stop() -> None:
    """From here on a request to stop is not heard: the work is done, its results are put in place.

    What a command leaves is several files then, of which none is to be there without the others. A
    request that came before raises KeyboardInterrupt here.
    """
    with _deciding:
        if _watching.is_set() and not _requested.is_set():
            _too_late.set()
    stop_if_requested()


def _wait_for_signals(watched: set[signal.Signals]) -> None:
    while True:
        signal.sigwait(watched)
        with _deciding:
            if _requested.is_set() or _too_late.is_set():
                continue  # the way out is not interrupted
            _requested.set()
            if not _held.is_set():
                _thread.interrupt_main()


def _interrupt(number: int, frame: FrameType | None) -> None:
    if _too_late.is_set():
        return
    _requested.set()
    if not (_raised.is_set() or _held.is_set()):
        _raised.set()
        raise KeyboardInterrupt
