"""The journal of a session: one line per event, appended and flushed before anything goes on.

A line is written with its newline in one go, so a last line without one was torn by a crash: the
event did not happen. A torn line anywhere else means that the file was damaged later, and is
refused.

Each line ends with a seal, the CRC-32 (ISO 3309) of the seal before it and of the line itself: an
altered byte is noticed always, as is a line that is missing, doubled or displaced. Journals from
before there were seals are read without; once a line is sealed, all after it are.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import zlib
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import IO, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from acquisition.atomic_files import write_all
from acquisition.errors import SessionError
from devices.interfaces import Subject

_SEAL = re.compile(rb',"seal":"([0-9a-f]{8})"\}$')


class StopReason(StrEnum):
    """Why a recording ended."""

    SUCCESS = "success"
    ABORTED = "aborted"
    FAILED = "failed"


class SkipReason(StrEnum):
    """Why a planned frame was not taken."""

    SERVED = "other exposures of the bracket serve its pixels"
    SATURATED = "what lacks signal would saturate"
    PRECISE = "coordinates are precise enough without it"
    ORDER_KNOWN = "fringe orders are certain without it"


class _Event(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    wall_time: float
    monotonic_s: float


class Start(_Event):
    """Recording began, or began again.

    ``files`` are the digests of what the session began with, by path: until there is a manifest,
    nothing else tells whether they were altered.
    """

    event: Literal["start"] = "start"
    resumed: bool = False
    files: dict[str, str] | None = None


class FrameRecorded(_Event):
    """A frame is safe on the disk; its times are those of the exposure.

    ``subject`` is what the rig knew it to be a picture of, ``needed_by`` the number of pixels that
    its exposure was taken for where others of its bracket had been taken already, or that would
    miss their target without it.
    """

    event: Literal["frame"] = "frame"
    id: str
    file: str
    sha256: str
    sequence: int
    exposure_applied_s: float | None = None
    subject: Subject | None = None
    needed_by: int | None = None


class FrameSkipped(_Event):
    """A planned frame of a bracket or of a metered code was not needed.

    ``pixels`` is the number that would have gained by it, ``saturating`` the number that it was
    predicted to saturate.
    """

    event: Literal["skipped"] = "skipped"
    id: str
    reason: SkipReason
    pixels: int
    saturating: int


class Stop(_Event):
    """Recording ended."""

    event: Literal["stop"] = "stop"
    reason: StopReason
    why: str = ""


AnyEvent = Start | FrameRecorded | FrameSkipped | Stop
Event = Annotated[AnyEvent, Field(discriminator="event")]
_EVENT: TypeAdapter[AnyEvent] = TypeAdapter(Event)


def append_event(path: Path, event: AnyEvent) -> None:
    """Append one event and flush it to the disk; a torn last line is cut off first.

    Where that fails, the journal is left as it was.

    Raises
    ------
    OSError
        It could not be written.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        length, seal = _end_of_journal(descriptor)
        os.ftruncate(descriptor, length)
        os.lseek(descriptor, length, os.SEEK_SET)
        try:
            write_all(descriptor, _sealed(event.model_dump_json(exclude_none=True).encode(), seal))
            os.fsync(descriptor)
        except OSError:
            # Whoever appends next looks for a torn line all the same.
            with contextlib.suppress(OSError):
                os.ftruncate(descriptor, length)
            raise
    finally:
        os.close(descriptor)


def read_journal(path: Path) -> list[AnyEvent]:
    """Events of a journal, a torn last line left out.

    Raises
    ------
    SessionError
        The journal is missing, a line before the last is torn, or one was altered, removed or
        displaced.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise SessionError(
            f"{path} is missing: this is not a session, or not a whole one"
        ) from None
    lines = content.split(b"\n")
    lines.pop()  # what follows the last newline: nothing, or a torn line
    events = []
    seal = b""
    for number, line in enumerate(lines, start=1):
        try:
            line, seal = _unsealed(line, seal)
            events.append(_EVENT.validate_json(line))
        except (ValidationError, _BrokenSealError) as error:
            why = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
            raise SessionError(
                f"{path}, line {number}: torn or altered ({why}); the session was damaged after "
                "it was recorded, take it from a backup"
            ) from None
    return events


def settled_frames(
    events: Iterable[AnyEvent],
) -> tuple[dict[str, FrameRecorded], dict[str, FrameSkipped]]:
    """Frames that a journal says were recorded, and those that were skipped, by id.

    A frame that was lost is settled anew: what was said last of it holds.
    """
    recorded: dict[str, FrameRecorded] = {}
    skipped: dict[str, FrameSkipped] = {}
    for event in events:
        if isinstance(event, FrameRecorded):
            recorded[event.id] = event
            skipped.pop(event.id, None)
        elif isinstance(event, FrameSkipped):
            skipped[event.id] = event
            recorded.pop(event.id, None)
    return recorded, skipped


def lock_journal(path: Path) -> IO[bytes]:
    """Keep others from recording to the same session, until what is returned is closed.

    The lock goes with the process, however that ends. A disk that knows no locks has none.

    Raises
    ------
    SessionError
        Somebody else holds it.
    OSError
        There is no journal, or it cannot be written.
    """
    file = open(path, "r+b", buffering=0)  # noqa: SIM115 - whoever records closes it
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            file.close()
            raise SessionError(
                f"{path.parent} is being recorded by another process; wait for its end, or stop it"
            ) from None
    return file


class _BrokenSealError(Exception):
    pass


def _sealed(line: bytes, seal: bytes) -> bytes:
    checksum = zlib.crc32(seal + line)
    return line[:-1] + f',"seal":"{checksum:08x}"}}\n'.encode()


def _unsealed(line: bytes, seal_before: bytes) -> tuple[bytes, bytes]:
    """A line without its seal, and that seal; both are checked."""
    found = _SEAL.search(line)
    if found is None:
        if seal_before:
            raise _BrokenSealError("it has no seal")
        return line, b""
    bare = line[: found.start()] + b"}"
    if _sealed(bare, seal_before) != line + b"\n":
        raise _BrokenSealError("its seal is another line's")
    return bare, found.group(1)


def _end_of_journal(descriptor: int) -> tuple[int, bytes]:
    """Length of the whole lines of an open journal, and the seal of the last."""
    size = os.lseek(descriptor, 0, os.SEEK_END)
    content = os.pread(descriptor, size, 0)
    whole = content.rfind(b"\n") + 1
    found = _SEAL.search(content[:whole].rstrip(b"\n"))
    return whole, found.group(1) if found else b""
