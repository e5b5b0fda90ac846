"""Ports to a simulated GRBL controller: a pseudo-terminal in real time, or one in virtual time.

pyserial opens the pseudo-terminal as it opens any port. The other stands in for the port object
itself, on a clock of its own that jumps from event to event, so that hours pass in no time and
every run is the same.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import tempfile
import threading
import time
import tty
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType

from devices.errors import DeviceError
from devices.simulated.grbl_controller import SimulatedGrblController
from devices.simulated.grbl_faults import Fault
from devices.simulated.grbl_wire import SimulatedWire

_POLL_S = 0.002
_READ_TIMEOUT_S = 0.05
_SECONDS_PER_BYTE = 10 / 115_200


class VirtualClock:
    """A monotonic clock that moves when told to, and a little each time somebody looks at it."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        """Seconds since its start."""
        self.now_s += 1e-6
        return self.now_s


class VirtualPort:
    """A :class:`~devices.grbl.serial_line.SerialPort` in virtual time.

    Parameters
    ----------
    wire : SimulatedWire
    clock : VirtualClock

    Raises
    ------
    DeviceError
        The plug is out.
    """

    def __init__(self, wire: SimulatedWire, clock: VirtualClock) -> None:
        self._wire = wire
        self._clock = clock
        self._bytes = bytearray()
        self._open = True
        wire.opened(clock.now_s)
        if not wire.plugged:
            raise DeviceError("the simulated port is not there: plug the controller in")

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once."""
        self._pull()
        return len(self._bytes)

    def read(self, size: int) -> bytes:
        """Up to ``size`` bytes; fewer after the time-out."""
        end = self._clock.now_s + _READ_TIMEOUT_S
        self._pull()
        while len(self._bytes) < size and self._clock.now_s < end:
            change = max(self._wire.next_change_s(), self._clock.now_s + 1e-6)
            self._clock.now_s = min(change, end)
            self._pull()
        data = bytes(self._bytes[:size])
        del self._bytes[:size]
        return data

    def write(self, data: bytes) -> int:
        """Send bytes."""
        self._require_open()
        self._clock.now_s += len(data) * _SECONDS_PER_BYTE
        self._wire.send(data, self._clock.now_s)
        return len(data)

    def close(self) -> None:
        """Release the port."""
        self._open = False

    def _pull(self) -> None:
        self._require_open()
        self._bytes += self._wire.collect(self._clock.now_s)

    def _require_open(self) -> None:
        if not self._open:
            raise OSError("the port is closed")


class SimulatedGrblPort:
    """A controller behind a pseudo-terminal, served by a thread; a context manager.

    Parameters
    ----------
    controller : SimulatedGrblController
    faults : iterable of Fault
    time_scale : float
        How many of the controller's seconds pass in one.
    boot_s : float or None
        As of :class:`~devices.simulated.grbl_wire.SimulatedWire`.

    Attributes
    ----------
    address : str
        Path to open; the same after it was unplugged and plugged in again.
    """

    def __init__(
        self,
        controller: SimulatedGrblController,
        faults: Iterable[Fault] = (),
        *,
        time_scale: float = 1.0,
        boot_s: float | None = None,
    ) -> None:
        self._wire = SimulatedWire(controller, faults, boot_s=boot_s)
        self._time_scale = time_scale
        self._start_s = time.monotonic() - controller.now_s / time_scale
        self._folder = tempfile.TemporaryDirectory(prefix="simulated-grbl-")
        self.address = str(Path(self._folder.name) / "port")
        self._lock = threading.Lock()
        self._master: int | None = None
        self._opened = False
        self._done = threading.Event()
        self._plug_in()
        self._thread = threading.Thread(target=self._serve, daemon=True, name="simulated GRBL")
        self._thread.start()

    @property
    def sent(self) -> bytes:
        """Everything that the host has sent."""
        with self._lock:
            return b"".join(attempt.data for attempt in self._wire.attempts)

    def controller_time_s(self, monotonic_s: float) -> float:
        """The controller's time at a time of the monotonic clock."""
        return (monotonic_s - self._start_s) * self._time_scale

    def unplug(self) -> None:
        """Pull the plug."""
        with self._lock:
            self._wire.plugged = False

    def plug_in(self) -> None:
        """Put the plug back in."""
        with self._lock:
            self._wire.plugged = True

    def close(self) -> None:
        """Take the port away, and end its thread."""
        self._done.set()
        self._thread.join()
        self._pull_out()
        self._folder.cleanup()

    def __enter__(self) -> SimulatedGrblPort:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _serve(self) -> None:
        while not self._done.is_set():
            with self._lock:
                moved = self._serve_once()
            if not moved:
                self._done.wait(_POLL_S)

    def _serve_once(self) -> bool:
        """Carry what waits both ways; whether anything did, and more may."""
        now_s = self.controller_time_s(time.monotonic())
        if self._wire.plugged != (self._master is not None):
            if self._wire.plugged:
                self._plug_in()
            else:
                self._pull_out()
        if self._master is None:
            self._wire.pass_time(now_s)
            return False
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        events = dict(poll.poll(1000 * _POLL_S)).get(self._master, 0)
        if events & select.POLLHUP and not events & select.POLLIN:
            self._opened = False
            with contextlib.suppress(OSError):
                self._wire.collect(now_s)  # nobody listens
            return False
        if not self._opened:
            self._opened = True
            self._wire.opened(now_s)
        with contextlib.suppress(OSError):
            if events & select.POLLIN:
                self._wire.send(os.read(self._master, 4096), now_s)
            data = self._wire.collect(self.controller_time_s(time.monotonic()))
            if data:
                os.write(self._master, data)
        return True

    def _plug_in(self) -> None:
        self._master, slave = pty.openpty()
        os.set_blocking(self._master, False)
        tty.setraw(slave)
        target = os.ttyname(slave)
        os.close(slave)  # so that a host's opening and closing show
        link = Path(self.address)
        link.unlink(missing_ok=True)
        link.symlink_to(target)

    def _pull_out(self) -> None:
        if self._master is not None:
            Path(self.address).unlink(missing_ok=True)
            os.close(self._master)
            self._master = None
            self._opened = False
