"""Calls in a process of their own, so that a driver that hangs or crashes takes nothing with it.

Threads would not do: a driver that waits inside a library cannot be stopped, and may hold the
interpreter.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from devices.deadline import Deadline
from devices.errors import DeviceError, MissingPackageError

_CHILDREN = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class Answer:
    """What became of a call.

    Attributes
    ----------
    name : str
        The call's.
    value : object
        What it returned; None if it did not.
    error : DeviceError or None
        What it raised, or that it took too long or its process died.
    """

    name: str
    value: Any = None
    error: DeviceError | None = None


def call_all(
    calls: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]], *, limit_s: float
) -> Iterator[Answer]:
    """Make calls side by side, each in a process of its own, and yield answers as they come.

    Parameters
    ----------
    calls : dict
        Function of a module and its arguments by name.
    limit_s : float
        How long each may take, the start of its process included.

    Yields
    ------
    Answer
        One per call. Processes that are still at work when the generator is closed are ended.
    """
    deadline = Deadline.after(limit_s)
    running: dict[Connection, tuple[str, Any]] = {}
    try:
        for name, (function, arguments) in calls.items():
            ours, theirs = _CHILDREN.Pipe(duplex=False)
            process = _CHILDREN.Process(target=_run, args=(theirs, function, arguments), name=name)
            running[ours] = name, process
            _start(process)
            theirs.close()
        while running and not deadline.passed:
            # In steps, between which an interruption is noticed.
            for ready in wait(list(running), timeout=min(deadline.remaining_s, 0.1)):
                ours = next(connection for connection in running if connection is ready)
                name, process = running.pop(ours)
                yield _answer_of(name, ours, process)
        while running:
            ours, (name, process) = running.popitem()
            _kill(process)
            ours.close()
            late = DeviceError(
                f"did not answer within {limit_s:g} s and was given up; allow more time, or unplug "
                "and replug the device"
            )
            yield Answer(name, error=late)
    finally:
        for ours, (_, process) in running.items():
            _kill(process)
            ours.close()


def _answer_of(name: str, ours: Connection, process: Any) -> Answer:
    with ours:
        try:
            value, error = ours.recv()
        except EOFError:
            process.join()
            value = None
            error = DeviceError(
                f"its driver crashed (exit code {process.exitcode}); restart the device, or "
                "update the driver's packages"
            )
    _end(process)
    return Answer(name, value, error)


def _start(process: Any) -> None:
    """Start a process, and keep blocked the signals that multiprocessing lets through meanwhile."""
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_BLOCK, blocked)


def _end(process: Any) -> None:
    """Let a process that has answered end, but not for ever."""
    process.join(2.0)
    _kill(process)


def _kill(process: Any) -> None:
    if process.pid is None:
        return  # it was never started
    # Not terminate, whose signal the children of the command line do not take.
    process.kill()
    process.join()


def _run(answer: Connection, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    """The child's side."""
    # What a library prints is not to be taken for this command's output.
    os.dup2(2, 1)
    result: tuple[Any, DeviceError | None]
    try:
        result = function(*arguments), None
    except MissingPackageError as error:
        result = None, MissingPackageError(str(error))
    except DeviceError as error:
        # Errors of a driver's own need not survive the way between processes.
        result = None, DeviceError(str(error))
    except KeyboardInterrupt:
        return
    except Exception as error:
        result = None, DeviceError(f"its driver failed: {type(error).__name__}: {error}")
    with suppress(BrokenPipeError):
        answer.send(result)
