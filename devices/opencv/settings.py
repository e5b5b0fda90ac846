"""The table of a camera behind OpenCV's VideoCapture in ``rig.toml``, and the search for such."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from devices.bayer import BayerPattern
from devices.discovery import Found
from devices.interfaces import Camera
from devices.settings import Address, DriverSettings


class Backend(StrEnum):
    """What OpenCV opens a source with."""

    V4L2 = "v4l2"
    FFMPEG = "ffmpeg"
    IMAGES = "images"
    GSTREAMER = "gstreamer"
    DIRECT_SHOW = "dshow"
    MEDIA_FOUNDATION = "msmf"


class ExposureUnit(StrEnum):
    """What the number of ``CAP_PROP_EXPOSURE`` is in: each backend has its own."""

    HUNDRED_MICROSECONDS = "100 us"
    MICROSECONDS = "us"
    MILLISECONDS = "ms"
    SECONDS = "s"
    POWERS_OF_TWO = "log2 s"


class Channel(StrEnum):
    """One colour of a picture that was converted."""

    RED = "red"
    GREEN = "green"
    BLUE = "blue"


class OpencvSettings(DriverSettings):
    """Settings of a camera behind OpenCV's VideoCapture.

    Attributes
    ----------
    source : int or str
        Number or path of a video device, a stream's address, a video file, or numbered pictures
        (``frames/img_%04d.png``).
    backend : Backend or None
        By default V4L2 for devices, pictures for numbered pictures, and OpenCV's choice else.
    pixel_format : str or None
        Four letters to set on a device, such as ``GREY``, ``Y16``, ``BA81``.
    width, height : int or None
        Size to set on a device.
    bits : int or None
        Of a sample, where fewer are used than it has room for.
    bayer : BayerPattern or None
        Mosaic, where the pixel format does not tell.
    channel : Channel or None
        Take one colour of pictures that camera or OpenCV have converted to colours. Such samples
        went through interpolation and mostly through a gamma curve: without this key they are
        refused.
    allow_lossy : bool
        Whether compressed pictures (MJPEG, H.264, JPEG) will do.
    exposure_unit : ExposureUnit or None
        By default that of the backend.
    manual_exposure : float
        Number of ``CAP_PROP_AUTO_EXPOSURE`` that switches the automatic exposure off: 1 with V4L2,
        0.25 with DirectShow.
    exposure_range_s : (float, float) or None
        By default what the device tells.
    fixed_exposure_s : float or None
        Exposure of a camera that lets nobody set it, or of a recording; no other is taken then.
    gain : float or None
        Fixed, in the device's unit; by default left as it is.
    linear_gamma : float
        Number of ``CAP_PROP_GAMMA`` that means a straight line, for devices that have one.
    properties : dict of str to float
        More of OpenCV's properties to set and read back, such as ``SHARPNESS = 0``.
    buffers : int
        Frames that may have been exposed before they are asked for: they are dropped.
    settling_frames : int
        Frames until a new exposure is in force: they are dropped too.
    timeout_s : float
        How long opening may take, and a frame beyond its exposure.
    """

    driver: Literal["opencv"] = "opencv"
    source: Annotated[int, Field(ge=0)] | Address
    backend: Backend | None = None
    pixel_format: Annotated[str, Field(min_length=3, max_length=4)] | None = None
    width: Annotated[int, Field(gt=0)] | None = None
    height: Annotated[int, Field(gt=0)] | None = None
    bits: Annotated[int, Field(ge=8, le=16)] | None = None
    bayer: BayerPattern | None = None
    channel: Channel | None = None
    allow_lossy: bool = False
    exposure_unit: ExposureUnit | None = None
    manual_exposure: float = 1.0
    exposure_range_s: tuple[float, float] | None = None
    fixed_exposure_s: Annotated[float, Field(gt=0)] | None = None
    gain: float | None = None
    linear_gamma: float = 100.0
    properties: dict[str, float] = Field(default_factory=dict)
    buffers: Annotated[int, Field(ge=0, le=64)] = 4
    settling_frames: Annotated[int, Field(ge=0, le=100)] = 2
    timeout_s: Annotated[float, Field(gt=0, le=600)] = 10.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        limits = self.exposure_range_s
        if limits is not None and not 0 < limits[0] < limits[1]:
            raise ValueError("exposure_range_s must rise from the shortest to the longest")
        if self.channel is not None and self.bayer is not None:
            raise ValueError("a picture that was converted to colours has no mosaic: drop one key")
        return self

    def open(self, *, capture: Callable[..., Any] | None = None) -> Camera:
        """Open the source and look at its first picture.

        Parameters
        ----------
        capture : callable, optional
            In place of :class:`cv2.VideoCapture`.

        Raises
        ------
        DeviceError
            The source cannot be opened, its pictures are not raw samples, or its exposure cannot
            be set.
        """
        from devices.opencv.camera import VideoCamera

        return VideoCamera(self, capture=capture)


def find() -> list[Found]:
    """Video devices of this computer, with what is wrong with them."""
    from devices.opencv.video_devices import find_video_devices

    return find_video_devices()
