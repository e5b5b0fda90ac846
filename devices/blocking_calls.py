"""Calls into libraries that block: made one after another in a thread, waited for with a deadline.

A library for cameras may keep a call for seconds when the device is gone, and has no way to cut it
short. Here such a call is waited for in short slices, so that interrupts get through, and given up
at the deadline; the thread goes on with it, and takes no other call before it has returned.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any, TypeVar

from devices.deadline import Deadline
from devices.errors import DeviceTimeoutError

_SLICE_S = 0.05

Result = TypeVar("Result")


@dataclass
class _Call:
    function: Callable[[], Any]
    done: threading.Event = field(default_factory=threading.Event)
    given_up: bool = False
    result: Any = None
    error: BaseException | None = None

    def make(self) -> None:
        if not self.given_up:
            try:
                self.result = self.function()
            except BaseException as error:  # handed to whoever waits
                self.error = error
        self.done.set()


class BlockingCalls:
    """A thread for the calls to one device.

    Parameters
    ----------
    device : str
        What the calls are made to, for messages.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._calls: SimpleQueue[_Call | None] = SimpleQueue()
        self._last: _Call | None = None
        # A daemon: a call that never returns must not keep the program from ending.
        thread = threading.Thread(
            target=_serve, args=(self._calls,), name=f"calls to {device}", daemon=True
        )
        thread.start()

    @property
    def busy(self) -> bool:
        """Whether a call that was given up has still not returned."""
        return self._last is not None and not self._last.done.is_set()

    def call(self, function: Callable[[], Result], *, deadline: Deadline, late: str) -> Result:
        """Make a call and wait for its result.

        Parameters
        ----------
        function : callable
            Takes no arguments.
        deadline : Deadline
        late : str
            What did not happen if it is late, as in :meth:`~devices.deadline.Deadline.require`.

        Returns
        -------
        object
            What the function returned; what it raised is raised.

        Raises
        ------
        DeviceTimeoutError
            It did not return in time, or one before it has still not returned; then the function
            is not called.
        """
        if self._last is not None and not _wait(self._last, deadline):
            raise DeviceTimeoutError(
                f"{late} in time: {self._device} is still busy with a call that was given up"
            )
        call = self._last = _Call(function)
        self._calls.put(call)
        try:
            if not _wait(call, deadline):
                raise DeviceTimeoutError(f"{late} in time")
        finally:
            call.given_up = not call.done.is_set()
        self._last = None
        if call.error is not None:
            raise call.error
        result: Result = call.result
        return result

    def end(self, last: Callable[[], object], *, within_s: float) -> None:
        """Make a last call once the others have returned, and end the thread.

        Errors of the last call are dropped; if it takes longer, it goes on by itself.
        """
        call = _Call(last)
        self._calls.put(call)
        self._calls.put(None)
        _wait(call, Deadline.after(within_s))


def _serve(calls: SimpleQueue[_Call | None]) -> None:
    while (call := calls.get()) is not None:
        call.make()
        # What a call held is let go in this thread, and not kept until the next one.
        del call


def _wait(call: _Call, deadline: Deadline) -> bool:
    """Wait for a call in slices; whether it returned."""
    while not call.done.wait(min(_SLICE_S, deadline.remaining_s)):
        if deadline.passed:
            return call.done.is_set()
    return True
