"""How two sessions that should be the same differ: which frames, by how much, and since when."""

from __future__ import annotations

import numpy as np

from acquisition.journal import AnyEvent, FrameRecorded, Start, read_journal
from acquisition.session import JOURNAL_FILE, Session


def frame_differences(found: Session, other: Session) -> list[str]:
    """Frames of a session whose files are not those of another, each with what differs.

    Parameters
    ----------
    found : Session
        Perhaps one that was cut off, and gone on with.
    other : Session
        What it should be.

    Raises
    ------
    SessionError
        A frame cannot be read.
    """
    files = [
        {name: one.sha256 for name, one in session.recorded.items()}.items()
        for session in (found, other)
    ]
    differing = sorted({name for name, _ in files[0] ^ files[1]})
    return [f"{name} ({_difference(name, found, other)})" for name in differing]


def _difference(name: str, found: Session, other: Session) -> str:
    if name not in found.recorded or name not in other.recorded:
        return "missing" if name in other.recorded else "only there"
    when = _when_recorded(name, found)
    here, there = (session.read_frame(name) for session in (found, other))
    if here.shape != there.shape:
        return f"{when}of another size"
    off = np.abs(here.astype(np.int64) - there)
    count = np.count_nonzero(off)
    if not count:
        return f"{when}every sample is the same, coded in other bytes"
    return f"{when}{count} of {off.size} samples, by {off.max()} at most"


def _when_recorded(name: str, session: Session) -> str:
    """Whether a frame was recorded before its session was cut off or after; empty if it was not."""
    events = list(read_journal(session.path / JOURNAL_FILE))
    cuts = [n for n, event in enumerate(events) if isinstance(event, Start) and event.resumed]
    if not cuts:
        return ""
    # One that was found damaged is recorded again.
    at = max(n for n, event in enumerate(events) if _records(event, name))
    return f"recorded {'before' if at < cuts[0] else 'after'} it was cut off; "


def _records(event: AnyEvent, name: str) -> bool:
    return isinstance(event, FrameRecorded) and event.id == name
