"""Messages to a DLPC350 and its answers over pyusb, each answer held against its question.

A reply that carries the number of an earlier message is late or stale and is dropped; a refusal
(NACK), a lost reply, a short report and an unplugged cable are errors with names. Reading may be
repeated, and so may commands that put light out; nothing else is.
"""

from __future__ import annotations

import errno
from typing import Any

import usb.core
import usb.util

from devices.deadline import Deadline
from devices.dlpc350.messages import (
    PRODUCT_ID,
    REPORT_BYTES,
    VENDOR_ID,
    Command,
    pack_message,
    parse_reply,
)
from devices.errors import DeviceError, DeviceLostError, DeviceTimeoutError

_INTERFACE = 0
_OUT, _IN = 0x01, 0x81
_ATTEMPTS = 3
# How long a reply that nobody waited for is looked for when a link opens, seconds.
_DRAIN_S = 0.02
_GONE = (errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN)
_UDEV_RULE = (
    f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{VENDOR_ID:04x}", '
    f'ATTR{{idProduct}}=="{PRODUCT_ID:04x}", TAG+="uaccess"'
)


def find_boards(backend: Any = None) -> list[Any]:
    """Every DLPC350 on this computer's USB, opened by nobody yet.

    Parameters
    ----------
    backend : usb.backend.IBackend, optional
        Where to look; libusb by default.

    Raises
    ------
    DeviceError
        libusb is not installed, or does not answer.
    """
    try:
        return list(
            usb.core.find(find_all=True, idVendor=VENDOR_ID, idProduct=PRODUCT_ID, backend=backend)
        )
    except usb.core.NoBackendError:
        raise DeviceError("pyusb finds no libusb; install it: apt install libusb-1.0-0") from None
    except usb.core.USBError as error:
        raise DeviceError(f"USB devices cannot be listed: {error}") from error


def address_of(board: Any) -> str:
    """Where a board is plugged in, as people and ``rig.toml`` write it: ``bus:address``."""
    return f"{board.bus}:{board.address}"


