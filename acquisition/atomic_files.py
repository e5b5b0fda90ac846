"""Files and folders that appear whole or not at all.

A file is written beside its destination, flushed to the disk, and renamed over it; a folder is
filled under a temporary name and renamed when it is complete. Whoever reads sees the old state or
the new one, never half of one, whatever interrupts the writer.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Part of every temporary name, so that what a killed process left can be told from real files.
_MARK = ".in-progress-"


def fsync_folder(folder: Path) -> None:
    """Flush a folder's entries, so that a rename inside it survives a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def file_in_progress(destination: Path) -> Iterator[Path]:
    """Yield a temporary path that becomes ``destination`` when the block ends without error.

    The temporary name keeps the destination's suffix, because image writers choose the format by
    it. On any error, interruption included, the temporary file is removed and ``destination`` is
    left as it was.

    Raises
    ------
    FileNotFoundError
        The folder of ``destination`` does not exist.
    """
    destination = Path(destination)
    if not destination.parent.is_dir():
        raise FileNotFoundError(f"{destination}: there is no folder {destination.parent}")
    descriptor, name = tempfile.mkstemp(
        prefix=f".{destination.stem}{_MARK}", suffix=destination.suffix, dir=destination.parent
    )
    os.close(descriptor)
    temporary = Path(name)
    try:
        yield temporary
        with open(temporary, "rb") as written:
            os.fsync(written.fileno())
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(destination)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    fsync_folder(destination.parent)


def write_bytes(destination: Path, content: bytes) -> None:
    """Write ``content`` to ``destination``, whole or not at all."""
    with file_in_progress(destination) as temporary:
        descriptor = os.open(temporary, os.O_WRONLY)
        try:
            write_all(descriptor, content)
        finally:
            os.close(descriptor)


def write_all(descriptor: int, content: bytes) -> None:
    """Write all of ``content`` to an open file."""
    left = memoryview(content)
    while left:
        left = left[os.write(descriptor, left) :]


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that a killed writer left in a folder or below it."""
    for file in Path(folder).rglob(f".*{_MARK}*"):
        if file.is_file():
            file.unlink()


@contextmanager
def folder_in_progress(destination: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield a temporary folder that becomes ``destination`` when the block ends without error.

    Parameters
    ----------
    destination : Path
        The folder to make; its parent is made if needed.
    replace : bool
        Whether an existing ``destination`` is replaced; otherwise it is an error.

    Raises
    ------
    FileExistsError
        ``destination`` exists and ``replace`` is false, or appeared meanwhile with files in it.
    """
    destination = Path(destination)
    if destination.exists() and not replace:
        raise FileExistsError(f"{destination} exists already")
    destination.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(
        tempfile.mkdtemp(prefix=f".{destination.name}{_MARK}", dir=destination.parent.absolute())
    )
    try:
        temporary.chmod(0o777 & ~_umask())
        yield temporary
        _rename_folder(temporary, destination, replace=replace)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    fsync_folder(destination.parent)


def _rename_folder(temporary: Path, destination: Path, *, replace: bool) -> None:
    if not destination.exists() or (destination.is_dir() and not any(destination.iterdir())):
        temporary.rename(destination)
        return
    if not replace:
        raise FileExistsError(f"{destination} exists already: it appeared meanwhile")
    # A folder cannot be renamed over a full one: step the old one aside, and back on failure.
    aside = Path(tempfile.mkdtemp(prefix=f".{destination.name}{_MARK}", dir=destination.parent))
    destination.rename(aside / "old")
    try:
        temporary.rename(destination)
    except BaseException:
        (aside / "old").rename(destination)
        raise
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
