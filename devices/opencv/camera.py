"""A camera behind OpenCV's VideoCapture that takes one raw frame at a time.

A device goes on exposing by itself and keeps some frames waiting. Frames are dropped until one
comes that was exposed after it was asked for: by the kernel's time stamp where there is one, else
by counting, and by the time at which it came.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import cv2
from numpy.typing import NDArray

from devices.blocking_calls import BlockingCalls
from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceLostError
from devices.interfaces import CameraCapabilities, Frame
from devices.opencv.device_properties import DeviceProperties, from_unit, to_unit, unit_of
from devices.opencv.raw_formats import (
    RAW_FORMATS,
    check_grey,
    check_lossless,
    code_name,
    raw_samples,
)
from devices.opencv.settings import Backend, ExposureUnit, OpencvSettings
from devices.opencv.video_devices import exposure_range_s

_END_S = 1.0
_PAUSE_S = 0.01
# A device may be reading one frame out and exposing another when a frame is asked for.
_IN_THE_DEVICE = 2
# A time stamp further from now is on another clock.
_FAR_S = 10.0
_BACKENDS = {
    Backend.V4L2: cv2.CAP_V4L2,
    Backend.FFMPEG: cv2.CAP_FFMPEG,
    Backend.IMAGES: cv2.CAP_IMAGES,
    Backend.GSTREAMER: cv2.CAP_GSTREAMER,
    Backend.DIRECT_SHOW: cv2.CAP_DSHOW,
    Backend.MEDIA_FOUNDATION: cv2.CAP_MSMF,
}
_OFF = (
    ("AUTO_WB", 0.0, "the camera would scale its colours"),
    ("AUTOFOCUS", 0.0, "the lens would change the picture's scale"),
    ("BACKLIGHT", 0.0, "the camera would change its exposure by what it sees"),
)

Result = TypeVar("Result")


class VideoCamera:
    """A :class:`~devices.interfaces.Camera` behind a VideoCapture.

    Parameters
    ----------
    settings : OpencvSettings
    capture : callable, optional
        In place of :class:`cv2.VideoCapture`.

    Raises
    ------
    DeviceError
        The source cannot be opened, its pictures are not raw samples, or its exposure cannot be
        set.
    """

    def __init__(
        self, settings: OpencvSettings, *, capture: Callable[..., Any] | None = None
    ) -> None:
        self._settings = settings
        self._new_capture = capture or cv2.VideoCapture
        self._calls = BlockingCalls("the camera")
        self._capture: Any = None
        self._closed = False
        self._lost = ""
        self._sequence = 0
        self._ended_s = 0.0
        self._exposure_s: float | None = None
        self._applied_s = settings.fixed_exposure_s or 0.0
        # The first picture of a recording, which was looked at.
        self._first: NDArray | None = None
        deadline = Deadline.after(settings.timeout_s)
        try:
            self._ask(self._prepare, deadline, f"{settings.source} did not open")
            self._describe(deadline)
        except BaseException:
            self.close()
            raise

    @property
    def capabilities(self) -> CameraCapabilities:
        """What the camera is."""
        return self._capabilities

    def capture(self, exposure_s: float, *, deadline: Deadline | None = None) -> Frame:
        """Take one frame, exposed after this call.

        Raises
        ------
        DeviceError
            The exposure is out of range or cannot be set, or the picture is not of raw samples.
        DeviceTimeoutError
            The frame is not there by the deadline.
        DeviceLostError
            The device is gone, or the recording has ended.
        """
        if self._closed:
            raise DeviceError("the camera is closed")
        self.capabilities.check_exposure(exposure_s)
        deadline = deadline or Deadline.after(exposure_s + self._settings.timeout_s)
        settling = self._expose(exposure_s, deadline)
        if self._recorded:
            image, ended = self._next_recorded(deadline)
            self._ended_s = ended
        else:
            ended = self._grab_fresh(settling, deadline)
            image = self._retrieve(deadline)
        self._check_same_kind(image)
        self._sequence += 1
        wall_time = time.time() + ended - time.monotonic()
        return Frame(image, self._sequence, exposure_s, self._applied_s, ended, wall_time)

    def close(self) -> None:
        """Release the camera; harmless when closed already."""
        if self._closed:
            return
        self._closed = True
        self._calls.end(self._release, within_s=_END_S)

    def _prepare(self) -> None:
        settings = self._settings
        source = settings.source
        self._node = _device_file(source)
        self._numbered = self._node is None and _is_numbered(str(source))
        self._recorded = self._node is None and "://" not in str(source)
        backend = settings.backend or self._usual_backend()
        choice = _BACKENDS[backend] if backend is not None else cv2.CAP_ANY
        self._capture = self._new_capture(source, choice)
        if not self._capture.isOpened():
            raise DeviceError(self._why_not_open())
        self._backend = str(self._capture.getBackendName())
        self._properties = DeviceProperties(self._capture, self._backend)
        if not self._recorded:
            self._set_format()
            self._switch_off()
        # Without conversion samples come as they are.
        self._capture.set(cv2.CAP_PROP_CONVERT_RGB, float(settings.channel is not None))
        self._code = code_name(self._capture.get(cv2.CAP_PROP_FOURCC))
        self._size = (
            int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
            int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
        )
        if not settings.allow_lossy:
            check_lossless(source, self._code, numbered_pictures=self._numbered)
        if self._backend.casefold() == Backend.FFMPEG and settings.channel is None:
            check_grey(source, code_name(self._capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)))
        self._prepare_exposure()

    def _usual_backend(self) -> Backend | None:
        if self._node is not None:
            return Backend.V4L2
        # Others than the one for pictures read them with eight bits.
        return Backend.IMAGES if self._numbered else None

    def _why_not_open(self) -> str:
        source = self._settings.source
        if self._node is None:
            return (
                f"{source} cannot be opened; see that it exists and that OpenCV has what it takes "
                "to read it"
            )
        if not self._node.exists():
            return f"{self._node} does not exist; plug the camera in, or see impasto devices"
        return (
            f"{self._node} cannot be opened: another program has it, or you have no permission; "
            "see impasto devices"
        )

    def _set_format(self) -> None:
        settings = self._settings
        if settings.pixel_format is not None:
            code = cv2.VideoWriter.fourcc(*settings.pixel_format.ljust(4))
            self._capture.set(cv2.CAP_PROP_FOURCC, float(code))
            is_now = code_name(self._capture.get(cv2.CAP_PROP_FOURCC))
            if is_now != settings.pixel_format.rstrip():
                raise DeviceError(
                    f"{settings.source} stays with pixel format {is_now or 'unknown'} where "
                    f"{settings.pixel_format} was set; v4l2-ctl --list-formats tells what it has"
                )
        # Devices take width and height together, and read as they were in between.
        asked = {"WIDTH": settings.width, "HEIGHT": settings.height}
        wanted = {name: value for name, value in asked.items() if value is not None}
        for name, value in wanted.items():
            self._capture.set(getattr(cv2, f"CAP_PROP_FRAME_{name}"), float(value))
        for name, value in wanted.items():
            pixels = int(self._capture.get(getattr(cv2, f"CAP_PROP_FRAME_{name}")))
            if pixels != value:
                raise DeviceError(
                    f"{settings.source} has a {name.casefold()} of {pixels}, not {value}"
                )

    def _switch_off(self) -> None:
        settings = self._settings
        why = "the camera would choose its exposure"
        self._properties.switch_off("AUTO_EXPOSURE", settings.manual_exposure, why=why)
        for name, off, why in _OFF:
            self._properties.switch_off(name, off, why=why)
        why = "samples would not be proportional to light"
        self._properties.switch_off("GAMMA", settings.linear_gamma, why=why)
        if settings.gain is not None:
            self._properties.fix("GAIN", settings.gain)
        for name, value in settings.properties.items():
            self._properties.fix(name, value)

    def _prepare_exposure(self) -> None:
        settings = self._settings
        self._unit: ExposureUnit | None = None
        if settings.fixed_exposure_s is not None:
            self._range_s = (settings.fixed_exposure_s, settings.fixed_exposure_s)
            return
        if self._recorded:
            raise DeviceError(
                f"the exposure of {settings.source} cannot be set; say what it was with "
                "fixed_exposure_s"
            )
        self._unit = settings.exposure_unit or unit_of(self._backend)
        told = exposure_range_s(self._node) if self._node is not None else None
        limits = settings.exposure_range_s or told
        if self._unit is None or limits is None:
            key = "exposure_unit" if self._unit is None else "exposure_range_s"
            raise DeviceError(
                f"{settings.source} does not tell what exposures it can make; set {key}, or "
                "fixed_exposure_s if they cannot be set"
            )
        self._range_s = limits
        # A device whose exposure cannot be set says so here, and not at the first frame.
        self._properties.expose(self._usual_exposure_s(self._unit), self._unit)

    def _usual_exposure_s(self, unit: ExposureUnit) -> float:
        """The exposure that the device has, within its range."""
        low, high = self._range_s
        is_now = from_unit(self._capture.get(cv2.CAP_PROP_EXPOSURE), unit)
        return from_unit(to_unit(min(max(is_now, low), high), unit), unit)

    def _describe(self, deadline: Deadline) -> None:
        """Learn from a picture what the source delivers."""
        settings = self._settings
        self._grab(deadline)
        image = self._retrieve(deadline)
        if self._recorded:
            self._first = image
        raw = RAW_FORMATS.get(self._code)
        bits = settings.bits or (raw.bits if raw is not None else 8 * image.itemsize)
        if bits > 8 * image.itemsize:
            raise DeviceError(f"bits = {bits} do not fit into samples of type {image.dtype}")
        rows, cols = image.shape
        self._kind = image.shape, image.dtype
        self._capabilities = CameraCapabilities(
            model=f"{settings.source} through {self._backend}",
            width=cols,
            height=rows,
            saturation_level=(1 << bits) - 1,
            exposure_range_s=self._range_s,
            bayer=settings.bayer or (raw.bayer if raw is not None else None),
        )

    def _check_same_kind(self, image: NDArray) -> None:
        if (image.shape, image.dtype) != self._kind:
            raise DeviceError(
                f"a picture of {image.shape[::-1]} {image.dtype} came, after {self._kind[0][::-1]} "
                f"{self._kind[1]} when it was opened"
            )
        largest, level = int(image.max()), self.capabilities.saturation_level
        if largest > level:
            raise DeviceError(
                f"a sample is {largest} where {level} should be the largest; correct bits in "
                "rig.toml"
            )

    def _expose(self, exposure_s: float, deadline: Deadline) -> int:
        """Set the exposure; returns how many frames it takes until it is in force."""
        unit = self._unit
        if unit is None or exposure_s == self._exposure_s:
            return 0
        self._exposure_s = None
        late = "the device did not take its exposure"
        self._applied_s = self._ask(
            lambda: self._properties.expose(exposure_s, unit), deadline, late
        )
        self._exposure_s = exposure_s
        return self._settings.settling_frames

    def _next_recorded(self, deadline: Deadline) -> tuple[NDArray, float]:
        """The next picture of a recording, as if exposed from now on, and after the one before."""
        asked_s = max(time.monotonic(), self._ended_s)
        image, self._first = self._first, None
        if image is None:
            self._grab(deadline)
            image = self._retrieve(deadline)
        return image, asked_s + self._applied_s

    def _grab_fresh(self, settling: int, deadline: Deadline) -> float:
        """Drop frames until one was exposed after now; returns when that ended."""
        asked_s = time.monotonic()
        waiting = self._settings.buffers + _IN_THE_DEVICE
        while True:
            grabbed_s, stamped_s = self._grab(deadline)
            ended = grabbed_s if stamped_s is None else stamped_s
            fresh = ended - self._applied_s >= asked_s
            if stamped_s is None and waiting > 0:
                waiting -= 1
            elif fresh and settling > 0:
                settling -= 1
            elif fresh:
                return ended
            deadline.require("a fresh frame did not arrive")

    def _grab(self, deadline: Deadline) -> tuple[float, float | None]:
        """Have the device hand out a frame; returns when that was, and the frame's time stamp."""
        late = "a frame did not arrive"

        def grab() -> tuple[bool, float]:
            done = bool(self._capture.grab())
            return done, float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000

        while True:
            done, stamp_s = self._ask(grab, deadline, late)
            grabbed_s = time.monotonic()
            if done:
                return grabbed_s, self._on_our_clock(stamp_s, grabbed_s)
            self._refuse_ended(deadline)
            deadline.require(late)
            time.sleep(_PAUSE_S)

    def _refuse_ended(self, deadline: Deadline) -> None:
        """Say so if a source that delivered nothing will not do so any more."""
        source = self._settings.source
        if self._recorded:
            raise DeviceLostError(f"{source} has ended after {self._sequence} pictures")
        if self._node is not None and not self._node.exists():
            self._lost = f"{self._node} is gone; plug the camera in and open it again"
        elif not self._ask(self._capture.isOpened, deadline, f"{source} did not answer"):
            self._lost = f"{source} was closed by its other end; open it again"
        if self._lost:
            raise DeviceLostError(self._lost)

    def _on_our_clock(self, stamp_s: float, grabbed_s: float) -> float | None:
        """Kernel's time of the frame just grabbed; None if it is not on our clock."""
        if self._backend.casefold() != Backend.V4L2:
            return None
        return stamp_s if 0 <= grabbed_s - stamp_s < _FAR_S else None

    def _retrieve(self, deadline: Deadline) -> NDArray:
        done, picture = self._ask(
            lambda: self._capture.retrieve(), deadline, "the picture was not handed out"
        )
        if not done or picture is None or picture.size == 0:
            raise DeviceError(f"{self._settings.source} delivered a frame without a picture")
        return raw_samples(picture, self._code, size=self._size, channel=self._settings.channel)

    def _ask(self, function: Callable[[], Result], deadline: Deadline, late: str) -> Result:
        """Make a call to the library, which may block, and wait for it."""
        if self._lost:
            raise DeviceLostError(self._lost)
        try:
            return self._calls.call(function, deadline=deadline, late=late)
        except cv2.error as error:
            raise DeviceError(f"{self._settings.source}: OpenCV says {error}") from None

    def _release(self) -> None:
        capture, self._capture = self._capture, None
        if capture is not None:
            capture.release()


def _device_file(source: int | str) -> Path | None:
    """Device file of a source; None if it is something else."""
    if isinstance(source, int):
        return Path(f"/dev/video{source}")
    return Path(source) if source.startswith("/dev/") else None


def _is_numbered(source: str) -> bool:
    """Whether a source is a series of picture files, or one of them."""
    pictures = {".png", ".tif", ".tiff", ".pgm", ".ppm", ".pnm", ".bmp", ".jpg", ".jpeg"}
    return Path(source).suffix.casefold() in pictures and "://" not in source
