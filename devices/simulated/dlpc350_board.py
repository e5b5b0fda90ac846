"""A simulated DLPC350: what the controller keeps, what it answers, and what it refuses.

Written from TI's *DLPC350 Programmer's Guide* (DLPU010) on the controller's side: it takes reports
apart on its own and shares with the driver only the names of commands and bits.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from devices.dlpc350.messages import Command, Leds, MainStatus, ValidationStatus

_BY_CODE = {command.code: command for command in Command}
# Shortest exposure of 1 to 8 bit, µs, and the shortest time between exposures.
_LEAST_US = {1: 235, 2: 700, 3: 1570, 4: 1700, 5: 2000, 6: 2500, 7: 4500, 8: 8333}
_DARK_US = 230
_FATAL = (
    ValidationStatus.EXPOSURE_OR_PERIOD_INVALID
    | ValidationStatus.PATTERN_NUMBER_INVALID
    | ValidationStatus.DARK_TIME_TOO_SHORT
)
_VIDEO, _PATTERN = 0, 1
_STOP, _PAUSE, _START = 0, 1, 2
# Commands that only a stopped sequence in pattern mode takes.
_CONFIGURATION = (
    Command.PATTERN_SOURCE,
    Command.TRIGGER_MODE,
    Command.EXPOSURE,
    Command.PATTERN_CONFIG,
    Command.MAILBOX_CONTROL,
    Command.MAILBOX_ADDRESS,
    Command.MAILBOX_DATA,
    Command.VALIDATE,
)


@dataclass
class SimulatedDlpc350:
    """State of a board; its fields are what a test looks at, or sets beforehand.

    Attributes
    ----------
    version : (int, int, int)
        Of the firmware.
    images_in_flash : int
    inverted_currents : bool
        Whether the largest number is the smallest LED current, as on TI's own board.
    video_signal : (int, int) or None
        Size that arrives at the video input; None without a signal.
    validation_reads : int
        How often the board says that it still validates before it tells the outcome.
    hardware_status, system_status : int
    standby : bool
    display_mode, source, trigger_mode, run : int
    exposure_us : (int, int)
        Exposure and frame period.
    patterns : dict of int to bytes
        The table of patterns by address.
    images : tuple of int
        The table of images.
    led_enable : int
    led_currents : (int, int, int)
        As written.
    history : list of (Command, bytes)
        Every command that was written and accepted.
    """

    version: tuple[int, int, int] = (4, 1, 0)
    images_in_flash: int = 12
    inverted_currents: bool = True
    video_signal: tuple[int, int] | None = (912, 1140)
    validation_reads: int = 2
    hardware_status: int = 1
    system_status: int = 1
    standby: bool = False
    display_mode: int = _VIDEO
    source: int = 0
    trigger_mode: int = 0
    run: int = _STOP
    exposure_us: tuple[int, int] = (0, 0)
    config: tuple[int, int, int, int] = (0, 0, 0, 0)
    mailbox: int = 0
    address: int = 0
    patterns: dict[int, bytes] = field(default_factory=dict)
    images: tuple[int, ...] = ()
    validation: ValidationStatus | None = None
    led_enable: int = int(Leds.SEQUENCER)
    led_currents: tuple[int, int, int] = (151, 120, 125)
    history: list[tuple[Command, bytes]] = field(default_factory=list)

    @property
    def lit(self) -> bool:
        """Whether light leaves the projector."""
        if self.standby or self.led_enable == 0:
            return False
        none = 255 if self.inverted_currents else 0
        if all(current == none for current in self.led_currents):
            return False
        by_hand = not self.led_enable & Leds.SEQUENCER
        return by_hand or self.display_mode == _VIDEO or self.run != _STOP

    def answer(self, message: bytes) -> tuple[bool, bytes]:
        """Take one whole message (without filling), and answer it.

        Returns
        -------
        accepted : bool
            False for NACK.
        data : bytes
            Of the answer to a read.
        """
        code = int.from_bytes(message[4:6], "little")
        command = _BY_CODE.get(code)
        if command is None:
            return False, b""
        if message[0] & 0x80:
            return True, self._read(command)
        data = message[6:]
        accepted = self._allowed(command, data) and self._write(command, data)
        if accepted:
            self.history.append((command, data))
        return accepted, b""

    def _read(self, command: Command) -> bytes:
        main = MainStatus(0)
        if self.run == _START:
            main |= MainStatus.SEQUENCER_RUNNING
        if self.standby:
            main |= MainStatus.MIRRORS_PARKED
        major, minor, patch = self.version
        answers: dict[Command, Callable[[], bytes]] = {
            Command.VERSION: lambda: struct.pack("<HBB", patch, minor, major) * 4,
            Command.HARDWARE_STATUS: lambda: bytes([self.hardware_status]),
            Command.SYSTEM_STATUS: lambda: bytes([self.system_status]),
            Command.MAIN_STATUS: lambda: bytes([main]),
            Command.POWER: lambda: bytes([self.standby]),
            Command.DISPLAY_MODE: lambda: bytes([self.display_mode]),
            Command.PATTERN_SOURCE: lambda: bytes([self.source]),
            Command.TRIGGER_MODE: lambda: bytes([self.trigger_mode]),
            Command.PATTERN_RUN: lambda: bytes([self.run]),
            Command.EXPOSURE: lambda: struct.pack("<II", *self.exposure_us),
            Command.PATTERN_CONFIG: lambda: bytes(self.config),
            Command.LED_ENABLE: lambda: bytes([self.led_enable]),
            Command.LED_CURRENT: lambda: bytes(self.led_currents),
            Command.LED_CURRENT_INVERTED: lambda: bytes([self.inverted_currents]),
            Command.IMAGES_IN_FLASH: lambda: bytes([self.images_in_flash]),
            Command.VIDEO_SIGNAL: self._video_signal,
            Command.VALIDATE: self._validation_status,
            Command.MAILBOX_DATA: self._table,
        }
        return answers.get(command, lambda: b"")()

    def _video_signal(self) -> bytes:
        if self.video_signal is None:
            return bytes(28)
        return struct.pack("<BHH", 2, *self.video_signal).ljust(28, b"\0")

    def _validation_status(self) -> bytes:
        if self._reads_left > 0:
            self._reads_left -= 1
            return bytes([ValidationStatus.BUSY])
        return bytes([self.validation or 0])

    def _table(self) -> bytes:
        if self.mailbox == 1:
            return bytes(self.images)
        return b"".join(self.patterns[address] for address in sorted(self.patterns))

    def _allowed(self, command: Command, data: bytes) -> bool:
        """Whether the state allows a command, and its data has the length that belongs to it."""
        if command.write_bytes is not None and len(data) != command.write_bytes:
            return False
        if self.standby and command not in (Command.POWER, Command.RESET):
            return False
        if command is Command.DISPLAY_MODE:
            return self.run == _STOP
        if command in _CONFIGURATION:
            return self.display_mode == _PATTERN and self.run == _STOP
        return True

    def _write(self, command: Command, data: bytes) -> bool:
        """Obey; False if the data makes no sense now."""
        if command in _CONFIGURATION and command is not Command.VALIDATE:
            self.validation = None
        writes: dict[Command, Callable[[bytes], bool]] = {
            Command.POWER: lambda d: self._set("standby", bool(d[0]), d[0] in (0, 1)),
            Command.DISPLAY_MODE: lambda d: self._set("display_mode", d[0], d[0] in (0, 1)),
            Command.PATTERN_SOURCE: lambda d: self._set("source", d[0], d[0] in (0, 3)),
            Command.TRIGGER_MODE: lambda d: self._set("trigger_mode", d[0], d[0] <= 4),
            Command.EXPOSURE: lambda d: self._set("exposure_us", struct.unpack("<II", d)),
            Command.PATTERN_CONFIG: lambda d: self._set("config", tuple(d), d[0] < 128),
            Command.LED_ENABLE: lambda d: self._set("led_enable", d[0], d[0] < 16),
            Command.LED_CURRENT: lambda d: self._set("led_currents", tuple(d)),
            Command.LED_CURRENT_INVERTED: lambda d: self._set("inverted_currents", bool(d[0])),
            Command.MAILBOX_CONTROL: lambda d: self._set("mailbox", d[0], d[0] <= 3),
            Command.MAILBOX_ADDRESS: self._set_address,
            Command.MAILBOX_DATA: self._fill_table,
            Command.VALIDATE: self._validate,
            Command.PATTERN_RUN: self._set_run,
            Command.RESET: self._reset,
        }
        obey = writes.get(command)
        return obey is not None and obey(data)

    def _set(self, name: str, value: object, valid: bool = True) -> bool:
        if valid:
            setattr(self, name, value)
        return valid

    def _set_address(self, data: bytes) -> bool:
        return self._set("address", data[0], self.mailbox != 0 and data[0] < 128)

    def _fill_table(self, data: bytes) -> bool:
        if self.mailbox == 1 and 1 <= len(data) <= 64:
            # The controller's own oddity: a table of two is taken in the opposite order.
            self.images = tuple(reversed(data)) if len(data) == 2 else tuple(data)
            return True
        entries, rest = divmod(len(data), 3)
        if self.mailbox != 2 or rest or not 1 <= entries <= 128 - self.address:
            return False
        for entry in range(entries):
            self.patterns[self.address + entry] = data[3 * entry : 3 * entry + 3]
        return True

    def _validate(self, data: bytes) -> bool:
        self._reads_left = self.validation_reads
        status = ValidationStatus(0)
        count = self.config[0] + 1
        exposure, period = self.exposure_us
        entries = [self.patterns.get(address, b"\0\0\0") for address in range(count)]
        depths = [entry[1] & 15 for entry in entries]
        for entry, depth in zip(entries, depths, strict=True):
            # Pattern 24 of one bit is the white filling that the controller makes itself.
            most = 25 if depth == 1 else 24 // max(depth, 1)
            if not 1 <= depth <= 8 or entry[0] >> 2 >= most:
                status |= ValidationStatus.PATTERN_NUMBER_INVALID
        least = max(_LEAST_US.get(depth, 0) for depth in depths)
        if exposure < least or exposure > period:
            status |= ValidationStatus.EXPOSURE_OR_PERIOD_INVALID
        if 0 < period - exposure < _DARK_US:
            status |= ValidationStatus.DARK_TIME_TOO_SHORT
        if self.source == 3 and not self._images_fit(entries):
            status |= ValidationStatus.PATTERN_NUMBER_INVALID
        self.validation = status
        return True

    def _images_fit(self, entries: list[bytes]) -> bool:
        """Whether the entries load as many images as the table holds, and all are in flash."""
        swaps = sum(bool(entry[2] & 4) for entry in entries)
        known = all(image < self.images_in_flash for image in self.images)
        return known and swaps == len(self.images) == self.config[3] + 1

    def _set_run(self, data: bytes) -> bool:
        if data[0] == _STOP:
            return self._set("run", _STOP)
        if self.display_mode != _PATTERN or data[0] not in (_PAUSE, _START):
            return False
        if data[0] == _PAUSE:
            return self._set("run", _PAUSE, self.run == _START)
        valid = self.validation is not None and not self.validation & _FATAL
        return self._set("run", _START, valid)

    def _reset(self, data: bytes) -> bool:
        self.run, self.display_mode, self.mailbox = _STOP, _VIDEO, 0
        self.patterns, self.images, self.validation = {}, (), None
        self.led_enable = int(Leds.SEQUENCER)
        return True

    _reads_left: int = 0
