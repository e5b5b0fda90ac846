"""The table of a GenICam camera in ``rig.toml``, and the search for such cameras."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field

from devices.discovery import Found
from devices.interfaces import Camera
from devices.settings import DriverSettings

_SEARCH_S = 10.0


class Trigger(StrEnum):
    """What begins an exposure."""

    SOFTWARE = "software"
    SINGLE_FRAME = "single frame"


class AravisSettings(DriverSettings):
    """Settings of a GenICam camera.

    Attributes
    ----------
    camera : str or None
        Identifier, serial number, IP or MAC address, as ``impasto devices`` lists them; may be left
        out where there is just one.
    pixel_format : str or None
        As GenICam calls it: one raw sample per pixel, such as ``Mono12`` or ``BayerRG8``; by
        default the deepest that the camera has.
    trigger : Trigger
        ``software``: the camera waits for a command. ``single frame``: acquisition is started for
        each frame, for cameras without a software trigger.
    gain, black_level : float or None
        Fixed, in the camera's unit. The gain is the lowest by default; the black level is left as
        the camera has it.
    saturation_level : int or None
        Sensor number of a saturated sample, where that is below the format's largest.
    packet_size : int or None
        Bytes of a packet; by default the largest that the network lets through.
    attempts : int
        How often a frame is taken that arrives with gaps.
    instant_exposures : bool
        Whether frames may arrive sooner than they can have been exposed. Only simulated cameras
        do that; a real one would have sent an old frame.
    timeout_s : float
        How long opening may take, and a frame beyond its exposure.
    """

    driver: Literal["aravis"] = "aravis"
    camera: str | None = None
    pixel_format: str | None = None
    trigger: Trigger = Trigger.SOFTWARE
    gain: float | None = None
    black_level: float | None = None
    saturation_level: Annotated[int, Field(gt=0, le=65535)] | None = None
    packet_size: Annotated[int, Field(ge=576, le=16384)] | None = None
    attempts: Annotated[int, Field(ge=1, le=100)] = 3
    instant_exposures: bool = False
    timeout_s: Annotated[float, Field(gt=0, le=600)] = 8.0

    def open(self) -> Camera:
        """Open the camera, with everything automatic switched off.

        Raises
        ------
        DeviceError
            There is no such camera, another program has it, or it cannot be made to deliver raw
            samples; or Aravis is missing.
        """
        from devices.aravis.camera import AravisCamera

        return AravisCamera(self)


def find() -> list[Found]:
    """GenICam cameras on this computer's networks and USB.

    A camera is only looked at, nothing about it is changed.

    Raises
    ------
    MissingPackageError
        Aravis is not installed.
    """
    from devices.aravis.cameras import find_cameras
    from devices.blocking_calls import BlockingCalls
    from devices.deadline import Deadline
    from devices.errors import DeviceError, MissingPackageError

    calls = BlockingCalls("the search for cameras")
    try:
        return calls.call(
            find_cameras,
            deadline=Deadline.after(_SEARCH_S),
            late="the search for GenICam cameras did not end",
        )
    except MissingPackageError:
        raise
    except DeviceError as error:
        return [Found("aravis", "network and USB", "", str(error))]
    finally:
        calls.end(lambda: None, within_s=0)
