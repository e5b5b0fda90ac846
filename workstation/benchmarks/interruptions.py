"""Commands cut off at random moments: what they leave behind."""

from __future__ import annotations

import hashlib
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import SessionError
from acquisition.journal import FrameRecorded, read_journal
from acquisition.session import JOURNAL_FILE, Session
from devices.errors import ImpastoError
from workstation.benchmarks.session_differences import frame_differences

IMPASTO = [sys.executable, "-m", "workstation.command_line"]
# As many commands at once as are interrupted; their run time is measured so, too.
_AT_ONCE = 2
_PATIENCE_S = 120.0
# Draws of moments for those at which the command had ended already.
_ROUNDS = 6
INTERRUPTED = 130
# Before the command listens the interpreter loads: a signal ends it by default, or with an error.
_ENDED_LOADING = {-signal.SIGINT, 1}


@dataclass(frozen=True)
class Command:
    """A command that writes something, and how it is told whether all of it is there.

    Attributes
    ----------
    name : str
    words : callable
        Arguments, given the folder that is to hold everything that is made. What a whole run leaves
        there is what every run must leave, or nothing.
    check : callable
        Given that folder; raises ImpastoError where something in it is not whole.
    prepare : callable
        Puts what is to be changed into the folder.
    resumable : str, optional
        A session in the folder that may be left unfinished, to be gone on with.
    same : bool
        Whether a session that was gone on with has the manifest of one that was not interrupted.
    kept : frozenset of str
        What may be left of an interrupted run besides, and is whole in itself.
    program : tuple of str, optional
        What the arguments are given to, instead of ``impasto`` itself.
    afterwards : callable
        Given the folder when a run has ended in whatever way: what is wrong then, or None.
    """

    name: str
    words: Callable[[Path], list[str]]
    check: Callable[[Path], object]
    prepare: Callable[[Path], object] = lambda folder: None
    resumable: str | None = None
    same: bool = True
    kept: frozenset[str] = frozenset()
    program: tuple[str, ...] | None = None
    afterwards: Callable[[Path], str | None] = lambda folder: None

    def line(self, folder: Path) -> list[str]:
        """The whole command line."""
        return [*(self.program or IMPASTO), *self.words(folder)]


@dataclass
class Interruptions:
    """What came of interrupting a command.

    Attributes
    ----------
    command : str
    seed : int
        Of the moments.
    lasting_s : float
        Run time of the command that nobody interrupts, two at once.
    moments_s : list of float
        When it was interrupted while it ran, seconds after its start.
    finished : int
        Runs that were interrupted too late, and ended with all that they make.
    missed : int
        Runs that ended before they could be interrupted, beside those counted.
    wrong : list of str
        What was left half.
    """

    command: str
    seed: int
    lasting_s: float = 0.0
    moments_s: list[float] = field(default_factory=list)
    finished: int = 0
    missed: int = 0
    wrong: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Cut:
    """How a run ended.

    Attributes
    ----------
    struck : bool
        Whether it ran when it was to be struck.
    listened : bool
        Whether it waited for the signal by then.
    seconds : float
        From its start until it was struck, or until its end.
    code : int
    said : str
        Last line of its messages.
    """

    struck: bool
    listened: bool
    seconds: float
    code: int
    said: str


@dataclass(frozen=True)
class _End:
    """How a run was cut off, and what it left half."""

    cut: _Cut
    wrong: str | None


@dataclass(frozen=True)
class _Whole:
    """What a run leaves that nobody interrupts."""

    names: frozenset[str]
    session: Session | None


def interrupt(
    command: Command,
    place: Path,
    *,
    times: int,
    seed: int = 0,
    advance: Callable[[], None] = lambda: None,
) -> Interruptions:
    """Interrupt a command by SIGINT at random moments of its run time, and look at what is left.

    The moments are random in as many equal parts of the run time as there are of them, so that
    they are spread over all of it. A run that has ended by its moment is begun again with another.

    Parameters
    ----------
    command : Command
    place : Path
        An empty folder.
    times : int
    seed : int
    advance : callable
        Called for each interrupted run.

    Returns
    -------
    Interruptions
    """
    random = np.random.default_rng(seed)
    done = Interruptions(command.name, seed)
    whole = _run_whole(command, place, done)
    if whole is None:
        return done
    number = 0
    for _ in range(_ROUNDS):
        missing = times - len(done.moments_s)
        if missing == 0:
            break
        moments = spread_moments(missing, done.lasting_s, random)
        folders = [place / str(number + offset) for offset in range(missing)]
        number += missing
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            jobs = zip(folders, moments.tolist(), strict=True)
            ends = list(pool.map(lambda job: _once(command, whole, *job), jobs))
        for end in ends:
            if end.wrong:
                done.wrong.append(f"{command.name} after {end.cut.seconds:.2f} s: {end.wrong}")
            if end.cut.struck:
                advance()
                done.moments_s.append(end.cut.seconds)
                done.finished += end.cut.code == 0
            else:
                done.missed += 1
        whole_s = [end.cut.seconds for end in ends if not end.cut.struck and end.cut.code == 0]
        if whole_s:
            # What they took tells better how long the command runs by now.
            done.lasting_s = float(np.mean(whole_s))
    return done


