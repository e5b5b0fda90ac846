"""The journal of a session: one line per event, appended and flushed before anything goes on.

A line is written with its newline in one go, so a last line without one was torn by a crash: the
event did not happen. A torn line anywhere else means that the file was damaged later, and is
refused.
"""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from acquisition.errors import SessionError


class StopReason(StrEnum):
    """Why a recording ended."""

    SUCCESS = "success"
    ABORTED = "aborted"
    FAILED = "failed"


class _Event(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    wall_time: float
    monotonic_s: float


class Start(_Event):
    """Recording began, or began again."""

    event: Literal["start"] = "start"
    resumed: bool = False


class FrameRecorded(_Event):
    """A frame is safe on the disk; its times are those of the exposure."""

    event: Literal["frame"] = "frame"
    id: str
    file: str
    sha256: str
    sequence: int
    exposure_applied_s: float | None = None


class Stop(_Event):
    """Recording ended."""

    event: Literal["stop"] = "stop"
    reason: StopReason
    why: str = ""


Event = Annotated[Start | FrameRecorded | Stop, Field(discriminator="event")]
_EVENT: TypeAdapter[Start | FrameRecorded | Stop] = TypeAdapter(Event)


def append_event(path: Path, event: Start | FrameRecorded | Stop) -> None:
    """Append one event and flush it to the disk."""
    line = (event.model_dump_json() + "\n").encode()
    with open(path, "ab") as journal:
        journal.write(line)
        journal.flush()
        os.fsync(journal.fileno())


def read_journal(path: Path) -> list[Start | FrameRecorded | Stop]:
    """Events of a journal, a torn last line left out.

    Raises
    ------
    SessionError
        The journal is missing, or a line before the last is torn.
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
    for number, line in enumerate(lines, start=1):
        try:
            events.append(_EVENT.validate_json(line))
        except ValidationError as error:
            raise SessionError(
                f"{path}, line {number}: torn or altered ({error.errors()[0]['msg']}); the session "
                "was damaged after it was recorded, take it from a backup"
            ) from None
    return events


def drop_torn_line(path: Path) -> None:
    """Cut a journal back to its last whole line, so that more can be appended."""
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with open(path, "r+b") as journal:
            journal.truncate(whole)
            os.fsync(journal.fileno())
