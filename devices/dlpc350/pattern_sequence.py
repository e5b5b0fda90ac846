"""Sequences of patterns from a DLPC350's flash: what is allowed, how one is loaded and started.

Order of commands and rules of exposure are those of TI's *DLPC350 Programmer's Guide* (DLPU010):
stop, display mode, source, configuration, trigger, exposure, tables through the mailbox, validate,
start.
"""

from __future__ import annotations

import time
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise

from devices.deadline import Deadline
from devices.dlpc350.health import ask_until, check_hardware, read_byte
from devices.dlpc350.messages import (
    MOST_IMAGES,
    MOST_PATTERNS,
    Command,
    FlashPattern,
    Mailbox,
    MainStatus,
    PatternRun,
    PatternSource,
    TriggerMode,
    ValidationStatus,
    bit_names,
    pack_config,
    pack_exposure,
    pack_images,
)
from devices.dlpc350.usb_link import UsbLink
from devices.errors import DeviceError


@dataclass(frozen=True)
class PatternSequence:
    """Patterns from flash, one after the other at the board's own pace.

    Attributes
    ----------
    patterns : tuple of FlashPattern
        At most 128, which load an image at most 64 times.
    exposure_s, period_s : float
        Time that each pattern is lit, and time from one to the next.
    repeat : bool
        Whether it begins again after the last one.

    Raises
    ------
    DeviceError
        The board cannot show such a sequence.
    """

    patterns: tuple[FlashPattern, ...]
    _: KW_ONLY
    exposure_s: float
    period_s: float
    repeat: bool

    def __post_init__(self) -> None:
        if not 1 <= len(self.patterns) <= MOST_PATTERNS:
            raise DeviceError(
                f"a sequence of {len(self.patterns)} patterns is not one of 1 to {MOST_PATTERNS}"
            )
        loads = len(self.images)
        if loads > MOST_IMAGES:
            raise DeviceError(
                f"the sequence loads images {loads} times and the DLPC350 does so {MOST_IMAGES} "
                "times at most; group patterns of the same image"
            )
        self._packed_exposure()

    @property
    def images(self) -> list[int]:
        """Images in the order in which they are loaded."""
        return [
            pattern.image
            for pattern, begins in zip(self.patterns, self._begins_image(), strict=True)
            if begins
        ]

    def check_images(self, in_flash: int) -> None:
        """Refuse images that the flash does not hold.

        Raises
        ------
        DeviceError
            There are some.
        """
        missing = sorted({image for image in self.images if image >= in_flash})
        if missing:
            raise DeviceError(
                f"image {missing[0]} is not in the board's flash, which holds {in_flash}, numbered "
                "from 0"
            )

    def load(self, link: UsbLink, *, deadline: Deadline) -> None:
        """Fill the tables of a board that is stopped and in pattern mode, and have it check them.

        Raises
        ------
        DeviceError
            The board refuses something; what is wrong is named.
        """
        images = self.images
        config = pack_config(len(self.patterns), len(images), repeat=self.repeat)
        for command, data in (
            (Command.PATTERN_SOURCE, bytes([PatternSource.FLASH])),
            (Command.PATTERN_CONFIG, config),
            (Command.TRIGGER_MODE, bytes([TriggerMode.INTERNAL_OR_EXTERNAL])),
            (Command.EXPOSURE, self._packed_exposure()),
        ):
            link.write(command, data, deadline=deadline)
        entries = [
            pattern.packed(swap=begins)
            for pattern, begins in zip(self.patterns, self._begins_image(), strict=True)
        ]
        _fill(link, Mailbox.PATTERNS, entries, deadline)
        _fill(link, Mailbox.IMAGES, [pack_images(images)], deadline)
        _validate(link, deadline)

    def _begins_image(self) -> list[bool]:
        """Whether each pattern is of another image than the one before it."""
        images = [pattern.image for pattern in self.patterns]
        return [True, *(a != b for a, b in pairwise(images))]

    def _packed_exposure(self) -> bytes:
        depth = max(pattern.bit_depth for pattern in self.patterns)
        return pack_exposure(depth, exposure_s=self.exposure_s, period_s=self.period_s)


def start_sequence(link: UsbLink, *, deadline: Deadline) -> float:
    """Start the sequence that was loaded.

    Returns
    -------
    float
        Monotonic time at which the board had said that it runs.

    Raises
    ------
    DeviceError
        It does not start.
    """
    link.write(Command.PATTERN_RUN, bytes([PatternRun.START]), deadline=deadline)

    def runs() -> bool:
        if MainStatus.SEQUENCER_RUNNING in MainStatus(
            read_byte(link, Command.MAIN_STATUS, deadline)
        ):
            return True
        check_hardware(link, deadline=deadline)
        return False

    ask_until(runs, bool, deadline=deadline, what="the DLPC350 did not start the sequence")
    return time.monotonic()


def _fill(link: UsbLink, mailbox: Mailbox, entries: list[bytes], deadline: Deadline) -> None:
    link.write(Command.MAILBOX_CONTROL, bytes([mailbox]), deadline=deadline)
    for address, entry in enumerate(entries):
        link.write(Command.MAILBOX_ADDRESS, bytes([address]), deadline=deadline)
        link.write(Command.MAILBOX_DATA, entry, deadline=deadline)
    link.write(Command.MAILBOX_CONTROL, bytes([Mailbox.CLOSED]), deadline=deadline)


def _validate(link: UsbLink, deadline: Deadline) -> None:
    link.write(Command.VALIDATE, b"\0", deadline=deadline)
    status = ask_until(
        lambda: ValidationStatus(read_byte(link, Command.VALIDATE, deadline)),
        lambda status: ValidationStatus.BUSY not in status,
        deadline=deadline,
        what="the DLPC350 did not validate the sequence",
    )
    if status:
        raise DeviceError(f"the DLPC350 finds the sequence wrong: {bit_names(status)}")
