"""Room on the disk: what a recording needs, and whether it is there."""

from __future__ import annotations

import shutil
from pathlib import Path

from acquisition.errors import SessionError
from acquisition.plan import Plan

# Kept free for the journal, the manifest, and everything else that runs on the machine.
_RESERVE_BYTES = 32 * 2**20


def frame_bytes(plan: Plan) -> int:
    """Most bytes that the file of a frame takes: noise hardly compresses."""
    depth = 1 if plan.saturation_level <= 255 else 2
    # PNG: a byte per row, and some for each chunk.
    return plan.crop.height * (plan.crop.width * depth + 1) * 101 // 100 + 4096


def bytes_needed(plan: Plan, *, frames: int | None = None) -> int:
    """Most bytes that a recording takes.

    Parameters
    ----------
    plan : Plan
    frames : int, optional
        How many are still to come; by default, all of them.
    """
    count = len(plan.frames) if frames is None else frames
    return count * frame_bytes(plan)


def free_bytes(folder: Path) -> int:
    """Bytes free where a folder is, or will be.

    Raises
    ------
    SessionError
        The disk does not tell.
    """
    place = Path(folder).absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    try:
        return shutil.disk_usage(place).free
    except OSError as error:
        raise SessionError(f"{place}: the disk does not tell its free space ({error})") from None


def require_space(folder: Path, needed: int, *, what: str) -> None:
    """Refuse to go on where a disk has too little room.

    Parameters
    ----------
    folder : Path
    needed : int
        Bytes to be written.
    what : str
        What needs them, for the message.

    Raises
    ------
    SessionError
        Less is free than is needed and a reserve.
    """
    free = free_bytes(folder)
    if free < needed + _RESERVE_BYTES:
        raise SessionError(
            f"{what} may take {_megabytes(needed)} and {_megabytes(_RESERVE_BYTES)} stay free for "
            f"the rest, but the disk of {folder} has {_megabytes(free)}; free some space, or "
            "record to another disk"
        )


def _megabytes(count: int) -> str:
    return f"{count / 1e6:,.0f} MB"
