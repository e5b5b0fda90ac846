"""Stages that run only when something they depend on has changed.

The result of a stage is stored under a key: a digest of the program's own source, the stage's name,
its parameters, and the keys of the stages before it. A stage whose key is that of the stored result
is not run. The result itself is read, and its digest compared, where it is first asked for; a stage
whose result is damaged then runs after all. One result is kept of each stage.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from acquisition.atomic_files import file_in_progress
from acquisition.file_tree import files_below
from devices.errors import ImpastoError
from workstation.result_files import PACKAGES, ResultFileError, read_result, write_result

T = TypeVar("T")
# proc(5): 5 sets the process's peak of resident memory back to what it holds now.
_CLEAR_REFS, _FORGET_PEAK = Path("/proc/self/clear_refs"), "5"
_STATUS = Path("/proc/self/status")


class StagesInUseError(ImpastoError):
    """Another run is storing results in the same folder."""


@dataclass(frozen=True)
class StageRun:
    """What became of a stage.

    Attributes
    ----------
    name : str
    seconds : float
        Of running it, or of looking that it need not run.
    skipped : bool
        Whether the stored result was taken.
    saved_s : float
        What the stage took when it ran, if it was skipped.
    peak_mb : float
        Most memory that the process held while the stage ran; 0 where that is not known.
    """

    name: str
    seconds: float
    skipped: bool
    saved_s: float = 0.0
    peak_mb: float = 0.0


@dataclass(frozen=True)
class StageResult(Generic[T]):
    """A result that is read from the disk when it is first asked for.

    Attributes
    ----------
    key : str
        What later stages depend on.
    """

    key: str
    _get: Callable[[], T]

    def get(self) -> T:
        """The result itself."""
        return self._get()


@dataclass
class StageCache:
    """Stored results of the stages of one piece of work.

    Attributes
    ----------
    folder : Path or None
        Where results are kept; None keeps none, and every stage runs.
    runs : list of StageRun
        What became of each stage, in order.
    begin : callable
        Called with the name of each stage that runs, as it starts.
    done : callable
        Called with what became of each stage, as it ends or is left out.
    """

    folder: Path | None
    begin: Callable[[str], None] = lambda stage: None
    runs: list[StageRun] = field(default_factory=list)
    done: Callable[[StageRun], None] = lambda run: None

    def run(
        self, name: str, compute: Callable[[], T], *, depends_on: tuple[str, ...], parameters: Any
    ) -> StageResult[T]:
        """Run a stage, unless its stored result is that of the same program, inputs and parameters.

        Parameters
        ----------
        name : str
            Of letters, digits, spaces and hyphens.
        compute : callable
            Runs the stage.
        depends_on : tuple of str
            Keys of the results it is made from, and digests of other inputs.
        parameters : Any
            A dataclass, or plain values.

        Returns
        -------
        StageResult

        Raises
        ------
        ImpastoError
            From the stage.
        """
        began = time.perf_counter()
        key = _key(name, depends_on, parameters)
        note = self._note(name)
        if note.get("key") == key and self._file(name, ".npz").is_file():
            saved, peak = (_number(note.get(what)) for what in ("seconds", "peak_mb"))
            self._end(StageRun(name, time.perf_counter() - began, True, saved, peak))
            digest = str(note.get("digest"))
            return StageResult(key, cache(lambda: self._read(name, key, digest, compute)))
        value = self._compute(name, key, compute)
        return StageResult(key, lambda: value)

    def _compute(self, name: str, key: str, compute: Callable[[], T]) -> T:
        """Run a stage, and store its result; what became of it before is forgotten."""
        self.begin(name)
        began = time.perf_counter()
        with peak_memory() as peak_mb:
            value = compute()
        run = StageRun(name, time.perf_counter() - began, False, 0.0, peak_mb())
        self._end(run)
        if self.folder is not None:
            # Where there is no room for it, the next run has to do the work again.
            with contextlib.suppress(OSError):
                self._store(run, key, value)
        return value

    def _end(self, run: StageRun) -> None:
        names = [earlier.name for earlier in self.runs]
        if run.name in names:
            self.runs[names.index(run.name)] = run
        else:
            self.runs.append(run)
        self.done(run)

    def _read(self, name: str, key: str, digest: str, compute: Callable[[], T]) -> T:
        try:
            value: T = read_result(self._file(name, ".npz"), digest)
        except ResultFileError:
            return self._compute(name, key, compute)
        return value

    def _store(self, run: StageRun, key: str, value: Any) -> None:
        """Store a result and then its key, so that a key never names another's result."""
        note, file = self._file(run.name, ".json"), self._file(run.name, ".npz")
        note.parent.mkdir(parents=True, exist_ok=True)
        note.unlink(missing_ok=True)
        told = {
            "key": key,
            "digest": write_result(value, file),
            "seconds": round(run.seconds, 3),
            "peak_mb": round(run.peak_mb, 1),
        }
        with file_in_progress(note) as unfinished:
            unfinished.write_text(json.dumps(told))

    def _note(self, name: str) -> dict[str, Any]:
        """What is noted of a stage's last run; empty where nothing is."""
        return {} if self.folder is None else _read_note(self._file(name, ".json"))

    def _file(self, name: str, suffix: str) -> Path:
        assert self.folder is not None  # whoever asks has seen to it
        return self.folder / f"{name.replace(' ', '-')}{suffix}"


