"""A GenICam camera that takes one raw frame at a time, each exposed when it was asked for."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

from devices.aravis.cameras import open_camera
from devices.aravis.device_clock import DeviceClock, clock_reader, exposure_end_s
from devices.aravis.frame_stream import Arrived, FrameStream, IncompleteFrameError, frames_between
from devices.aravis.library import FIREWALL_HINT, load_aravis, named_errors
from devices.aravis.pixel_formats import PixelFormat, choose_pixel_format
from devices.aravis.raw_features import make_raw, set_level
from devices.aravis.settings import AravisSettings, Trigger
from devices.blocking_calls import BlockingCalls
from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceLostError, DeviceTimeoutError, FrameOrderError
from devices.interfaces import CameraCapabilities, Frame

_END_S = 1.0
# A camera that minds its trigger sends nothing for so long after acquisition began.
_UNASKED_S = 0.15
# A frame is expected so long after its exposure; then the camera is asked whether it is there.
_USUAL_WAY_S = 0.5
# Exposures are true to this, and clocks compare to this.
_EXPOSURE_ERROR = 0.02
_CLOCK_ERROR_S = 0.02

Result = TypeVar("Result")


class AravisCamera:
    """A :class:`~devices.interfaces.Camera` behind Aravis.

    Parameters
    ----------
    settings : AravisSettings

    Raises
    ------
    DeviceError
        There is no such camera, another program has it, or it cannot be made to deliver raw
        samples when asked to.
    """

    def __init__(self, settings: AravisSettings) -> None:
        self._settings = settings
        self._aravis = load_aravis()
        self._calls = BlockingCalls("the camera")
        self._clock = DeviceClock()
        self._lost = threading.Event()
        self._camera: Any = None
        self._closed = False
        self._running = False
        self._sequence = 0
        self._ended_s = 0.0
        self._last_number: int | None = None
        deadline = Deadline.after(settings.timeout_s)
        try:
            self._ask(self._prepare, deadline, "the camera did not open")
            if settings.trigger is Trigger.SOFTWARE:
                self._start(deadline)
                self._refuse_unasked_frames(within_s=_UNASKED_S)
        except BaseException:
            self.close()
            raise

    @property
    def capabilities(self) -> CameraCapabilities:
        """What the camera is."""
        return self._capabilities

    @property
    def pixel_format(self) -> PixelFormat:
        """Format of its samples."""
        return self._format

    @property
    def gain(self) -> float | None:
        """Gain that it took, in its own unit; None if it has none."""
        return self._gain

    def capture(self, exposure_s: float, *, deadline: Deadline | None = None) -> Frame:
        """Take one frame, exposed after this call.

        Raises
        ------
        DeviceError
            The exposure is out of range, the camera did not take it, or the frame arrived with
            gaps as often as it was taken.
        DeviceTimeoutError
            The frame is not there by the deadline.
        DeviceLostError
            The camera does not answer any more.
        FrameOrderError
            The frame was not exposed after this call.
        """
        if self._closed:
            raise DeviceError("the camera is closed")
        self.capabilities.check_exposure(exposure_s)
        deadline = deadline or Deadline.after(exposure_s + self._settings.timeout_s)
        self._refuse_lost()
        for attempt in range(1, self._settings.attempts + 1):
            try:
                return self._take(exposure_s, deadline)
            except IncompleteFrameError as error:
                if attempt == self._settings.attempts:
                    raise DeviceError(f"{error}; it was taken {attempt} times") from None
                deadline.require("a frame without gaps did not arrive")
        raise AssertionError("unreachable: there is at least one attempt")

    def close(self) -> None:
        """Release the camera; harmless when closed already."""
        if self._closed:
            return
        self._closed = True
        # A camera that is gone keeps its last calls for seconds; nobody needs to wait for that.
        self._calls.end(self._release, within_s=0.0 if self._lost.is_set() else _END_S)

    def _prepare(self) -> None:
        settings = self._settings
        camera = self._camera = open_camera(self._aravis, settings.camera)
        device = camera.get_device()
        device.connect("control-lost", lambda *_: self._lost.set())
        with named_errors("the camera cannot be set up"):
            camera.stop_acquisition()
            make_raw(device)
            self._format = choose_pixel_format(
                camera.dup_available_pixel_formats_as_strings(), settings.pixel_format
            )
            camera.set_pixel_format_from_string(self._format.name)
            self._size = self._open_region()
            self._gain = set_level(device, ("Gain", "GainRaw"), settings.gain)
            if settings.black_level is not None:
                set_level(device, ("BlackLevel", "BlackLevelRaw"), settings.black_level)
            self._set_trigger()
            if settings.packet_size is not None and camera.is_gv_device():
                camera.gv_set_packet_size(settings.packet_size)
            self._clock_reader = clock_reader(device)
            self._stream = FrameStream(self._aravis, camera, self._format, self._size)
            self._capabilities = self._describe()

    def _open_region(self) -> tuple[int, int]:
        """Read the whole sensor out, whatever part of it was set before."""
        camera = self._camera
        if camera.is_region_offset_available():
            x, y, width, height = camera.get_region()
            camera.set_region(0, 0, width, height)
        width, height = camera.get_width_bounds()[1], camera.get_height_bounds()[1]
        camera.set_region(0, 0, width, height)
        x, y, *size = camera.get_region()
        if (x, y, *size) != (0, 0, width, height):
            raise DeviceError(
                f"the camera reads out {size[0]}×{size[1]} pixels from {x}, {y} where "
                f"{width}×{height} were asked for; reset its region of interest"
            )
        return width, height

    def _set_trigger(self) -> None:
        camera = self._camera
        if self._settings.trigger is Trigger.SINGLE_FRAME:
            if camera.dup_available_triggers():
                camera.clear_triggers()
            camera.set_acquisition_mode(self._aravis.AcquisitionMode.SINGLE_FRAME)
            return
        if not camera.is_software_trigger_supported():
            raise DeviceError(
                'the camera has no software trigger; set trigger = "single frame" in rig.toml'
            )
        camera.set_acquisition_mode(self._aravis.AcquisitionMode.CONTINUOUS)
        camera.set_trigger("Software")
        source = camera.get_trigger_source()
        if source != "Software":
            raise DeviceError(f"the camera's TriggerSource stays {source}, not Software")

    def _describe(self) -> CameraCapabilities:
        camera = self._camera
        low, high = camera.get_exposure_time_bounds()
        vendor, model = camera.get_vendor_name(), camera.get_model_name()
        return CameraCapabilities(
            model=f"{vendor} {model}",
            width=self._size[0],
            height=self._size[1],
            saturation_level=self._settings.saturation_level or self._format.saturation_level,
            exposure_range_s=(low * 1e-6, high * 1e-6),
            bayer=self._format.bayer,
        )

    def _take(self, exposure_s: float, deadline: Deadline) -> Frame:
        try:
            applied = self._expose(exposure_s, deadline)
            if self._settings.trigger is Trigger.SOFTWARE:
                if not self._running:
                    self._start(deadline)
                self._refuse_unasked_frames()
            self._read_clock(deadline)
            asked_s = time.monotonic()
            begin = self._trigger if self._running else self._begin_single_frame
            self._ask(begin, deadline, "the camera did not begin an exposure")
            arrived = self._await_frame(asked_s + applied, deadline)
            frame = self._frame(arrived, exposure_s, applied, asked_s)
            if self._settings.trigger is Trigger.SINGLE_FRAME:
                self._stop(deadline)
            return frame
        except BaseException:
            # What was begun may still arrive; the next frame is taken in a new acquisition.
            self._running = False
            self._last_number = None
            raise

    def _expose(self, exposure_s: float, deadline: Deadline) -> float:
        """Set the exposure; returns the one that the camera took."""

        def set_and_read() -> float:
            with named_errors("the exposure cannot be set"):
                self._camera.set_exposure_time(exposure_s * 1e6)
                return float(self._camera.get_exposure_time()) * 1e-6

        applied = self._ask(set_and_read, deadline, "the camera did not take its exposure")
        if not applied > 0:
            raise DeviceError(f"the camera says that it exposes for {applied:g} s; restart it")
        return applied

    def _start(self, deadline: Deadline) -> None:
        """Begin to acquire, with nothing left from before."""

        def start() -> None:
            with named_errors("acquisition cannot be started"):
                self._camera.stop_acquisition()
                self._stream.empty()
                self._camera.start_acquisition()

        self._ask(start, deadline, "the camera did not start")
        self._running = True

    def _begin_single_frame(self) -> None:
        with named_errors("acquisition cannot be started"):
            self._camera.stop_acquisition()
            self._stream.empty()
            self._camera.start_acquisition()

    def _stop(self, deadline: Deadline) -> None:
        def stop() -> None:
            with named_errors("acquisition cannot be stopped"):
                self._camera.stop_acquisition()

        self._last_number = None  # the camera counts anew
        self._ask(stop, deadline, "the camera did not stop")

    def _trigger(self) -> None:
        with named_errors("the camera cannot be triggered"):
            self._camera.software_trigger()

    def _refuse_unasked_frames(self, *, within_s: float = 0.0) -> None:
        """A camera that sends frames by itself does not mind its trigger."""
        until = time.monotonic() + within_s
        unasked = self._stream.empty()
        while not unasked and time.monotonic() < until:
            time.sleep(_UNASKED_S / 10)
            unasked = self._stream.empty()
        if unasked:
            raise FrameOrderError(
                f"the camera sent {unasked} frames without being triggered; set trigger = "
                '"single frame" in rig.toml'
            )

    def _read_clock(self, deadline: Deadline) -> None:
        """Compare the camera's clock with ours, where it can be read."""
        reader = self._clock_reader
        if reader is not None:
            with named_errors("the camera's clock cannot be read"):
                late = "the camera's clock was not read"
                self._ask(lambda: reader(self._clock), deadline, late)

    def _await_frame(self, exposed_s: float, deadline: Deadline) -> Arrived:
        """Wait for a frame; once it is late, ask the camera whether it is still there."""
        asked = False
        while True:
            arrived = self._stream.wait(deadline.remaining_s)
            if arrived is not None:
                return arrived
            self._refuse_lost()
            deadline.require("the camera did not deliver its frame")
            if not asked and time.monotonic() > exposed_s + _USUAL_WAY_S:
                asked = True
                self._ask(self._prove_presence, deadline, "the camera did not deliver its frame")

    def _prove_presence(self) -> None:
        with named_errors("no frame arrives"):
            self._camera.get_exposure_time()

    def _frame(
        self, arrived: Arrived, exposure_s: float, applied_s: float, asked_s: float
    ) -> Frame:
        stamped_s = self._clock.monotonic_s(arrived.stamp_s, arrived_s=arrived.arrived_s)
        shortest = applied_s * (1 - _EXPOSURE_ERROR)
        early = asked_s + shortest - arrived.arrived_s
        if early > 0 and not self._settings.instant_exposures:
            raise FrameOrderError(
                f"frame {arrived.number} arrived {1000 * early:.0f} ms before its exposure of "
                f"{applied_s:g} s can have ended: the camera sent an older one; restart it"
            )
        if stamped_s is not None and stamped_s < asked_s - _CLOCK_ERROR_S:
            self._clock.forget()
            raise FrameOrderError(
                f"frame {arrived.number} is stamped {1000 * (asked_s - stamped_s):.0f} ms before "
                "it was asked for: the camera sent an older one, or its clock jumped; restart it"
            )
        self._sequence += self._step_to(arrived.number)
        # A camera that does not wait for its exposures seems to make them one after another.
        ended = self._ended_s = exposure_end_s(
            stamped_s,
            exposure_s=applied_s,
            asked_s=max(asked_s, self._ended_s),
            arrived_s=arrived.arrived_s,
        )
        wall_time = time.time() + ended - time.monotonic()
        return Frame(arrived.image, self._sequence, exposure_s, applied_s, ended, wall_time)

    def _step_to(self, number: int) -> int:
        """How far the camera's own count went; frames given up meanwhile do not count."""
        last, self._last_number = self._last_number, number
        step = 1 if last is None else frames_between(last, number)
        if step < 1:
            raise FrameOrderError(
                f"the camera sent its frame {number} after {last}: the same or an older one again; "
                "restart it"
            )
        return step

    def _ask(self, function: Callable[[], Result], deadline: Deadline, late: str) -> Result:
        """Make a call to the library, which may block, and wait for it."""
        try:
            return self._calls.call(function, deadline=deadline, late=late)
        except DeviceLostError:
            self._lost.set()
            raise
        except DeviceTimeoutError:
            self._refuse_lost()
            raise

    def _refuse_lost(self) -> None:
        if self._lost.is_set():
            raise DeviceLostError(
                f"the camera is gone, or another program took it; {FIREWALL_HINT}, then open it "
                "again"
            )

    def _release(self) -> None:
        camera, self._camera = self._camera, None
        self._stream = None  # type: ignore[assignment]
        if camera is not None and not self._lost.is_set():
            camera.stop_acquisition()
            if camera.is_gv_device():
                # Others may have it at once, even while an error's traceback still holds it.
                camera.get_device().leave_control()