def spread_moments(
    times: int, lasting_s: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """Moments (times,), one at random in each of as many equal parts of a length of time."""
    parts = (np.arange(times) + random.uniform(size=times)) / times
    return np.asarray(lasting_s * random.permutation(parts))


def _run_whole(command: Command, place: Path, done: Interruptions) -> _Whole | None:
    """Let the command run to its end, as many at once as will be interrupted."""

    def once(number: int) -> tuple[float, str | None]:
        folder = place / f"whole-{number}"
        folder.mkdir()
        command.prepare(folder)
        begun = time.perf_counter()
        ended = subprocess.run(command.line(folder), capture_output=True, text=True, check=False)
        failed = ended.stderr.strip() if ended.returncode else command.afterwards(folder)
        return time.perf_counter() - begun, failed

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        runs = list(pool.map(once, range(_AT_ONCE)))
    for _, failed in runs:
        if failed is not None:
            done.wrong.append(f"{command.name} fails when nobody interrupts it: {failed}")
            return None
    done.lasting_s = float(np.mean([seconds for seconds, _ in runs]))
    folder = place / "whole-0"
    command.check(folder)
    names = frozenset(path.name for path in folder.iterdir()) - command.kept
    session = Session.open(folder / command.resumable) if command.resumable else None
    return _Whole(names, session)


def _once(command: Command, whole: _Whole, folder: Path, moment: float) -> _End:
    folder.mkdir()
    command.prepare(folder)
    before = {path.name for path in folder.iterdir()}
    cut = _cut_off(command.line(folder), moment, signal.SIGINT)
    wrong = command.afterwards(folder) or _left_behind(command, whole, folder, before, cut)
    shutil.rmtree(folder)
    return _End(cut, wrong)


def _left_behind(
    command: Command, whole: _Whole, folder: Path, before: set[str], cut: _Cut
) -> str | None:
    ended = cut.code
    if cut.struck and not cut.listened and ended in _ENDED_LOADING:
        ended = INTERRUPTED
    if ended not in (0, INTERRUPTED):
        return f"ended with {ended}: {cut.said}"
    if ended != 0 and command.resumable is not None:
        same = whole.session if command.same else None
        return _resume(folder / command.resumable, same, before, command.kept)
    left = {path.name for path in folder.iterdir()} - command.kept
    if ended != 0 and left <= before:
        return None
    # A request that comes when everything is made is too late: all of it is put in place.
    if left != whole.names:
        return f"ended with {ended} and left {', '.join(sorted(left)) or 'nothing'}"
    try:
        command.check(folder)
    except (ImpastoError, OSError, ValueError) as error:
        return f"made what is not whole: {error}"
    return None


def _resume(
    session: Path, whole: Session | None, before: set[str], kept: frozenset[str]
) -> str | None:
    """Go on with a session that was cut off; what it lacks then of a whole one."""
    left = {path.name for path in session.parent.iterdir()} - kept
    if not left - before - {session.name}:
        if not session.exists():
            return None
        return _resumed(session, whole)
    return _opened(session, whole)


def _resumed(session: Path, whole: Session | None) -> str | None:
    """Go on with a session; what is wrong with it then."""
    words = [*IMPASTO, "resume", str(session)]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    if ended.returncode:
        return f"cannot be resumed: {ended.stderr.strip()}"
    return _opened(session, whole)


def _opened(session: Path, whole: Session | None) -> str | None:
    """What is wrong with a session that should be whole, and as another if one is given."""
    try:
        found = Session.open(session)
    except SessionError as error:
        return f"resumed to what is not whole: {error}"
    if whole is None or found.digest == whole.digest:
        return None
    how = ", ".join(frame_differences(found, whole))
    return f"resumed to another manifest; frames that differ: {how or 'none'}"


@dataclass
class Recordings:
    """Recordings killed and resumed.

    Attributes
    ----------
    kills : int
        While they recorded.
    lost_frames : int
        That had been acknowledged.
    missed : int
        Runs that were killed before they recorded anything, or had ended.
    wrong : list of str
        What could not be gone on with.
    """

    kills: int = 0
    lost_frames: int = 0
    missed: int = 0
    wrong: list[str] = field(default_factory=list)


def kill_recordings(
    rig: Path,
    place: Path,
    *,
    times: int,
    seed: int = 0,
    advance: Callable[[], None] = lambda: None,
) -> Recordings:
    """Kill scans without warning at random moments, look at what was acknowledged, and resume.

    Parameters
    ----------
    rig : Path
        A ``rig.toml`` of simulated devices.
    place : Path
        An empty folder.
    times : int
    seed : int
    advance : callable
        Called for each recording that was killed.

    Returns
    -------
    Recordings
    """
    random = np.random.default_rng(seed)
    done = Recordings()
    scan = ["scan", str(rig), "--out"]

    def record(number: int) -> float:
        begun = time.perf_counter()
        words = [*IMPASTO, *scan, str(place / f"whole-{number}")]
        subprocess.run(words, capture_output=True, check=True)
        return time.perf_counter() - begun

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        lasting_s = float(np.mean(list(pool.map(record, range(_AT_ONCE)))))
    whole = Session.open(place / "whole-0")
    early: list[float] = []
    late: list[float] = []

    def once(job: tuple[int, float]) -> None:
        out = place / str(job[0])
        cut = _cut_off([*IMPASTO, *scan, str(out)], job[1], signal.SIGKILL)
        if not (cut.struck and (out / JOURNAL_FILE).is_file()):
            done.missed += 1
            (early if cut.struck else late).append(cut.seconds)
            shutil.rmtree(out, ignore_errors=True)
            return
        done.kills += 1
        advance()
        done.lost_frames += _lost_frames(out)
        wrong = _resumed(out, whole)
        if wrong:
            done.wrong.append(f"scan killed after {cut.seconds:.2f} s: {wrong}")
        shutil.rmtree(out)

    number = 0
    for _ in range(_ROUNDS):
        missing = times - done.kills
        if missing == 0:
            break
        # What was missed tells better when a scan records.
        begins_s = float(np.mean(early)) if early else 0.0
        ends_s = max(float(np.mean(late)) if late else lasting_s, begins_s)
        moments = (begins_s + spread_moments(missing, ends_s - begins_s, random)).tolist()
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            list(pool.map(once, enumerate(moments, start=number)))
        number += missing
    return done


def _lost_frames(session: Path) -> int:
    """Frames that the journal acknowledges and that are not there as it says."""
    lost = 0
    for event in read_journal(session / JOURNAL_FILE):
        if isinstance(event, FrameRecorded):
            file = session / event.file
            good = file.is_file() and hashlib.sha256(file.read_bytes()).hexdigest() == event.sha256
            lost += not good
    return lost


def _cut_off(line: list[str], after_s: float, sign: signal.Signals) -> _Cut:
    """Run a command line and strike it."""
    with tempfile.TemporaryFile() as messages:
        begun = time.perf_counter()
        running = subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=messages)
        struck = listened = False
        try:
            code = running.wait(timeout=after_s)
            seconds = time.perf_counter() - begun
        except subprocess.TimeoutExpired:
            struck, listened = True, _listens(running.pid)
            running.send_signal(sign)
            seconds = time.perf_counter() - begun
            code = _end_of(running)
        messages.seek(0)
        lines = messages.read().decode(errors="replace").split("\n")
    said = next((line for line in reversed(lines) if line.strip()), "no message")
    return _Cut(struck, listened, seconds, code, said)


def _end_of(running: subprocess.Popen[bytes]) -> int:
    try:
        return running.wait(timeout=_PATIENCE_S)
    except subprocess.TimeoutExpired:
        running.kill()
        return running.wait()


def _listens(process: int) -> bool:
    """Whether a process blocks SIGINT: the command then waits for it in a thread of its own."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:  # it has ended
        return False
    blocked = next(line for line in status.splitlines() if line.startswith("SigBlk:"))
    return bool(int(blocked.split()[1], 16) >> (signal.SIGINT - 1) & 1)