@contextmanager
def sole_use(folder: Path | None) -> Iterator[None]:
    """Keep other runs from storing results in a folder while the block runs.

    Each would take for its own what the other has stored and written. The lock goes with the
    process, however that ends. Where the folder cannot be made nothing is stored either.

    Raises
    ------
    StagesInUseError
        Another run is at it.
    """
    if folder is None:
        yield
        return
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            stack.callback(_remove_if_empty, folder)
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, descriptor)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StagesInUseError(
                    f"{folder}: another run is making a copy with these stages; wait for its end, "
                    "or name another folder with --stages"
                ) from None
        yield


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()


@contextmanager
def peak_memory() -> Iterator[Callable[[], float]]:
    """Most memory, MB, that the process holds from here until the value is asked for.

    0 where the system does not tell (it does on Linux).
    """
    with contextlib.suppress(OSError):
        _CLEAR_REFS.write_text(_FORGET_PEAK)
    yield _peak_mb


def _peak_mb() -> float:
    try:
        status = _STATUS.read_text()
    except OSError:
        return 0.0
    found = re.search(r"^VmHWM:\s+(\d+) kB$", status, re.MULTILINE)
    return int(found[1]) / 1024 if found else 0.0


def digest_of_files(folder: Path) -> str:
    """Digest of every file below a folder, by name and content."""
    digest = hashlib.sha256()
    for name, file in files_below(folder).items():
        content = file.read_bytes()
        digest.update(f"{name} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()


def _key(name: str, depends_on: tuple[str, ...], parameters: Any) -> str:
    plain = is_dataclass(parameters) and not isinstance(parameters, type)
    stated = asdict(parameters) if plain else parameters
    what = json.dumps(
        [digest_of_program(), name, list(depends_on), stated], default=_plain, sort_keys=True
    )
    return hashlib.sha256(what.encode()).hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.ndarray):
        return [value.shape, str(value.dtype), hashlib.sha256(value.tobytes()).hexdigest()]
    raise TypeError(f"a {type(value).__name__} is no parameter of a stage")


@cache
def digest_of_program() -> str:
    """Digest of the program's source: another version may have other results."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for package in PACKAGES:
        for file in sorted((root / package).rglob("*.py")):
            digest.update(file.relative_to(root).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else 0.0


def _read_note(path: Path) -> dict[str, Any]:
    try:
        note = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return note if isinstance(note, dict) else {}
