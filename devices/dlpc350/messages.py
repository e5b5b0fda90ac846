"""What host and DLPC350 say to each other: USB HID reports, commands by name, status by name.

The protocol is that of Texas Instruments' *DLPC350 Programmer's Guide* (document DLPU010): a
message is a header of flags, sequence number and length, the two bytes of the command, and data,
cut into reports of 64 bytes. The least exposures per bit depth, the order of two image indices and
the inverted LED current are those of TI's own host software for the LightCrafter 4500.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import Enum, IntEnum, IntFlag

from devices.errors import DeviceError

VENDOR_ID, PRODUCT_ID = 0x0451, 0x6401
REPORT_BYTES = 64
PANEL_WIDTH, PANEL_HEIGHT = 912, 1140
BIT_PLANES = 24
MOST_PATTERNS = 128
MOST_IMAGES = 64

_READ, _REPLY, _NACK = 0x80, 0x40, 0x20
_HEADER = struct.Struct("<BBH")

# Shortest exposure of a pattern by bit depth (1 to 8), µs.
LEAST_EXPOSURE_US = (235, 700, 1570, 1700, 2000, 2500, 4500, 8333)
# A period that is longer than its exposure must be longer by this, µs.
LEAST_DARK_US = 230


class Command(Enum):
    """A command: CMD2 and CMD3 as one number, and how many bytes of data its writing takes.

    None stands for data of variable length, 0 for a command that is only read, or has no data.
    """

    VIDEO_SIGNAL = (0x071C, 0)
    POWER = (0x0200, 1)
    VERSION = (0x0205, 0)
    RESET = (0x0802, 0)
    LED_CURRENT = (0x0B01, 3)
    LED_CURRENT_INVERTED = (0x1A05, 1)
    LED_ENABLE = (0x1A07, 1)
    HARDWARE_STATUS = (0x1A0A, 0)
    SYSTEM_STATUS = (0x1A0B, 0)
    MAIN_STATUS = (0x1A0C, 0)
    VALIDATE = (0x1A1A, 1)
    DISPLAY_MODE = (0x1A1B, 1)
    PATTERN_SOURCE = (0x1A22, 1)
    TRIGGER_MODE = (0x1A23, 1)
    PATTERN_RUN = (0x1A24, 1)
    EXPOSURE = (0x1A29, 8)
    PATTERN_CONFIG = (0x1A31, 4)
    MAILBOX_ADDRESS = (0x1A32, 1)
    MAILBOX_CONTROL = (0x1A33, 1)
    MAILBOX_DATA = (0x1A34, None)
    IMAGES_IN_FLASH = (0x1A42, 0)

    def __init__(self, code: int, write_bytes: int | None) -> None:
        self.code = code
        self.write_bytes = write_bytes

    def __str__(self) -> str:
        return f"{self.name.lower().replace('_', ' ')} (0x{self.code:04X})"


class DisplayMode(IntEnum):
    """What the panel shows."""

    VIDEO = 0
    PATTERN = 1


class PatternSource(IntEnum):
    """Where patterns come from."""

    VIDEO = 0
    FLASH = 3


class TriggerMode(IntEnum):
    """What starts a pattern."""

    VSYNC = 0
    INTERNAL_OR_EXTERNAL = 1


class PatternRun(IntEnum):
    """State of the pattern sequence."""

    STOP = 0
    PAUSE = 1
    START = 2


class Mailbox(IntEnum):
    """Tables of the controller that are filled through a mailbox."""

    CLOSED = 0
    IMAGES = 1
    PATTERNS = 2


class Leds(IntFlag):
    """Light sources of a pattern, and who switches them."""

    NONE = 0
    RED = 1
    GREEN = 2
    BLUE = 4
    SEQUENCER = 8


class HardwareStatus(IntFlag):
    """Bits of the hardware status, of which the first one is good news."""

    INITIALISED = 1
    PANEL_RESET_CONTROLLER_ERROR = 4
    FORCED_SWAP_ERROR = 8
    SEQUENCER_ABORTED = 64
    SEQUENCER_ERROR = 128


class MainStatus(IntFlag):
    """Bits of the main status."""

    MIRRORS_PARKED = 1
    SEQUENCER_RUNNING = 2
    FRAME_BUFFER_FROZEN = 4
    GAMMA_CORRECTION = 8


class ValidationStatus(IntFlag):
    """What the controller finds wrong with a sequence; the last bit says that it still looks."""

    EXPOSURE_OR_PERIOD_INVALID = 1
    PATTERN_NUMBER_INVALID = 2
    TRIGGER_OUT_OVERLAPS = 4
    NO_BLACK_BEFORE_EXTERNAL_TRIGGER = 8
    DARK_TIME_TOO_SHORT = 16
    BUSY = 128


def bit_names(flags: IntFlag) -> str:
    """Names of the bits that are set, for messages; "nothing" if none is."""
    known = type(flags)(0)
    for flag in flags:
        known |= flag
    names = [str(flag.name).lower().replace("_", " ") for flag in flags]
    unknown = int(flags) & ~int(known)
    if unknown:
        names.append(f"unknown bits 0x{unknown:02X}")
    return ", ".join(names) or "nothing"


@dataclass(frozen=True)
class Reply:
    """The first report of an answer, taken apart.

    Attributes
    ----------
    refused : bool
        The controller did not accept the command (NACK).
    sequence : int
        Number of the message that it answers.
    length : int
        Bytes of data, of which ``data`` may hold the first ones only.
    data : bytes
    """

    refused: bool
    sequence: int
    length: int
    data: bytes


def pack_message(
    command: Command, *, sequence: int, data: bytes = b"", read: bool = False
) -> list[bytes]:
    """Reports that carry a command.

    Parameters
    ----------
    command : Command
    sequence : int
        0 to 255; the answer carries the same number.
    data : bytes
    read : bool
        Ask for the command's value rather than set it.

    Returns
    -------
    list of bytes
        Reports of 64 bytes, the last one filled up with zeros.

    Raises
    ------
    DeviceError
        The data has not the length that the command takes.
    """
    if not read and command.write_bytes is not None and len(data) != command.write_bytes:
        raise DeviceError(f"{command} takes {command.write_bytes} bytes, not {len(data)}")
    flags = _REPLY | (_READ if read else 0)
    # Little endian puts CMD3 before CMD2.
    message = _HEADER.pack(flags, sequence, len(data) + 2) + struct.pack("<H", command.code) + data
    return [
        message[start : start + REPORT_BYTES].ljust(REPORT_BYTES, b"\0")
        for start in range(0, len(message), REPORT_BYTES)
    ]


def parse_reply(report: bytes) -> Reply:
    """Take the first report of an answer, of 64 bytes, apart."""
    flags, sequence, length = _HEADER.unpack_from(report)
    data = report[_HEADER.size : _HEADER.size + length]
    return Reply(bool(flags & _NACK), sequence, length, data)


@dataclass(frozen=True)
class FlashPattern:
    """One pattern of a sequence from the board's flash.

    Attributes
    ----------
    image : int
        Index of the 24-bit image in flash.
    bit_depth : int
        1 to 8.
    pattern : int
        Which of the image's 24 planes, which stand in the order green, red, blue, least
        significant first: pattern 0 of 8 bit is the green channel, pattern 8 of 1 bit the lowest
        bit of red (DLPU010 tabulates the other depths).
    leds : Leds
        What lights it.
    inverted : bool
        Whether its levels are inverted.

    Raises
    ------
    DeviceError
        There are no such planes.
    """

    image: int
    bit_depth: int
    pattern: int = 0
    leds: Leds = Leds.RED | Leds.GREEN | Leds.BLUE
    inverted: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.bit_depth <= 8:
            raise DeviceError(f"a bit depth of {self.bit_depth} is not one of 1 to 8")
        most = BIT_PLANES // self.bit_depth
        if not 0 <= self.pattern < most:
            raise DeviceError(
                f"an image in flash holds {most} patterns of {self.bit_depth} bit, numbered from "
                f"0, and {self.pattern} is none of them"
            )
        if not 0 <= self.image <= 255:
            raise DeviceError(f"{self.image} is no index of an image in flash")

    def packed(self, *, swap: bool) -> bytes:
        """The three bytes of its entry in the controller's table of patterns.

        Parameters
        ----------
        swap : bool
            Whether it begins another image than the pattern before it.
        """
        internal_trigger = 0
        word = internal_trigger | self.pattern << 2 | self.bit_depth << 8 | int(self.leds) << 12
        word |= int(self.inverted) << 16 | int(swap) << 18
        return word.to_bytes(3, "little")


def pack_images(indices: list[int]) -> bytes:
    """Data of the table of images.

    The controller takes a table of exactly two in the opposite order, as TI's host software knows.
    """
    return bytes(reversed(indices) if len(indices) == 2 else indices)


def pack_exposure(bit_depth: int, *, exposure_s: float, period_s: float) -> bytes:
    """Data of exposure and frame period, once both are allowed.

    Parameters
    ----------
    bit_depth : int
        The largest one of the sequence.
    exposure_s, period_s : float
        Time that each pattern is lit, and time from one to the next, seconds.

    Raises
    ------
    DeviceError
        The exposure is too short for the bit depth, or the time between exposures too short.
    """
    if not (math.isfinite(exposure_s) and math.isfinite(period_s)):
        raise DeviceError(f"exposure {exposure_s} s and period {period_s} s are no times")
    exposure, period = round(exposure_s * 1e6), round(period_s * 1e6)
    least = LEAST_EXPOSURE_US[bit_depth - 1]
    if exposure < least:
        raise DeviceError(
            f"an exposure of {exposure} µs is too short for {bit_depth}-bit patterns, which the "
            f"DLPC350 shows for {least} µs or longer"
        )
    if period != exposure and period < exposure + LEAST_DARK_US:
        raise DeviceError(
            f"a period of {period} µs must equal the exposure of {exposure} µs or exceed it by "
            f"{LEAST_DARK_US} µs"
        )
    if period >= 2**32:
        raise DeviceError(f"a period of {period_s:g} s is longer than the DLPC350 can count")
    return struct.pack("<II", exposure, period)


def pack_config(patterns: int, images: int, *, repeat: bool) -> bytes:
    """Data of the sequence's configuration: lengths are sent as one less than they are.

    The second trigger output fires once per sequence.
    """
    return bytes([patterns - 1, int(repeat), patterns - 1, images - 1])


@dataclass(frozen=True, order=True)
class Version:
    """Version of a part of the firmware."""

    major: int
    minor: int
    patch: int

    @classmethod
    def parse(cls, data: bytes) -> Version:
        """Of the application, which comes first in the answer to :attr:`Command.VERSION`.

        Raises
        ------
        DeviceError
            The answer is too short.
        """
        if len(data) < 4:
            raise DeviceError(f"the DLPC350 told its version in {len(data)} bytes instead of 16")
        patch, minor, major = struct.unpack_from("<HBB", data)
        return cls(major, minor, patch)

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}.{self.patch}"
