"""The USB side of a simulated DLPC350: a backend for pyusb with faults by script.

Anything that talks to the board through pyusb talks to this one unchanged, given the backend.
"""

# ruff: noqa: D102 - the methods are those of usb.backend.IBackend, and documented there.

from __future__ import annotations

import errno
from array import array
from collections import deque
from dataclasses import dataclass, field
from enum import Enum, auto
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from devices.dlpc350.messages import Command
from devices.simulated.dlpc350_board import SimulatedDlpc350

_REPORT = 64
_VENDOR, _PRODUCT = 0x0451, 0x6401
_OUT, _IN = 0x01, 0x81


class Fault(Enum):
    """What can go wrong with one message."""

    NACK = auto()
    LOST_REPLY = auto()
    LATE_REPLY = auto()
    STALE_REPLY = auto()
    TRUNCATED_REPORT = auto()


@dataclass
class _Script:
    fault: Fault
    on: Command | None
    times: int


@dataclass
class SimulatedUsbBackend(usb.backend.IBackend):
    """One board on a USB bus of its own.

    Attributes
    ----------
    board : SimulatedDlpc350
    kernel_driver : bool
        Whether the kernel's driver holds the interface.
    claimed : bool
        Whether a program holds the interface.
    open_error : int or None
        ``errno`` of every attempt to open the board: ``EACCES`` for a missing permission.
    claim_error : int or None
        ``errno`` of every attempt to claim it: ``EBUSY`` while another program has it.
    unplug_after : int or None
        Transfers after which the board is unplugged.
    """

    board: SimulatedDlpc350 = field(default_factory=SimulatedDlpc350)
    kernel_driver: bool = True
    claimed: bool = False
    open_error: int | None = None
    claim_error: int | None = None
    unplug_after: int | None = None

    def __post_init__(self) -> None:
        super().__init__()
        self.transfers = 0
        self._scripts: list[_Script] = []
        self._replies: deque[bytes] = deque()
        self._late: list[bytes] = []
        self._message = b""
        self._wanted = 0

    def inject(self, fault: Fault, *, on: Command | None = None, times: int = 1) -> None:
        """Have a fault happen to the next messages, or to the next ones of a command."""
        self._scripts.append(_Script(fault, on, times))

    def leave_reply(self, report: bytes) -> None:
        """Leave an answer unread, as a program does that was killed between question and answer."""
        self._replies.append(report.ljust(_REPORT, b"\0"))

    @property
    def plugged_in(self) -> bool:
        """Whether the board is still there."""
        return self.unplug_after is None or self.transfers < self.unplug_after

    # What pyusb asks about the device.

    def enumerate_devices(self) -> list[int]:
        return [0] if self.plugged_in else []

    def get_device_descriptor(self, dev: int) -> SimpleNamespace:
        return SimpleNamespace(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x0110,
            bDeviceClass=0,
            bDeviceSubClass=0,
            bDeviceProtocol=0,
            bMaxPacketSize0=64,
            idVendor=_VENDOR,
            idProduct=_PRODUCT,
            bcdDevice=0x0100,
            iManufacturer=0,
            iProduct=0,
            iSerialNumber=0,
            bNumConfigurations=1,
            address=7,
            bus=3,
            port_number=1,
            port_numbers=(1,),
            speed=2,
        )

    def get_configuration_descriptor(self, dev: int, config: int) -> SimpleNamespace:
        if config:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=2,
            wTotalLength=41,
            bNumInterfaces=1,
            bConfigurationValue=1,
            iConfiguration=0,
            bmAttributes=0xC0,
            bMaxPower=50,
            extra_descriptors=b"",
        )

    def get_interface_descriptor(
        self, dev: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        if intf or alt:
            raise IndexError(intf)
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=4,
            bInterfaceNumber=0,
            bAlternateSetting=0,
            bNumEndpoints=2,
            bInterfaceClass=3,
            bInterfaceSubClass=0,
            bInterfaceProtocol=0,
            iInterface=0,
            extra_descriptors=b"",
        )

    def get_endpoint_descriptor(
        self, dev: int, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        return SimpleNamespace(
            bLength=7,
            bDescriptorType=5,
            bEndpointAddress=(_OUT, _IN)[ep],
            bmAttributes=3,
            wMaxPacketSize=_REPORT,
            bInterval=1,
            bRefresh=0,
            bSynchAddress=0,
            extra_descriptors=b"",
        )

    # What pyusb does with it.

    def open_device(self, dev: int) -> int:
        if self.open_error is not None:
            raise _usb_error(self.open_error)
        self._count(0)
        return dev

    def close_device(self, dev_handle: int) -> None:
        self.claimed = False

    def set_configuration(self, dev_handle: int, config_value: int) -> None:
        self._count(0)

    def get_configuration(self, dev_handle: int) -> int:
        return 1

    def claim_interface(self, dev_handle: int, intf: int) -> None:
        if self.claim_error is not None or self.kernel_driver or self.claimed:
            raise _usb_error(self.claim_error or errno.EBUSY)
        self.claimed = True

    def release_interface(self, dev_handle: int, intf: int) -> None:
        self._count(0)
        self.claimed = False

    def is_kernel_driver_active(self, dev_handle: int, intf: int) -> bool:
        return self.kernel_driver

    def detach_kernel_driver(self, dev_handle: int, intf: int) -> None:
        self.kernel_driver = False

    def attach_kernel_driver(self, dev_handle: int, intf: int) -> None:
        self.kernel_driver = True

    def reset_device(self, dev_handle: int) -> None:
        self._replies.clear()

    def intr_write(self, dev_handle: int, ep: int, intf: int, data: Any, timeout: int) -> int:
        self._count(1)
        report = bytes(data)
        if ep != _OUT or len(report) != _REPORT:
            raise _usb_error(errno.EPIPE)
        if not self._message:
            self._wanted = 4 + int.from_bytes(report[2:4], "little")
        self._message += report
        if len(self._message) >= self._wanted:
            message, self._message = self._message[: self._wanted], b""
            self._take(message)
        return len(report)

    def intr_read(self, dev_handle: int, ep: int, intf: int, buff: Any, timeout: int) -> int:
        self._count(1)
        if not self._replies:
            # Time passes for the program that waits: what was late is there next time.
            self._replies.extend(self._late)
            self._late.clear()
            raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
        reply = self._replies.popleft()
        buff[: len(reply)] = array("B", reply)
        return len(reply)

    def _count(self, transfers: int) -> None:
        if not self.plugged_in:
            raise _usb_error(errno.ENODEV)
        self.transfers += transfers

    def _take(self, message: bytes) -> None:
        """Have the board answer a message, with what the script does to the answer."""
        command = int.from_bytes(message[4:6], "little")
        faults = self._due(command)
        if Fault.NACK in faults:
            accepted, data = False, b""
        else:
            accepted, data = self.board.answer(message)
        flags = message[0] | (0 if accepted else 0x20)
        whole = bytes([flags, message[1]]) + len(data).to_bytes(2, "little") + data
        reports = [
            whole[start : start + _REPORT].ljust(_REPORT, b"\0")
            for start in range(0, len(whole), _REPORT)
        ]
        if Fault.STALE_REPLY in faults:
            self._replies.append(bytes([flags, message[1] - 1 & 255, 1, 0, 0xEE]).ljust(64, b"\0"))
        if Fault.TRUNCATED_REPORT in faults:
            reports[-1] = reports[-1][:10]
        if Fault.LATE_REPLY in faults:
            self._late.extend(reports)
        elif Fault.LOST_REPLY not in faults and message[0] & 0x40:
            self._replies.extend(reports)

    def _due(self, code: int) -> list[Fault]:
        due = []
        for script in self._scripts:
            if script.times > 0 and (script.on is None or script.on.code == code):
                script.times -= 1
                due.append(script.fault)
        return due


def _usb_error(number: int) -> usb.core.USBError:
    names = {
        errno.ENODEV: "No such device (it may have been disconnected)",
        errno.EACCES: "Access denied (insufficient permissions)",
        errno.EBUSY: "Resource busy",
        errno.EPIPE: "Pipe error",
    }
    return usb.core.USBError(names.get(number, "Input/Output Error"), -1, number)