class UsbLink:
    """The open connection to one board; closing gives it back as it was found.

    Parameters
    ----------
    board : usb.core.Device
        One of :func:`find_boards`.
    reply_timeout_s : float
        How long the board may take to answer.

    Raises
    ------
    DeviceError
        No permission, another program holds the board, or it is gone.
    """

    def __init__(self, board: Any, *, reply_timeout_s: float = 1.0) -> None:
        self._board = board
        self._reply_timeout_s = reply_timeout_s
        self._sequence = 0
        self._kernel_driver_detached = False
        self._open = True
        self._loss: str | None = None
        try:
            self._claim()
            self._drain()
        except BaseException:
            self.close()
            raise

    @property
    def lost(self) -> bool:
        """Whether the board is gone."""
        return self._loss is not None

    def read(self, command: Command, *, deadline: Deadline) -> bytes:
        """Value of a command; asked again if the answer does not arrive.

        Raises
        ------
        DeviceError
            As :meth:`write`.
        """
        return self._repeat(command, b"", read=True, deadline=deadline)

    def write(self, command: Command, data: bytes = b"", *, deadline: Deadline) -> None:
        """Give a command, once, and wait for its acknowledgement.

        Raises
        ------
        DeviceError
            The board refuses it, or its answer makes no sense.
        DeviceTimeoutError
            No answer in time.
        DeviceLostError
            The board is gone.
        """
        self._exchange(command, data, read=False, deadline=deadline)

    def write_surely(self, command: Command, data: bytes = b"", *, deadline: Deadline) -> None:
        """Give a command that may be given twice, as often as it takes to be acknowledged.

        Raises
        ------
        DeviceError
            As :meth:`write`.
        """
        self._repeat(command, data, read=False, deadline=deadline)

    def close(self) -> None:
        """Give the board back to the kernel; harmless when closed already."""
        if not self._open:
            return
        self._open = False
        try:
            usb.util.release_interface(self._board, _INTERFACE)
            if self._kernel_driver_detached:
                self._board.attach_kernel_driver(_INTERFACE)
        except usb.core.USBError:
            # A board that is gone takes nothing back, and the kernel cleans up behind it.
            pass
        finally:
            usb.util.dispose_resources(self._board)

    def _claim(self) -> None:
        try:
            if self._board.is_kernel_driver_active(_INTERFACE):
                self._board.detach_kernel_driver(_INTERFACE)
                self._kernel_driver_detached = True
            usb.util.claim_interface(self._board, _INTERFACE)
        except usb.core.USBError as error:
            raise self._named(error, "be opened") from error

    def _drain(self) -> None:
        """Drop replies that an earlier program left unread."""
        wait = Deadline.after(self._reply_timeout_s)
        try:
            while not wait.passed:
                self._board.read(_IN, REPORT_BYTES, timeout=_milliseconds(_DRAIN_S))
        except usb.core.USBTimeoutError:
            return
        except usb.core.USBError as error:
            raise self._named(error, "be read") from error
        raise DeviceError(
            f"the DLPC350 at {address_of(self._board)} sends reports without being asked; unplug "
            "it and plug it in again"
        )

    def _repeat(self, command: Command, data: bytes, *, read: bool, deadline: Deadline) -> bytes:
        """Ask again after a lost reply; put light out again after anything but a loss."""
        again = DeviceTimeoutError if read else DeviceError
        for _ in range(_ATTEMPTS - 1):
            try:
                return self._exchange(command, data, read=read, deadline=deadline)
            except DeviceLostError:
                raise
            except again:
                deadline.require(f"the DLPC350 did not answer {command}")
        return self._exchange(command, data, read=read, deadline=deadline)

    def _exchange(self, command: Command, data: bytes, *, read: bool, deadline: Deadline) -> bytes:
        if self._loss is not None:
            raise DeviceLostError(self._loss)
        if not self._open:
            raise DeviceError("the DLPC350 is closed")
        deadline.require(f"the DLPC350 could not be given {command}")
        self._sequence = (self._sequence + 1) % 256
        wait = deadline.earlier(self._reply_timeout_s)
        for report in pack_message(command, sequence=self._sequence, data=data, read=read):
            self._send(report, command, wait)
        return self._receive(command, data, wait)

    def _send(self, report: bytes, command: Command, wait: Deadline) -> None:
        try:
            sent = self._board.write(_OUT, report, timeout=_milliseconds(wait.remaining_s))
        except usb.core.USBError as error:
            raise self._named(error, f"be given {command}") from error
        if sent != len(report):
            raise DeviceError(f"only {sent} of {len(report)} bytes of {command} went out over USB")

    def _receive(self, command: Command, data: bytes, wait: Deadline) -> bytes:
        while True:
            reply = parse_reply(self._receive_report(command, wait))
            if reply.sequence == self._sequence:
                break
            wait.require(f"the DLPC350 answers old questions only and did not answer {command}")
        if reply.refused:
            sent = f" with {data.hex(' ')}" if data else ""
            raise DeviceError(
                f"the DLPC350 refuses {command}{sent} (NACK); what came before it does not allow "
                "it, or its firmware does not know it"
            )
        answer = reply.data
        while len(answer) < reply.length:
            answer += self._receive_report(command, wait)[: reply.length - len(answer)]
        return answer

    def _receive_report(self, command: Command, wait: Deadline) -> bytes:
        try:
            timeout = _milliseconds(wait.remaining_s)
            report = bytes(self._board.read(_IN, REPORT_BYTES, timeout=timeout))
        except usb.core.USBError as error:
            raise self._named(error, f"answer {command}") from error
        if len(report) != REPORT_BYTES:
            raise DeviceError(
                f"the DLPC350 answered {command} in a report of {len(report)} bytes where "
                f"{REPORT_BYTES} belong; look at the USB cable"
            )
        return report

    def _named(self, error: usb.core.USBError, doing: str) -> DeviceError:
        """What a USB error means."""
        where = f"the DLPC350 at {address_of(self._board)}"
        if error.errno in _GONE:
            self._loss = (
                f"{where} is gone and could not {doing}: it was unplugged or lost power; if it is "
                "still lit, switch it off by hand, plug it in and open it again"
            )
            return DeviceLostError(self._loss)
        if isinstance(error, usb.core.USBTimeoutError) or error.errno == errno.ETIMEDOUT:
            return DeviceTimeoutError(f"{where} did not {doing} in time; look at its cable")
        if error.errno == errno.EACCES:
            return DeviceError(
                f"{where} may not {doing} by this user; write the line {_UDEV_RULE} to "
                "/etc/udev/rules.d/70-dlpc350.rules, run udevadm control --reload, and plug the "
                "board in again"
            )
        if error.errno == errno.EBUSY:
            return DeviceError(f"{where} is in use by another program; close that")
        return DeviceError(f"{where} could not {doing}: {error}; look at its cable")


def _milliseconds(seconds: float) -> int:
    # Zero would mean to libusb that it should wait for ever.
    return max(1, round(seconds * 1000))
