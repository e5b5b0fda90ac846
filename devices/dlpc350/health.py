"""What a DLPC350 says of itself: version, status bits (DLPU010, chapter on status commands)."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from devices.deadline import Deadline
from devices.dlpc350.messages import Command, HardwareStatus, Version, bit_names
from devices.dlpc350.usb_link import UsbLink
from devices.errors import DeviceError, DeviceTimeoutError

_Answer = TypeVar("_Answer")

# Older firmware keeps its images elsewhere and does not tell their number.
_OLDEST_FIRMWARE = Version(3, 0, 0)
_ERRORS = (
    HardwareStatus.PANEL_RESET_CONTROLLER_ERROR
    | HardwareStatus.SEQUENCER_ABORTED
    | HardwareStatus.SEQUENCER_ERROR
)
_MEMORY_TEST_PASSED = 1
_POLL_S = 0.01


def read_byte(link: UsbLink, command: Command, deadline: Deadline) -> int:
    """Value of a command that answers with one byte, or with one that matters first.

    Raises
    ------
    DeviceError
        The answer is empty, or as :meth:`~devices.dlpc350.usb_link.UsbLink.read`.
    """
    answer = link.read(command, deadline=deadline)
    if not answer:
        raise DeviceError(f"the DLPC350 answers {command} with no data")
    return answer[0]


def ask_until(
    ask: Callable[[], _Answer], done: Callable[[_Answer], bool], *, deadline: Deadline, what: str
) -> _Answer:
    """Ask until an answer is the one that is waited for.

    Parameters
    ----------
    ask : callable
        Asks the board once.
    done : callable
        Whether an answer ends the waiting.
    deadline : Deadline
    what : str
        What is being waited for, as in :meth:`~devices.deadline.Deadline.require`.

    Raises
    ------
    DeviceTimeoutError
        The deadline does not allow another question, or passed with the last one.
    """
    answer = ask()
    while not done(answer):
        if deadline.remaining_s <= _POLL_S:
            raise DeviceTimeoutError(f"{what} in time")
        time.sleep(_POLL_S)
        try:
            answer = ask()
        except DeviceTimeoutError as error:
            # A board that answered until now did not fall silent because nobody listens any more.
            if deadline.passed:
                raise DeviceTimeoutError(f"{what} in time") from error
            raise
    return answer


def check_hardware(link: UsbLink, *, deadline: Deadline) -> None:
    """Refuse a board whose hardware status shows an error.

    Raises
    ------
    DeviceError
        It does; the bits are named.
    """
    hardware = HardwareStatus(read_byte(link, Command.HARDWARE_STATUS, deadline))
    if HardwareStatus.INITIALISED not in hardware:
        raise DeviceError(
            "the DLPC350 has not finished its own start; wait, or switch it off and on"
        )
    if hardware & _ERRORS:
        raise DeviceError(
            f"the DLPC350 reports {bit_names(hardware & _ERRORS)}; switch it off and on"
        )


def check_health(link: UsbLink, version: Version, *, deadline: Deadline) -> None:
    """Refuse a board that is too old or not well.

    Raises
    ------
    DeviceError
        What is wrong with it, and what to do.
    """
    if version < _OLDEST_FIRMWARE:
        raise DeviceError(
            f"the DLPC350's firmware {version} is older than {_OLDEST_FIRMWARE}; update it with "
            "TI's software"
        )
    check_hardware(link, deadline=deadline)
    if not read_byte(link, Command.SYSTEM_STATUS, deadline) & _MEMORY_TEST_PASSED:
        raise DeviceError("the DLPC350's test of its internal memory failed; switch it off and on")


def read_version(link: UsbLink, *, deadline: Deadline) -> Version:
    """Version of the board's firmware.

    Raises
    ------
    DeviceError
        It does not tell.
    """
    return Version.parse(link.read(Command.VERSION, deadline=deadline))
