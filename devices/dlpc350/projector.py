"""A LightCrafter 4500 as a projector: pictures from its video input, or patterns from its flash.

The light is out whenever a call has failed, and after closing; LEDs are switched off before
anything else is told to stop.
"""

from __future__ import annotations

import atexit
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from devices.deadline import Deadline
from devices.dlpc350.health import ask_until, check_health, read_byte, read_version
from devices.dlpc350.messages import (
    PANEL_HEIGHT,
    PANEL_WIDTH,
    Command,
    DisplayMode,
    FlashPattern,
    Leds,
    PatternRun,
)
from devices.dlpc350.pattern_sequence import PatternSequence, start_sequence
from devices.dlpc350.settings import Dlpc350Settings, Led, PictureSource, StoredPicture
from devices.dlpc350.usb_link import UsbLink, address_of, find_boards
from devices.errors import DeviceError
from devices.interfaces import Projection, Projector, ProjectorCapabilities

_PUT_OUT_S = 3.0
_SIGNAL_LOCKED = 2


class Dlpc350Projector:
    """A :class:`~devices.interfaces.Projector` behind a DLPC350.

    Parameters
    ----------
    link : UsbLink
        The open board; closed with the projector.
    settings : Dlpc350Settings
    screen : Projector, optional
        What shows pictures on the board's video input; closed with the projector.

    Raises
    ------
    DeviceError
        The board is not well, does not wake up, or receives no picture of its panel's size.
    """

    def __init__(
        self, link: UsbLink, settings: Dlpc350Settings, screen: Projector | None = None
    ) -> None:
        self._link = link
        self._settings = settings
        self._screen = screen
        self._closed = False
        self._lit = False
        atexit.register(self.close)
        try:
            self._prepare(self._deadline(None))
        except BaseException:
            with suppress(DeviceError):
                self.close()
            raise

    @classmethod
    def open(cls, settings: Dlpc350Settings, *, backend: Any = None) -> Dlpc350Projector:
        """Open the board that the settings name, and its screen.

        Raises
        ------
        DeviceError
            There is no such board, or one too many; or it cannot be opened.
        """
        board = _choose(find_boards(backend), settings.address)
        with ExitStack() as undo:
            screen = None
            if settings.source is PictureSource.VIDEO and settings.screen is not None:
                screen = settings.screen.open()
                undo.callback(screen.close)
            link = UsbLink(board, reply_timeout_s=settings.reply_timeout_s)
            undo.callback(link.close)
            projector = cls(link, settings, screen)
            undo.pop_all()
        return projector

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What the projector is."""
        if self._screen is not None:
            inner = self._screen.capabilities
            return ProjectorCapabilities(
                self._model, inner.width, inner.height, inner.frame_period_s
            )
        return ProjectorCapabilities(
            self._model, PANEL_WIDTH, PANEL_HEIGHT, self._settings.period_s
        )

    def show(self, projection: Projection, *, deadline: Deadline | None = None) -> float:
        """Show a picture: on the screen of the video input, or the stored one from flash.

        Returns
        -------
        float
            Monotonic time since when it is there.

        Raises
        ------
        DeviceError
            Not a picture for this panel or not one that is stored, or the board did not do it in
            time; the light is out then.
        """
        deadline = self._deadline(deadline)
        with self._dark_on_failure():
            self.capabilities.check_projection(projection)
            if self._screen is None:
                started = self._run(self._sequence_of(self._stored(projection)), deadline)
                return _wait_until(started + self._settings.latency_s, deadline)
            self._enter(DisplayMode.VIDEO, deadline)
            since = self._screen.show(projection, deadline=deadline)
            if not self._lit:
                self._light(deadline)
                since = max(since, time.monotonic())
            return since

    def play(
        self,
        patterns: Sequence[FlashPattern],
        *,
        exposure_s: float,
        period_s: float,
        repeat: bool = False,
        deadline: Deadline | None = None,
    ) -> float:
        """Run a whole sequence from flash at the board's own pace.

        The board's output TRIG_OUT_1 is high while a pattern is lit, TRIG_OUT_2 pulses once per
        sequence; a camera that is triggered by them takes one frame per pattern.

        Parameters
        ----------
        patterns : sequence of FlashPattern
            At most 128, from at most 64 images.
        exposure_s, period_s : float
            Time that each pattern is lit, and time from one to the next.
        repeat : bool
            Whether to begin again after the last one.

        Returns
        -------
        float
            Monotonic time at which the board had started.

        Raises
        ------
        DeviceError
            The board cannot show such a sequence, or refuses it; the light is out then.
        """
        deadline = self._deadline(deadline)
        with self._dark_on_failure():
            sequence = PatternSequence(
                tuple(patterns), exposure_s=exposure_s, period_s=period_s, repeat=repeat
            )
            return self._run(sequence, deadline)

    def blank(self) -> None:
        """Stop the pattern sequence and put every LED out; harmless at any time."""
        if not self._closed:
            self._put_out()

    def close(self) -> None:
        """Put the light out and give the board back; harmless when closed already."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        with ExitStack() as every:
            if self._screen is not None:
                every.callback(self._screen.close)
            every.callback(self._link.close)
            # A loss that was reported already is not news.
            if not self._link.lost:
                every.callback(self._put_out)

    def _deadline(self, given: Deadline | None) -> Deadline:
        if self._closed:
            raise DeviceError("the projector is closed")
        return given or Deadline.after(self._settings.timeout_s)

    def _prepare(self, deadline: Deadline) -> None:
        version = read_version(self._link, deadline=deadline)
        self._model = f"DLPC350, firmware {version}"
        check_health(self._link, version, deadline=deadline)
        self._wake(deadline)
        self._put_out()
        self._set_currents(deadline)
        if self._screen is not None:
            self._enter(DisplayMode.VIDEO, deadline)
            self._check_signal(self._screen.capabilities.size, deadline)
        else:
            self._images = read_byte(self._link, Command.IMAGES_IN_FLASH, deadline)
            for stored in self._settings.stored:
                self._sequence_of(stored).check_images(self._images)

    def _wake(self, deadline: Deadline) -> None:
        if read_byte(self._link, Command.POWER, deadline):
            self._link.write(Command.POWER, b"\0", deadline=deadline)
        ask_until(
            lambda: read_byte(self._link, Command.POWER, deadline),
            lambda standby: not standby,
            deadline=deadline,
            what="the DLPC350 did not wake from standby",
        )

    def _set_currents(self, deadline: Deadline) -> None:
        currents, leds = self._settings.led_currents, self._settings.leds
        levels = [getattr(currents, color) if color in leds else 0 for color in Led]
        # On TI's own board the largest number is the smallest current.
        if read_byte(self._link, Command.LED_CURRENT_INVERTED, deadline) & 1:
            levels = [255 - level for level in levels]
        self._link.write(Command.LED_CURRENT, bytes(levels), deadline=deadline)
        applied = self._link.read(Command.LED_CURRENT, deadline=deadline)
        if applied != bytes(levels):
            raise DeviceError(
                f"the DLPC350 was told LED currents {levels} and has {list(applied)}; it stays dark"
            )

    def _check_signal(self, size: tuple[int, int], deadline: Deadline) -> None:
        """Refuse a video input that the board would have to scale."""
        signal = ask_until(
            lambda: self._link.read(Command.VIDEO_SIGNAL, deadline=deadline),
            lambda signal: len(signal) >= 5 and signal[0] & 3 == _SIGNAL_LOCKED,
            deadline=deadline,
            what="the DLPC350 (look at its HDMI cable) did not lock to its video input",
        )
        received = (
            int.from_bytes(signal[1:3], "little"),
            int.from_bytes(signal[3:5], "little"),
        )
        if received != size:
            raise DeviceError(
                f"the DLPC350 receives a picture of {received[0]}×{received[1]} while the screen "
                f"shows {size[0]}×{size[1]}; set that mode on the output that the board is "
                "connected to"
            )

    def _enter(self, mode: DisplayMode, deadline: Deadline) -> None:
        if read_byte(self._link, Command.DISPLAY_MODE, deadline) == mode:
            return
        self._lit = False
        self._link.write_surely(Command.LED_ENABLE, bytes([Leds.NONE]), deadline=deadline)
        self._link.write(Command.DISPLAY_MODE, bytes([mode]), deadline=deadline)
        ask_until(
            lambda: read_byte(self._link, Command.DISPLAY_MODE, deadline),
            lambda entered: entered == mode,
            deadline=deadline,
            what=f"the DLPC350 did not change to {mode.name.lower()} mode",
        )

    def _light(self, deadline: Deadline) -> None:
        self._link.write(Command.LED_ENABLE, bytes([Leds.SEQUENCER]), deadline=deadline)
        self._lit = True

    def _put_out(self) -> None:
        """LEDs first: whatever else fails, they are out."""
        deadline = Deadline.after(_PUT_OUT_S)
        self._lit = False
        with ExitStack() as every:
            if self._screen is not None:
                every.callback(self._screen.blank)
            every.callback(self._stop, deadline)
            self._link.write_surely(Command.LED_ENABLE, bytes([Leds.NONE]), deadline=deadline)

    def _stop(self, deadline: Deadline) -> None:
        if read_byte(self._link, Command.DISPLAY_MODE, deadline) == DisplayMode.PATTERN:
            stop = bytes([PatternRun.STOP])
            self._link.write_surely(Command.PATTERN_RUN, stop, deadline=deadline)

    @contextmanager
    def _dark_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            with suppress(DeviceError):
                self._put_out()
            raise

    def _stored(self, projection: Projection) -> StoredPicture:
        table = {stored.projection: stored for stored in self._settings.stored}
        stored = table.get(projection.digest) or table.get(projection.name)
        if stored is None:
            raise DeviceError(
                f"{projection.name!r} is not stored in the board's flash; store it with TI's "
                "software and add a table [[projector.stored]] with its name or its digest "
                f"{projection.digest}"
            )
        return stored

    def _sequence_of(self, stored: StoredPicture) -> PatternSequence:
        """The one picture, over and over."""
        leds = Leds.NONE
        for led in self._settings.leds:
            leds |= Leds[led.name]
        pattern = FlashPattern(stored.image, stored.bit_depth, stored.pattern, leds)
        return PatternSequence(
            (pattern,),
            exposure_s=self._settings.exposure_s,
            period_s=self._settings.period_s,
            repeat=True,
        )

    def _run(self, sequence: PatternSequence, deadline: Deadline) -> float:
        """Load a sequence and start it, once all of it is known to be possible."""
        if self._screen is not None:
            raise DeviceError('patterns from flash need source = "flash" in rig.toml')
        sequence.check_images(self._images)
        self._stop(deadline)
        self._enter(DisplayMode.PATTERN, deadline)
        sequence.load(self._link, deadline=deadline)
        self._light(deadline)
        return start_sequence(self._link, deadline=deadline)


def _choose(boards: list[Any], address: str | None) -> Any:
    there = ", ".join(address_of(board) for board in boards) or "none"
    chosen = [board for board in boards if address in (None, address_of(board))]
    if len(chosen) == 1:
        return chosen[0]
    if not chosen:
        wanted = f" at {address}" if address else ""
        raise DeviceError(
            f"no DLPC350{wanted} on the USB bus (found: {there}); look at its cable and power"
        )
    raise DeviceError(f"several DLPC350 ({there}); name one in rig.toml: address = ...")


def _wait_until(moment: float, deadline: Deadline) -> float:
    time.sleep(max(0.0, min(moment, deadline.at_s) - time.monotonic()))
    if time.monotonic() < moment:
        deadline.require("the DLPC350 could not show the picture")
    return moment
