"""Loading libgphoto2, and its errors as ours.

Codes of errors: ``gphoto2-result.h`` and ``gphoto2-port-result.h`` of libgphoto2 2.5.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from devices.errors import DeviceError, DeviceLostError, DeviceTimeoutError
from devices.optional_packages import import_optional

_PROCESSES = Path("/proc")
# As the kernel shortens names to 15 letters.
_DESKTOP_PROGRAMS = ("gvfs-gphoto2-vo", "gvfsd-gphoto2")
_KEPT_LINES = 3


def load_gphoto2() -> Any:
    """The Python binding of libgphoto2.

    Raises
    ------
    MissingPackageError
        It is not installed.
    """
    return import_optional(
        "gphoto2", needed_by="a tethered camera", install=".venv/bin/pip install gphoto2"
    )


class CameraBusyError(DeviceError):
    """The camera has not finished what it was doing; the same may be asked again."""


class NotSupportedError(DeviceError):
    """The camera or its driver in libgphoto2 has no such function."""


class FileGoneError(DeviceError):
    """A file or folder is not on the camera."""


class CameraErrors:
    """Turns errors of libgphoto2 into ours, with what the library wrote to its log.

    Parameters
    ----------
    gphoto2 : module
    """

    def __init__(self, gphoto2: Any) -> None:
        self._gphoto2 = gphoto2
        self._lines: deque[str] = deque(maxlen=_KEPT_LINES)
        # The log is written to as long as what this returns is kept.
        self._log = gphoto2.gp_log_add_func(gphoto2.GP_LOG_ERROR, self._note)

    def _note(self, level: int, domain: bytes, text: bytes, data: object = None) -> None:
        line = text.decode(errors="replace") if isinstance(text, bytes) else str(text)
        self._lines.append(line.strip())

    @contextmanager
    def named(self, what: str) -> Iterator[None]:
        """Name what could not be done.

        Parameters
        ----------
        what : str
            The beginning of a sentence.

        Raises
        ------
        DeviceError
            A :class:`~devices.errors.DeviceLostError` if the camera is gone, a
            :class:`CameraBusyError`, :class:`NotSupportedError` or :class:`FileGoneError` as the
            code says.
        """
        self._lines.clear()
        try:
            yield
        except self._gphoto2.GPhoto2Error as error:
            raise self._translate(what, error.code) from None

    def _translate(self, what: str, code: int) -> DeviceError:
        gphoto2 = self._gphoto2
        if code in (gphoto2.GP_ERROR_IO_USB_CLAIM, gphoto2.GP_ERROR_IO_LOCK):
            return DeviceError(f"{what}: {claimed_problem()}")
        kind, advice = self._kinds().get(code, (DeviceError, "switch it off and on again"))
        log = "; ".join(dict.fromkeys(self._lines))
        text = gphoto2.gp_result_as_string(code)
        return kind(f"{what}: {text} ({code}{f', {log}' if log else ''}); {advice}")

    def _kinds(self) -> dict[int, tuple[type[DeviceError], str]]:
        gphoto2 = self._gphoto2
        lost = DeviceLostError, "look at its cable, battery and automatic power-off, and reopen it"
        gone = FileGoneError, "it was deleted, or the card was taken out"
        return {
            gphoto2.GP_ERROR_CAMERA_BUSY: (CameraBusyError, "wait until it has written its card"),
            gphoto2.GP_ERROR_NO_SPACE: (DeviceError, "its card is full: empty it"),
            gphoto2.GP_ERROR_NOT_SUPPORTED: (NotSupportedError, "this camera cannot do that"),
            gphoto2.GP_ERROR_TIMEOUT: (DeviceTimeoutError, "switch it off and on again"),
            gphoto2.GP_ERROR_FILE_NOT_FOUND: gone,
            gphoto2.GP_ERROR_DIRECTORY_NOT_FOUND: gone,
            gphoto2.GP_ERROR_CORRUPTED_DATA: (DeviceError, "try another cable"),
            gphoto2.GP_ERROR_MODEL_NOT_FOUND: lost,
            gphoto2.GP_ERROR_IO: lost,
            gphoto2.GP_ERROR_IO_INIT: lost,
            gphoto2.GP_ERROR_IO_READ: lost,
            gphoto2.GP_ERROR_IO_WRITE: lost,
            gphoto2.GP_ERROR_IO_UPDATE: lost,
            gphoto2.GP_ERROR_IO_USB_FIND: lost,
            gphoto2.GP_ERROR_IO_USB_CLEAR_HALT: lost,
            gphoto2.GP_ERROR: (
                DeviceError,
                "set its lens to manual focus, its drive to single pictures without mirror "
                "lock-up, and look at what its display says",
            ),
        }


def claimed_problem(*, processes: Path = _PROCESSES) -> str:
    """Who has claimed a camera, and how to get it back."""
    running = sorted(
        path.parent.name
        for path in processes.glob("[0-9]*/comm")
        if _read(path).strip() in _DESKTOP_PROGRAMS
    )
    if running:
        return (
            f"the desktop has claimed the camera (gvfs, process {', '.join(running)}); let go of "
            "it: gio mount -s gphoto2, and for good: "
            "systemctl --user mask --now gvfs-gphoto2-volume-monitor"
        )
    return (
        "another program has claimed the camera; close it (darktable, Entangle, a file manager: "
        "gio mount -s gphoto2)"
    )


def _read(path: Path) -> str:
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""
