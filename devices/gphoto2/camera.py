"""A tethered camera that takes one raw picture at a time.

A picture is the file that the camera reports after it was released, downloaded and decoded; files
that it reports before belong to somebody else and are left alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from devices.blocking_calls import BlockingCalls
from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceLostError, DeviceTimeoutError, FrameOrderError
from devices.gphoto2.cameras import choose_camera, list_cameras, open_camera
from devices.gphoto2.configuration import EXPOSURE_TIME, REQUIREMENTS, Configuration
from devices.gphoto2.exposure_times import ExposureTimes, parse_exposure_time
from devices.gphoto2.library import CameraBusyError, CameraErrors, FileGoneError, load_gphoto2
from devices.gphoto2.raw_file import RawPicture, decode_raw, is_jpeg
from devices.gphoto2.settings import Gphoto2Settings
from devices.interfaces import CameraCapabilities, Frame

_END_S = 5.0
_EVENT_MS = 50
_PAUSE_S = 0.01
_DOWNLOADS = 3
# A file of an exposure that was given up comes within so long after it.
_LATE_FILE_S = 5.0
# Exposures are shorter than their names say by no more than this.
_SHORTEST = 0.9
_RELEASE = "the camera did not release"

Result = TypeVar("Result")


@dataclass(frozen=True)
class _File:
    folder: str
    name: str

    def __str__(self) -> str:
        return f"{self.folder}/{self.name}"


class TetheredCamera:
    """A :class:`~devices.interfaces.Camera` behind libgphoto2.

    Opening takes one picture, which tells size, mosaic and levels.

    Parameters
    ----------
    settings : Gphoto2Settings
    library : module, optional
        In place of :mod:`gphoto2`.

    Raises
    ------
    DeviceError
        There is no such camera, another program has it, or it cannot be made to deliver raw files.
    """

    def __init__(self, settings: Gphoto2Settings, *, library: Any = None) -> None:
        self._settings = settings
        self._gphoto2 = library or load_gphoto2()
        self._errors = CameraErrors(self._gphoto2)
        self._calls = BlockingCalls("the camera")
        self._camera: Any = None
        self._closed = False
        self._lost = False
        self._sequence = 0
        self._ended_s = 0.0
        # Until when the file of an exposure that was given up may still come.
        self._late_until_s = 0.0
        deadline = Deadline.after(settings.timeout_s)
        try:
            self._ask(self._prepare, deadline, "the camera did not open")
            self._describe(deadline)
        except BaseException:
            self.close()
            raise

    @property
    def capabilities(self) -> CameraCapabilities:
        """What the camera is."""
        return self._capabilities

    @property
    def black_levels(self) -> tuple[int, ...]:
        """Sensor numbers without light: red, green, blue, second green."""
        return self._sample.black_levels

    @property
    def iso(self) -> str | None:
        """Sensitivity; None if the camera does not tell."""
        return self._iso

    @property
    def aperture(self) -> str | None:
        """Aperture; None if the camera does not tell."""
        return self._aperture

    def capture(self, exposure_s: float, *, deadline: Deadline | None = None) -> Frame:
        """Take one picture with the camera's nearest exposure time.

        The camera does not say when it was exposed. The frame gives the earliest moment at which
        its exposure can have ended: the time of the release, and the exposure.

        Raises
        ------
        DeviceError
            The exposure is out of range; the camera is not able to take the picture; or it
            delivers a JPEG or a file that cannot be decoded.
        DeviceTimeoutError
            The file is not there by the deadline.
        DeviceLostError
            The camera does not answer any more.
        FrameOrderError
            The file came sooner than it can have been exposed.
        """
        if self._closed:
            raise DeviceError("the camera is closed")
        self.capabilities.check_exposure(exposure_s)
        deadline = deadline or Deadline.after(exposure_s + self._settings.timeout_s)
        picture, applied_s, asked_s = self._take(exposure_s, deadline)
        self._check_same_kind(picture)
        self._sequence += 1
        # Names of times are rounded, and an exposure seems to end after the next was asked for.
        ended = self._ended_s = max(asked_s, self._ended_s) + applied_s
        wall_time = time.time() + ended - time.monotonic()
        return Frame(picture.image, self._sequence, exposure_s, applied_s, ended, wall_time)

    def close(self) -> None:
        """Release the camera; harmless when closed already."""
        if self._closed:
            return
        self._closed = True
        self._calls.end(self._release, within_s=0.0 if self._lost else _END_S)

    def _prepare(self) -> None:
        settings, gphoto2 = self._settings, self._gphoto2
        listed = choose_camera(list_cameras(gphoto2, self._errors), settings.camera)
        self._model = listed.model
        self._camera = open_camera(gphoto2, self._errors, listed)
        configuration = Configuration(gphoto2, self._camera, self._errors)
        configuration.check_battery(settings.least_battery_percent)
        for requirement in REQUIREMENTS:
            configuration.require(requirement)
        configuration.fix_format()
        configuration.fix_target(card=settings.keep_files)
        self._iso = configuration.fix_iso(settings.iso)
        self._aperture = configuration.fix_aperture(settings.aperture)
        name = configuration.name_of(EXPOSURE_TIME)
        if name is None:
            raise DeviceError(
                f"the exposure of {listed.model} cannot be set from here; turn its mode dial to M"
            )
        self._exposure_name = name
        self._times = ExposureTimes(configuration.choices(name))
        self._configuration = configuration

    def _describe(self, deadline: Deadline) -> None:
        """Learn from a picture what the camera delivers."""
        low, high = self._times.range_s
        self._sample, _, _ = self._take(low, deadline)
        rows, cols = self._sample.image.shape
        self._capabilities = CameraCapabilities(
            model=self._model,
            width=cols,
            height=rows,
            saturation_level=self._settings.saturation_level or self._sample.white_level,
            exposure_range_s=(low, high),
            bayer=self._sample.bayer,
        )

    def _check_same_kind(self, picture: RawPicture) -> None:
        first = self._sample
        kind = picture.image.shape, picture.bayer, picture.black_levels, picture.white_level
        before = first.image.shape, first.bayer, first.black_levels, first.white_level
        if kind != before:
            raise DeviceError(
                f"the camera delivers other pictures than when it was opened: {kind} (size, "
                f"mosaic, black levels, white level) after {before}; was its menu changed? Open it "
                "again"
            )

    def _take(self, exposure_s: float, deadline: Deadline) -> tuple[RawPicture, float, float]:
        """Picture, exposure applied, and the moment before the release."""
        applied_s = self._expose(exposure_s, deadline)
        self._settle(deadline)
        asked_s = self._begin(applied_s, deadline)
        picture = self._await_picture(asked_s + _SHORTEST * applied_s, deadline)
        self._late_until_s = 0.0
        return picture, applied_s, asked_s

    def _expose(self, exposure_s: float, deadline: Deadline) -> float:
        """Set the nearest exposure time; returns the one that the camera has then."""
        wanted = self._times.nearest(exposure_s)
        name, configuration = self._exposure_name, self._configuration
        late = "the camera did not take its exposure time"
        is_now = self._ask(lambda: configuration.read(name), deadline, late)
        if is_now != wanted.choice:
            is_now = self._ask(lambda: configuration.write(name, wanted.choice), deadline, late)
        if is_now != wanted.choice:
            raise DeviceError(
                f"the camera's {name} stays {is_now!r} where {wanted.choice!r} was set; turn its "
                "mode dial to M"
            )
        return parse_exposure_time(is_now) or wanted.seconds

    def _settle(self, deadline: Deadline) -> None:
        """Let everything pass that was reported before the release.

        After an exposure that was given up, its file is waited for, or it would be taken for the
        next one.
        """
        while True:
            file = self._next_file(deadline, "the camera did not come to rest")
            if file is None and time.monotonic() >= self._late_until_s:
                return
            if file is not None and time.monotonic() < self._late_until_s:
                self._late_until_s = 0.0
                self._discard(file, deadline)

    def _begin(self, applied_s: float, deadline: Deadline) -> float:
        """Release, once the camera is not busy any more; returns the moment before."""

        def trigger() -> None:
            with self._errors.named(_RELEASE):
                self._camera.trigger_capture()

        while True:
            asked_s = time.monotonic()
            self._late_until_s = asked_s + applied_s + _LATE_FILE_S
            try:
                self._ask(trigger, deadline, _RELEASE)
            except CameraBusyError as error:
                # A busy camera has not been released, so this repeats nothing.
                self._late_until_s = 0.0
                if deadline.remaining_s < _PAUSE_S:
                    raise DeviceTimeoutError(f"the camera stayed busy: {error}") from None
                time.sleep(_PAUSE_S)
            except DeviceTimeoutError:
                raise
            except DeviceError:
                self._late_until_s = 0.0
                raise
            else:
                return asked_s

    def _await_picture(self, exposed_s: float, deadline: Deadline) -> RawPicture:
        """The raw file that comes next; a JPEG beside it is passed over."""
        jpegs: list[_File] = []
        try:
            while True:
                file = self._next_file(deadline, "the camera did not deliver its picture")
                if file is None:
                    continue
                data = self._download_fresh(file, exposed_s, deadline)
                if not is_jpeg(data):
                    picture = decode_raw(data, name=str(file))
                    self._discard(file, deadline)
                    return picture
                self._discard(file, deadline)
                jpegs.append(file)
        except DeviceTimeoutError:
            if not jpegs:
                raise
            raise DeviceError(
                f"the camera delivered only a JPEG ({jpegs[0]}), which cannot be measured with; "
                "set raw in its menu"
            ) from None

    def _next_file(self, deadline: Deadline, late: str) -> _File | None:
        """The next file that the camera reports; None once it reports nothing for a while."""
        gphoto2 = self._gphoto2

        def wait() -> tuple[int, Any]:
            with self._errors.named("the camera does not report"):
                kind, data = self._camera.wait_for_event(_EVENT_MS)
            if kind == gphoto2.GP_EVENT_TIMEOUT:
                time.sleep(_PAUSE_S)  # some drivers do not wait
            return kind, data

        while True:
            deadline.require(late)
            kind, data = self._ask(wait, deadline, late)
            if kind == gphoto2.GP_EVENT_FILE_ADDED:
                return _File(data.folder, data.name)
            if kind == gphoto2.GP_EVENT_TIMEOUT:
                return None

    def _download_fresh(self, file: _File, exposed_s: float, deadline: Deadline) -> bytes:
        """Download a file, which cannot come before its exposure has ended."""
        early = exposed_s - time.monotonic()
        if early > 0:
            raise FrameOrderError(
                f"{file} came {early:.2f} s before its exposure can have ended: it is of an "
                "earlier release; leave the camera's buttons alone and take it again"
            )
        return self._download(file, deadline)

    def _download(self, file: _File, deadline: Deadline) -> bytes:
        gphoto2 = self._gphoto2

        def download() -> tuple[bytes, int | None]:
            with self._errors.named(f"{file} cannot be downloaded"):
                about = self._camera.file_get_info(file.folder, file.name).file
                told = about.fields & gphoto2.GP_FILE_INFO_SIZE
                content = self._camera.file_get(file.folder, file.name, gphoto2.GP_FILE_TYPE_NORMAL)
                data = bytes(memoryview(content.get_data_and_size()))
            # A size of zero is not known yet.
            return data, (about.size or None) if told else None

        for _ in range(_DOWNLOADS):
            data, size = self._ask(download, deadline, f"{file} was not downloaded")
            if data and size in (None, len(data)):
                return data
        raise DeviceError(
            f"{file} arrived with {len(data)} bytes of {size}, {_DOWNLOADS} times; try another "
            "cable or USB port"
        )

    def _discard(self, file: _File, deadline: Deadline) -> None:
        """Delete a file from the camera, unless files are kept."""
        if self._settings.keep_files:
            return

        def delete() -> None:
            with self._errors.named(f"{file} cannot be deleted from the camera"):
                self._camera.file_delete(file.folder, file.name)

        # A camera's memory lets go of a file once it is downloaded.
        with suppress(FileGoneError):
            self._ask(delete, deadline, f"{file} was not deleted")

    def _ask(self, function: Callable[[], Result], deadline: Deadline, late: str) -> Result:
        """Make a call to the library, which may block, and wait for it."""
        if self._lost:
            raise DeviceLostError("the camera is gone; plug it in and open it again")
        try:
            return self._calls.call(function, deadline=deadline, late=late)
        except DeviceLostError:
            self._lost = True
            raise

    def _release(self) -> None:
        camera, self._camera = self._camera, None
        if camera is not None:
            camera.exit()
