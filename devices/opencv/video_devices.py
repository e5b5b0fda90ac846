"""Video devices as the kernel tells of them: name, pixel formats, limits, and who has them.

Source: Video for Linux API version 2 (``linux/videodev2.h``); requests and the layout of what they
fill in.
"""

from __future__ import annotations

import errno
import fcntl
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from devices.discovery import Found
from devices.opencv.raw_formats import RAW_FORMATS

_NODES = Path("/dev")
_QUERYCAP, _QUERYCAP_SIZE = 0x80685600, 104
_ENUM_FMT, _ENUM_FMT_LAYOUT = 0xC0405602, "<III32sIIIII"
_REQBUFS, _REQBUFS_LAYOUT = 0xC0145608, "<IIIII"
_QUERYCTRL, _QUERYCTRL_LAYOUT = 0xC0445624, "<II32siiiiIII"
_VIDEO_CAPTURE, _DEVICE_CAPS = 0x1, 0x80000000
_CAPTURE_BUFFERS, _MEMORY_MAPPED = 1, 1
_EXPOSURE_ABSOLUTE = 0x009A0902
_MOST_FORMATS = 64

Ioctl = Callable[[int, int, bytes], bytes]


@dataclass(frozen=True)
class VideoDevice:
    """A device that delivers pictures.

    Attributes
    ----------
    model : str
    formats : tuple of str
        Four letters each.
    busy : bool
        Whether another program has its buffers.
    """

    model: str
    formats: tuple[str, ...]
    busy: bool

    def problem(self) -> str | None:
        """Why it is of no use for measuring; None if nothing forbids it."""
        if self.busy:
            return "another program takes pictures with it; close that one (fuser -v /dev/video*)"
        if not any(name in RAW_FORMATS for name in self.formats):
            return (
                f"it delivers no raw samples ({', '.join(self.formats) or 'no format at all'}); "
                "channel and allow_lossy in rig.toml admit it all the same"
            )
        return None


def find_video_devices(*, nodes: Path = _NODES, ioctl: Ioctl = fcntl.ioctl) -> list[Found]:
    """Every video device that takes pictures, with what is wrong with it.

    Parameters
    ----------
    nodes : Path
        Folder of the device files.
    ioctl : callable
    """
    found = []
    for node in sorted(nodes.glob("video*"), key=lambda path: (len(path.name), path.name)):
        try:
            device = look_at(node, ioctl=ioctl)
        except PermissionError:
            problem = "no permission; add yourself to its group: sudo usermod -aG video $USER"
            found.append(Found("opencv", str(node), "", problem))
        except OSError as error:
            found.append(Found("opencv", str(node), "", f"it does not answer ({error.strerror})"))
        else:
            if device is not None:
                found.append(Found("opencv", str(node), device.model, device.problem()))
    return found


def look_at(node: Path, *, ioctl: Ioctl = fcntl.ioctl) -> VideoDevice | None:
    """What a device file is; None if it takes no pictures.

    Raises
    ------
    OSError
        It cannot be opened or does not answer.
    """
    with _open(node) as handle:
        answer = ioctl(handle, _QUERYCAP, bytes(_QUERYCAP_SIZE))
        card, (capabilities, own) = answer[16:48], struct.unpack("<II", answer[84:92])
        # A device with several files tells for each what that one can do.
        if not (own if capabilities & _DEVICE_CAPS else capabilities) & _VIDEO_CAPTURE:
            return None
        return VideoDevice(
            model=_text(card), formats=tuple(_formats(handle, ioctl)), busy=_is_busy(handle, ioctl)
        )


def exposure_range_s(node: Path, *, ioctl: Ioctl = fcntl.ioctl) -> tuple[float, float] | None:
    """Shortest and longest exposure that a device tells; None if it does not."""
    request = struct.pack(_QUERYCTRL_LAYOUT, _EXPOSURE_ABSOLUTE, 0, b"", *[0] * 7)
    try:
        with _open(node) as handle:
            answer = struct.unpack(_QUERYCTRL_LAYOUT, ioctl(handle, _QUERYCTRL, request))
    except OSError:
        return None
    low, high = answer[3:5]
    return (max(1, low) * 1e-4, high * 1e-4) if high > max(1, low) else None


@contextmanager
def _open(node: Path) -> Iterator[int]:
    handle = os.open(node, os.O_RDWR | os.O_NONBLOCK)
    try:
        yield handle
    finally:
        os.close(handle)


def _formats(handle: int, ioctl: Ioctl) -> Iterator[str]:
    for number in range(_MOST_FORMATS):
        request = struct.pack(_ENUM_FMT_LAYOUT, number, _CAPTURE_BUFFERS, 0, b"", *[0] * 5)
        try:
            answer = ioctl(handle, _ENUM_FMT, request)
        except OSError:
            return
        yield answer[44:48].decode("ascii", errors="replace").rstrip()


def _is_busy(handle: int, ioctl: Ioctl) -> bool:
    """Whether buffers are refused because another program has them."""
    for count in (1, 0):
        request = struct.pack(_REQBUFS_LAYOUT, count, _CAPTURE_BUFFERS, _MEMORY_MAPPED, 0, 0)
        try:
            ioctl(handle, _REQBUFS, request)
        except OSError as error:
            return error.errno == errno.EBUSY
    return False


def _text(field: bytes) -> str:
    return field.split(b"\0")[0].decode(errors="replace").strip()
