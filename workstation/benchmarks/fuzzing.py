"""Damaged files read by many processes: what ends without a named error, and what passes unseen.

A target is a folder of good files and a reader of it. Each trial damages one file, reads the
folder in a process of its own limits, and sorts the end:

- *refused*: an :class:`~devices.errors.ImpastoError`, as it should be;
- *same*: what was read is what was written; the damage changed nothing that matters;
- *other*: something else was read. Where a checksum covers the file that is a silent error, and
  where none does it may be a valid other file;
- *unnamed*: any other exception, a crash of the process, or no end within the time.

A trial is known by its target and number, whatever ran before it.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import resource
import signal
import tempfile
import traceback
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from multiprocessing.connection import Connection
from pathlib import Path, PurePosixPath
from types import FrameType

import numpy as np

from acquisition.file_tree import files_below
from devices.errors import ImpastoError
from workstation.benchmarks.mutations import (
    Mutation,
    mutate_bytes,
    mutate_exr,
    mutate_json,
    mutate_png,
    mutate_text,
)

_TRIAL_SECONDS = 20
_ADDRESS_SPACE = 6 << 30
_STRUCTURED: dict[str, Mutation] = {
    ".json": mutate_json,
    ".exr": mutate_exr,
    ".jsonl": mutate_text,
    ".toml": mutate_text,
    ".xml": mutate_text,
    ".yml": mutate_text,
    ".sha256": mutate_text,
    ".cameramodel": mutate_text,
    ".lp": mutate_text,
    ".png": mutate_png,
}


class End(StrEnum):
    """How a trial ended."""

    REFUSED = "refused"
    SAME = "same"
    OTHER = "other"
    UNNAMED = "unnamed"


@dataclass(frozen=True)
class Target:
    """What is damaged and read.

    Attributes
    ----------
    name : str
    folder : Path
        Good files. The reader gets a copy of it.
    read : callable
        Reads the folder into a fingerprint; raises ImpastoError where it refuses.
    files : tuple of str
        Patterns of the files that are damaged.
    mend : callable
        Done to the folder after the damage: puts checksums right, so that damage gets past them.
    sealed : bool
        Whether checksums cover all that the fingerprint tells, so that nothing may pass as other.
    """

    name: str
    folder: Path
    read: Callable[[Path], bytes]
    files: tuple[str, ...] = ("**/*",)
    mend: Callable[[Path], None] | None = None
    sealed: bool = False


@dataclass
class Outcome:
    """Ends of the trials of a target, and the first trial of each thing that went wrong."""

    ends: Counter[End] = field(default_factory=Counter)
    failures: dict[str, int] = field(default_factory=dict)

    def add(self, end: End, number: int, why: str) -> None:
        """Count a trial."""
        self.ends[end] += 1
        if why:
            self.failures.setdefault(why, number)

    @property
    def trials(self) -> int:
        """Trials counted."""
        return sum(self.ends.values())


def fuzz(
    target: Target,
    trials: range,
    *,
    workers: int = 2,
    advance: Callable[[int], None] = lambda done: None,
) -> Outcome:
    """Run trials of a target in processes that may crash.

    Parameters
    ----------
    target : Target
    trials : range
        Numbers of the trials.
    workers : int
    advance : callable
        Called with the number of trials done since it was called last.

    Returns
    -------
    Outcome

    Raises
    ------
    ImpastoError
        The good files are refused.
    """
    expected = target.read(target.folder)
    outcome = Outcome()
    # Forked, so that a process that died costs no second start of Python and its packages.
    context = multiprocessing.get_context("fork")
    shares = [trials[first::workers] for first in range(workers)]
    running = {}
    for share in filter(len, shares):
        connection = _start(context, target, share, expected)
        running[connection] = share
    while running:
        for connection in multiprocessing.connection.wait(list(running)):  # type: ignore[assignment]
            assert isinstance(connection, Connection)
            share = running[connection]
            try:
                end, number, why = connection.recv()
            except EOFError:
                # The process died in the first trial that it did not report.
                number = share[0]
                end, why = End.UNNAMED, "the process died"
            outcome.add(end, number, why)
            advance(1)
            left = share[1:]
            running[connection] = left
            if not left or why == "the process died":
                del running[connection]
                connection.close()
                if left:
                    running[_start(context, target, left, expected)] = left
    return outcome


def _start(
    context: multiprocessing.context.ForkContext, target: Target, share: range, expected: bytes
) -> Connection:
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(target, share, expected, sender), daemon=True)
    process.start()
    sender.close()
    return receiver


def _work(target: Target, share: range, expected: bytes, sender: Connection) -> None:
    # Libraries print what they think of the files.
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    limit = _ADDRESS_SPACE + _address_space_used()
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, _give_up)
    with tempfile.TemporaryDirectory() as place:
        for number in share:
            sender.send(try_one(target, number, expected, Path(place)))


def _address_space_used() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


class _NoEndError(BaseException):
    pass


def _give_up(number: int, frame: FrameType | None) -> None:
    raise _NoEndError


def try_one(target: Target, number: int, expected: bytes, place: Path) -> tuple[End, int, str]:
    """One trial in this process.

    Returns
    -------
    end : End
    number : int
    why : str
        What went wrong, as exception and place; empty if nothing did.
    """
    random = np.random.default_rng([zlib.crc32(target.name.encode()), number])
    folder = place / "files"
    damage(target, folder, random)
    signal.alarm(_TRIAL_SECONDS)
    try:
        found = target.read(folder)
    except ImpastoError:
        return End.REFUSED, number, ""
    except _NoEndError:
        return End.UNNAMED, number, f"no end after {_TRIAL_SECONDS} s"
    except BaseException as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        said = f"{type(error).__name__} at {PurePosixPath(where.filename).name}:{where.lineno}"
        return End.UNNAMED, number, said
    finally:
        signal.alarm(0)
    if found == expected:
        return End.SAME, number, ""
    return End.OTHER, number, "read as something else" if target.sealed else ""


def damage(target: Target, folder: Path, random: np.random.Generator) -> str:
    """Copy a target's files to a folder with one of them damaged; say which."""
    wanted = {f for pattern in target.files for f in target.folder.glob(pattern) if f.is_file()}
    names = sorted(file.relative_to(target.folder).as_posix() for file in wanted)
    # Kinds of files first: a session has many frames and one plan.
    suffixes = sorted({Path(name).suffix for name in names})
    suffix = suffixes[random.integers(len(suffixes))]
    alike = [name for name in names if Path(name).suffix == suffix]
    name = alike[random.integers(len(alike))]
    content = (target.folder / name).read_bytes()
    blind = suffix not in _STRUCTURED or random.random() < 0.4
    mutation = mutate_bytes if blind else _STRUCTURED[suffix]
    _mirror(target.folder, folder)
    if random.random() < 0.02:
        (folder / name).unlink()
    else:
        (folder / name).write_bytes(mutation(content, random))
    if target.mend is not None:
        target.mend(folder)
    return name


def _mirror(source: Path, destination: Path) -> None:
    """Make the folder what the source is; files that are so already stay."""
    wanted = files_below(source)
    for name, file in files_below(destination).items():
        if name not in wanted:
            file.unlink()
    for name, original in wanted.items():
        content = original.read_bytes()
        copy = destination / name
        if not copy.is_file() or copy.read_bytes() != content:
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(content)


def fingerprint(*parts: bytes) -> bytes:
    """Digest of what a reader read."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.digest()
