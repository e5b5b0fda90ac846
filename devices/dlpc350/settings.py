"""The table of a DLPC350 in ``rig.toml``, and the search for boards."""

from __future__ import annotations

from contextlib import closing
from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from devices.discovery import Found
from devices.errors import DeviceError
from devices.hdmi.settings import HdmiSettings
from devices.interfaces import Projector
from devices.settings import DriverSettings

# How long a board that is only looked for may take to tell about itself.
_ANSWER_S = 3.0

Level = Annotated[int, Field(ge=0, le=255)]


class PictureSource(StrEnum):
    """Where the board takes its pictures from."""

    VIDEO = "video"
    FLASH = "flash"


class Led(StrEnum):
    """A light source of the board."""

    RED = "red"
    GREEN = "green"
    BLUE = "blue"


class LedCurrents(BaseModel):
    """Currents of the three light sources, as shares of the driver's largest in 256 steps.

    Attributes
    ----------
    red, green, blue : int
        0 (none) to 255 (all that the driver gives). The default is that of TI's own software for
        the LightCrafter 4500.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    red: Level = 104
    green: Level = 135
    blue: Level = 130


class StoredPicture(BaseModel):
    """A picture that was stored in the board's flash beforehand.

    Attributes
    ----------
    projection : str
        Name of the projection, or the SHA-256 digest of its image.
    image : int
        Index of the image in flash that holds it.
    bit_depth : int
        1 to 8.
    pattern : int
        Which planes of the image, as in :class:`~devices.dlpc350.messages.FlashPattern`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    projection: str
    image: Annotated[int, Field(ge=0, le=255)]
    bit_depth: Annotated[int, Field(ge=1, le=8)] = 8
    pattern: Annotated[int, Field(ge=0, le=23)] = 0


class Dlpc350Settings(DriverSettings):
    """Settings of a DLPC350.

    Attributes
    ----------
    source : PictureSource
        ``video``: pictures come over the board's video input from ``screen``. ``flash``: they are
        in the board's memory, as ``stored`` tells.
    address : str or None
        ``bus:address`` of the board, where several are plugged in.
    screen : HdmiSettings or None
        The screen that the video input is connected to.
    stored : tuple of StoredPicture
        What the flash holds.
    leds : tuple of Led
        What lights the pictures.
    led_currents, led_current_limits : LedCurrents
        Currents to set, and the largest that are safe with the board's cooling.
    exposure_s, period_s : float
        Of a pattern from flash.
    latency_s : float
        From the start of a pattern from flash until its light is there; loading an image from
        flash is most of it.
    reply_timeout_s : float
        How long the board may take to answer one message.
    timeout_s : float
        How long anything that is asked of the projector may take.
    """

    driver: Literal["dlpc350"] = "dlpc350"
    source: PictureSource
    address: str | None = None
    screen: HdmiSettings | None = None
    stored: tuple[StoredPicture, ...] = ()
    leds: Annotated[tuple[Led, ...], Field(min_length=1)] = (Led.RED, Led.GREEN, Led.BLUE)
    led_currents: LedCurrents = LedCurrents()
    led_current_limits: LedCurrents = LedCurrents()
    exposure_s: Annotated[float, Field(gt=0)] = 0.01
    period_s: Annotated[float, Field(gt=0)] = 0.01
    latency_s: Annotated[float, Field(ge=0)] = 0.25
    reply_timeout_s: Annotated[float, Field(gt=0)] = 1.0
    timeout_s: Annotated[float, Field(gt=0)] = 10.0

    @model_validator(mode="after")
    def _check(self) -> Dlpc350Settings:
        if self.source is PictureSource.VIDEO and self.screen is None:
            raise ValueError('source = "video" needs a table [projector.screen]')
        if self.source is PictureSource.FLASH and not self.stored:
            raise ValueError('source = "flash" needs tables [[projector.stored]]')
        for color in Led:
            asked = getattr(self.led_currents, color)
            limit = getattr(self.led_current_limits, color)
            if asked > limit:
                raise ValueError(
                    f"led_currents.{color} = {asked} is above the safe limit of {limit}; raise "
                    f"led_current_limits.{color} only if the board is cooled for it"
                )
        return self

    def open(self, *, backend: Any = None) -> Projector:
        """Open the board, and the screen before it.

        Parameters
        ----------
        backend : usb.backend.IBackend, optional
            Where to look for the board; libusb by default.

        Raises
        ------
        DeviceError
            There is no such board, it cannot be opened, or it is not well.
        """
        from devices.dlpc350.projector import Dlpc350Projector

        return Dlpc350Projector.open(self, backend=backend)


def find(*, backend: Any = None) -> list[Found]:
    """Boards on this computer's USB, each with its version and state.

    A board is only asked, nothing about it is changed.
    """
    from devices.deadline import Deadline
    from devices.dlpc350.health import check_health, read_version
    from devices.dlpc350.usb_link import UsbLink, address_of, find_boards

    try:
        boards = find_boards(backend)
    except DeviceError as error:
        return [Found("dlpc350", "usb", "", str(error))]
    found = []
    for board in boards:
        model, problem = "", None
        deadline = Deadline.after(_ANSWER_S)
        try:
            with closing(UsbLink(board)) as link:
                version = read_version(link, deadline=deadline)
                model = f"DLPC350, firmware {version}"
                check_health(link, version, deadline=deadline)
        except DeviceError as error:
            problem = str(error)
        found.append(Found("dlpc350", address_of(board), model, problem))
    return found
