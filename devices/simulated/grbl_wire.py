"""The serial line between a host and a simulated GRBL controller, with the faults of a script.

A line is first in, first out: what is late holds back what comes after it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from devices.simulated.grbl_controller import SimulatedGrblController
from devices.simulated.grbl_faults import (
    AfterCommand,
    AlarmTrips,
    CommandGarbled,
    CommandLost,
    DoorOpens,
    FallsSilent,
    Fault,
    LampSticks,
    Noise,
    PowerFails,
    RealtimeLost,
    ReplyGarbled,
    ReplyLate,
    ReplyLost,
    ReplyMerged,
    ReplyRepeated,
    ReplySplit,
    Unplugged,
)

_SECONDS_PER_BYTE = 10 / 115_200
_NEWLINE = 0x0A


@dataclass(frozen=True)
class Attempt:
    """Bytes that the host sent, whether or not they arrived.

    Attributes
    ----------
    time_s : float
    data : bytes
    """

    time_s: float
    data: bytes


@dataclass(frozen=True)
class _Parcel:
    """Bytes on their way to the host."""

    ready_s: float
    data: bytes


class SimulatedWire:
    """The line between a host and a simulated controller, with its faults; for one thread.

    Parameters
    ----------
    controller : SimulatedGrblController
    faults : iterable of Fault
    boot_s : float or None
        Time that the board takes to start when its port is opened; None for a board that does not
        start anew then.

    Attributes
    ----------
    faults : list of Fault
        May be added to.
    commands : int
        Lines that the host has sent so far.
    plugged : bool
        Whether the plug is in.
    attempts : list of Attempt
        Everything that the host has sent.
    """

    def __init__(
        self,
        controller: SimulatedGrblController,
        faults: Iterable[Fault] = (),
        *,
        boot_s: float | None = None,
    ) -> None:
        self.controller = controller
        self.faults = list(faults)
        self._boot_s = boot_s
        self.commands = 0
        self._singles = self._replies = 0
        self._line = bytearray()
        self._parcels: deque[_Parcel] = deque()
        self._due: list[tuple[float, Callable[[float], None]]] = []
        self._mute = self._deaf = False
        self._booted_s = 0.0
        self.plugged = True
        self.attempts: list[Attempt] = []

    def opened(self, now_s: float) -> None:
        """The host opens the port."""
        self.pass_time(now_s)
        if self._boot_s is not None:
            self.controller.power_cycle()
            self._booted_s = now_s + self._boot_s
            self._line.clear()

    def send(self, data: bytes, now_s: float) -> None:
        """Bytes from the host.

        Raises
        ------
        OSError
            The plug is out.
        """
        self.pass_time(now_s)
        self.attempts.append(Attempt(now_s, data))
        self._require_plug()
        if now_s < self._booted_s:
            return  # the boot loader has no use for them
        for byte in data:
            if byte in b"?!~\x18" or byte >= 0x80:
                self._pass_single(byte)
                continue
            self._line.append(byte)
            if byte == _NEWLINE:
                line, self._line = bytes(self._line), bytearray()
                self._pass_command(line, now_s)

    def collect(self, now_s: float) -> bytes:
        """Bytes that have reached the host.

        Raises
        ------
        OSError
            The plug is out.
        """
        self.pass_time(now_s)
        self._require_plug()
        data = bytearray()
        while self._parcels and self._parcels[0].ready_s <= now_s:
            data += self._parcels.popleft().data
        return bytes(data)

    def next_change_s(self) -> float:
        """Time at which something may reach the host by itself."""
        times = [self.controller.next_change_s(), *(time_s for time_s, _ in self._due)]
        if self._parcels:
            times.append(self._parcels[0].ready_s)
        return min(times)

    def later(self, time_s: float, happen: Callable[[float], None]) -> None:
        """Have something happen at a time, which it is given."""
        if math.isfinite(time_s):
            self._due.append((time_s, happen))

    def pass_time(self, now_s: float) -> None:
        """Let time pass, with what is due on the way."""
        while self._due:
            self._due.sort(key=lambda due: due[0])
            time_s, happen = self._due[0]
            if time_s > now_s:
                break
            del self._due[0]
            self._say_until(time_s)
            happen(time_s)
        self._say_until(now_s)

    def _say_until(self, now_s: float) -> None:
        self.controller.advance(now_s)
        for line in self.controller.replies():
            self._pass_reply(line.encode("ascii") + b"\r\n", now_s)

    def _pass_single(self, byte: int) -> None:
        number, self._singles = self._singles, self._singles + 1
        if byte == 0x18:
            self._line.clear()
        lost = any(
            isinstance(fault, RealtimeLost) and fault.command == number for fault in self.faults
        )
        if not (lost or self._deaf):
            self.controller.receive(bytes([byte]))

    def _pass_command(self, line: bytes, now_s: float) -> None:
        number, self.commands = self.commands, self.commands + 1
        for fault in self.faults:
            if getattr(fault, "command", None) != number or isinstance(fault, RealtimeLost):
                continue
            if isinstance(fault, CommandLost):
                line = b""
            elif isinstance(fault, CommandGarbled):
                place = fault.place % max(len(line) - 1, 1)
                line = line[:place] + bytes([fault.byte]) + line[place + 1 :]
            elif isinstance(fault, AfterCommand):
                self._schedule(fault, now_s + fault.delay_s)
        if not self._deaf:
            self.controller.receive(line)

    def _schedule(self, fault: AfterCommand, time_s: float) -> None:
        def happen(now_s: float) -> None:
            if isinstance(fault, PowerFails):
                self.controller.power_cycle()
            elif isinstance(fault, Unplugged):
                self.plugged = False
                self._parcels.clear()
                self.later(now_s + fault.back_after_s, self._plug_in)
            elif isinstance(fault, FallsSilent):
                self._mute, self._deaf = True, fault.deaf
            elif isinstance(fault, AlarmTrips):
                self.controller.trip_alarm(fault.code)
            elif isinstance(fault, DoorOpens):
                self.controller.open_door()
                self.later(now_s + fault.closes_after_s, lambda _: self.controller.close_door())
            elif isinstance(fault, LampSticks):
                self.controller.stick_lamp()

        self.later(time_s, happen)

    def _plug_in(self, now_s: float) -> None:
        self.plugged = True

    def _require_plug(self) -> None:
        if not self.plugged:
            raise OSError("device disconnected")

    def _pass_reply(self, line: bytes, now_s: float) -> None:
        """Put a reply on its way, as the faults have it."""
        if self._mute or not self.plugged:
            return
        if not line.strip():
            self._post(line, now_s)
            return
        number, self._replies = self._replies, self._replies + 1
        pieces, late = [(line, 0.0)], 0.0
        for fault in self.faults:
            if getattr(fault, "reply", None) != number:
                continue
            if isinstance(fault, ReplyLost):
                return
            if isinstance(fault, ReplyLate):
                late += fault.seconds
            elif isinstance(fault, Noise):
                pieces.insert(0, (fault.data, 0.0))
            elif isinstance(fault, ReplyRepeated):
                pieces += [piece for piece in pieces if piece[0].endswith(b"\n")]
            else:
                whole, pause = pieces[-1]
                pieces[-1:] = _altered(fault, whole, pause)
        for data, pause in pieces:
            self._post(data, now_s + late + pause)

    def _post(self, data: bytes, time_s: float) -> None:
        before = self._parcels[-1].ready_s if self._parcels else -math.inf
        ready = max(time_s, before, self._booted_s) + len(data) * _SECONDS_PER_BYTE
        self._parcels.append(_Parcel(ready, data))


def _altered(fault: Fault, line: bytes, pause: float) -> list[tuple[bytes, float]]:
    """Pieces of a reply, each with the pause before it."""
    if isinstance(fault, ReplyMerged):
        return [(line.rstrip(b"\r\n"), pause)]
    if isinstance(fault, ReplySplit):
        place = fault.after % len(line)
        return [(line[:place], pause), (line[place:], pause + fault.seconds)]
    if isinstance(fault, ReplyGarbled):
        place = fault.place % len(line)
        return [(line[:place] + bytes([fault.byte]) + line[place + 1 :], pause)]
    return [(line, pause)]
