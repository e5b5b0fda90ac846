"""The first words with whatever is on a serial port: GRBL 1.1, or what is wrong with it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from devices.deadline import Deadline
from devices.errors import DeviceTimeoutError
from devices.grbl.codes import RealtimeCommand
from devices.grbl.errors import NotGrblError
from devices.grbl.messages import Banner, Garbled, StatusReport
from devices.grbl.serial_line import SerialLine

# Time that a board, reset by the opening of its port, is left alone with its boot loader.
_QUIET_S = 0.2
_ASK_EVERY_S = 0.25
_SUPPORTED = "1.1"


def greet(
    line: SerialLine,
    *,
    name: str,
    boot_timeout_s: float,
    may_reset: bool,
    clock: Callable[[], float] = time.monotonic,
) -> str:
    """Wait until a controller answers.

    Opening the port resets many boards, which then greet when they are up; others just go on and
    answer a request for their status. A controller that has hit a limit answers nothing until it
    is reset.

    Parameters
    ----------
    line : SerialLine
    name : str
        Of the port, for messages.
    boot_timeout_s : float
        How long the controller may take to start.
    may_reset : bool
        Whether one that stays silent for half of that may be reset; otherwise nothing that it does
        is changed.
    clock : callable, optional
        The monotonic clock.

    Returns
    -------
    str
        What it calls itself; ``GRBL 1.1`` if it did not start anew and so did not greet.

    Raises
    ------
    NotGrblError
        Something else answers, or another version.
    DeviceTimeoutError
        Nothing does.
    """
    start = clock()
    end, ask_at = start + boot_timeout_s, start + _QUIET_S
    reset_at = start + boot_timeout_s / 2 if may_reset else math.inf
    garbled = ""
    while clock() < end:
        message = line.receive(Deadline(min(ask_at, end)))
        if isinstance(message, Banner):
            return accept_banner(message, name=name)
        if isinstance(message, StatusReport):
            return f"GRBL {_SUPPORTED}"
        if isinstance(message, Garbled):
            garbled = message.text
        if clock() >= ask_at:
            line.send_realtime(RealtimeCommand.STATUS)
            ask_at = clock() + _ASK_EVERY_S
        if clock() >= reset_at:
            line.send_realtime(RealtimeCommand.RESET)
            reset_at = math.inf
    if line.heard_anything:
        said = f" ({garbled[:40]!r})" if garbled else ""
        raise NotGrblError(
            f"what is on {name} does not answer as GRBL{said}: look whether this is the light "
            "arm's port, and whether the baud rate is that of the firmware"
        )
    raise DeviceTimeoutError(
        f"nothing on {name} answers within {boot_timeout_s:g} s: look whether the controller has "
        "power, neither homes nor is held in reset, and whether this is its port"
    )


def accept_banner(banner: Banner, *, name: str) -> str:
    """What a controller calls itself.

    Raises
    ------
    NotGrblError
        Of a version whose replies are not those of GRBL 1.1.
    """
    model = f"{banner.name} {banner.version}"
    if not banner.version.startswith(_SUPPORTED):
        raise NotGrblError(f"{name} runs {model}; the light arm needs GRBL {_SUPPORTED}")
    return model
