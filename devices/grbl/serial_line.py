"""The serial line to a GRBL controller: bytes to messages, waits in short slices, names for faults.

A wait never blocks longer than a slice inside the operating system, so that an interruption of the
main thread, which is no signal (see ``workstation.interruption``), strikes within one.
"""

from __future__ import annotations

import contextlib
import errno
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceLostError
from devices.grbl.codes import RealtimeCommand
from devices.grbl.messages import Garbled, Message, parse_line
from devices.optional_packages import import_optional

SLICE_S = 0.05
"""Longest wait inside the operating system."""

_WRITE_TIMEOUT_S = 0.5
# No line of GRBL comes near this many bytes.
_LONGEST_LINE = 1024


class SerialPort(Protocol):
    """What is used of a :class:`serial.Serial`, whose reads time out after :data:`SLICE_S`."""

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once."""

    def read(self, size: int) -> bytes:
        """Up to ``size`` bytes; fewer after the time-out."""

    def write(self, data: bytes) -> int | None:
        """Send bytes."""

    def close(self) -> None:
        """Release the port."""


def open_serial_port(address: str, baud_rate: int) -> SerialPort:
    """Open a serial port for nobody else.

    Raises
    ------
    DeviceError
        It is not there, not ours to use, or in use; the message says which.
    """
    serial = import_optional(
        "serial", needed_by="the light arm", install=".venv/bin/pip install pyserial"
    )
    try:
        return serial.Serial(
            address,
            baud_rate,
            timeout=SLICE_S,
            write_timeout=_WRITE_TIMEOUT_S,
            exclusive=True,
        )
    except ValueError as error:
        raise DeviceError(f"{address} cannot run at {baud_rate} baud: {error}") from None
    except Exception as error:  # pyserial lets termios.error through, which is no OSError
        raise DeviceError(f"{address} {_why_not(error)}") from error


def _why_not(error: Exception) -> str:
    # pyserial words some errors itself, and leaves the system's number in what it wraps.
    numbers = [
        one.args[0]
        for one in (error, error.__context__)
        if one and one.args and isinstance(one.args[0], int)
    ]
    number = numbers[0] if numbers else None
    if number in (errno.EACCES, errno.EPERM):
        return "may not be opened: add yourself to its group (often dialout) and log in again"
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK):
        return "is in use by another program: close that and try again"
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return "is not there: plug the controller in, and look for its port with impasto devices"
    if number in (errno.ENOTTY, errno.EINVAL, errno.EISDIR):
        return "is no serial port: look for the controller's with impasto devices"
    return f"cannot be opened: {error}"


class SerialLine:
    """Messages from, and lines and single bytes to, a controller.

    Parameters
    ----------
    port : SerialPort
    name : str
        Of the port, for messages.
    clock : callable, optional
        The monotonic clock; a simulated one in tests.
    """

    def __init__(
        self, port: SerialPort, *, name: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._port = port
        self._name = name
        self._clock = clock
        self._bytes = bytearray()
        self._messages: deque[Message] = deque()
        self.heard_anything = False
        """Whether a single byte has come yet."""

    def send_line(self, text: str) -> None:
        """Send a line.

        Raises
        ------
        DeviceLostError
            The port is gone, or takes no bytes.
        """
        self._write(text.encode("ascii") + b"\n")

    def send_realtime(self, command: RealtimeCommand) -> None:
        """Send a single byte that acts at once.

        Raises
        ------
        DeviceLostError
            The port is gone, or takes no bytes.
        """
        self._write(bytes([command]))

    def receive(self, deadline: Deadline) -> Message | None:
        """The next message; None if none came by the deadline.

        Raises
        ------
        DeviceLostError
            The port is gone.
        """
        while not self._messages:
            if self._clock() >= deadline.at_s and not self._waiting():
                return None
            self._take(self._read(1))
            self._take(self._read(self._waiting()))
        return self._messages.popleft()

    def received(self) -> list[Message]:
        """Everything that has come already, without waiting.

        Raises
        ------
        DeviceLostError
            The port is gone.
        """
        self._take(self._read(self._waiting()))
        messages = list(self._messages)
        self._messages.clear()
        return messages

    def close(self) -> None:
        """Release the port; never fails."""
        with contextlib.suppress(Exception):  # a port that is gone is released already
            self._port.close()

    def _take(self, data: bytes) -> None:
        """Cut bytes into lines; a line end in either style counts."""
        self.heard_anything |= bool(data)
        self._bytes += data
        *lines, rest = bytes(self._bytes).split(b"\n")
        self._bytes = bytearray(rest)
        for line in lines:
            self._messages.extend(parse_line(line.decode("ascii", errors="replace")))
        if len(self._bytes) > _LONGEST_LINE:
            self._messages.append(Garbled(f"{len(self._bytes)} bytes without a line end"))
            self._bytes.clear()

    def _waiting(self) -> int:
        try:
            return self._port.in_waiting
        except Exception as error:
            raise self._lost(error) from error

    def _read(self, size: int) -> bytes:
        if size == 0:
            return b""
        try:
            return self._port.read(size)
        except Exception as error:
            raise self._lost(error) from error

    def _write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except Exception as error:
            raise self._lost(error) from error

    def _lost(self, error: Exception) -> DeviceLostError:
        return DeviceLostError(
            f"the light arm's controller is gone from {self._name} ({error}); plug it in again "
            "and home the arm"
        )
