"""Commands cut off at random moments: what they leave behind."""

from __future__ import annotations

import hashlib
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from acquisition.errors import SessionError
from acquisition.journal import FrameRecorded, read_journal
from acquisition.session import JOURNAL_FILE, Session
from devices.errors import ImpastoError
from fitting.copy_files import read_copy

_COMMAND = [sys.executable, "-m", "workstation.command_line"]
_PATIENCE_S = 120.0
# A signal that comes before the command has begun ends the interpreter by its default action.
_ENDED = {0, 130, -signal.SIGINT, -signal.SIGTERM}
# While it loads its own modules the interpreter may also end with an error.
_LOADING_S = 0.5


@dataclass(frozen=True)
class Command:
    """A command that makes one thing, whole or not at all.

    Attributes
    ----------
    name : str
    words : callable
        Arguments, given the path of what is to be made.
    check : callable
        Raises ImpastoError where what was made is not whole.
    beside : tuple of str
        What else it makes, for a result that is called ``out``.
    """

    name: str
    words: Callable[[Path], list[str]]
    check: Callable[[Path], object]
    beside: tuple[str, ...] = ()


def commands(session: Path, copy: Path, capture: Path, description: Path) -> tuple[Command, ...]:
    """The commands that read files and make others."""

    def importing(out: Path) -> list[str]:
        return ["import", str(capture), "--capture", str(description), "--out", str(out)]

    def rendering(out: Path) -> list[str]:
        views = ["--mode", "bump", "--view", "all", "--size", "160x120"]
        return ["render", str(copy), "--out", str(out), *views]

    def processing(out: Path) -> list[str]:
        return ["process", str(session), "--out", str(out)]

    return (
        Command("import", importing, Session.open),
        Command("process", processing, read_copy, ("out-relief.png", "out-run.json")),
        Command("render", rendering, _check_pictures),
    )


def interrupt(command: Command, place: Path, *, times: int, seed: int = 0) -> list[str]:
    """Interrupt a command at random moments and look at what is left.

    Parameters
    ----------
    command : Command
    place : Path
        An empty folder.
    times : int
    seed : int

    Returns
    -------
    list of str
        What was found wrong.
    """
    random = np.random.default_rng(seed)
    begun = time.perf_counter()
    done = subprocess.run(
        [*_COMMAND, *command.words(place / "whole")], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        return [f"{command.name} fails when nobody interrupts it: {done.stderr.strip()}"]
    lasting = time.perf_counter() - begun
    moments = random.uniform(0.0, lasting, times)
    signs = random.choice([signal.SIGINT, signal.SIGTERM], times)

    def once(number: int) -> str | None:
        folder = place / str(number)
        folder.mkdir()
        ended = _cut_off(
            command.words(folder / "out"), float(moments[number]), signal.Signals(signs[number])
        )
        if ended == 1 and moments[number] < _LOADING_S:
            ended = -int(signs[number])
        wrong = _left_behind(command, folder, ended)
        shutil.rmtree(folder)
        return wrong and f"{command.name} after {moments[number]:.2f} s: {wrong}"

    with ThreadPoolExecutor(2) as pool:
        return [wrong for wrong in pool.map(once, range(times)) if wrong]


def _left_behind(command: Command, folder: Path, ended: int) -> str | None:
    # Results of stages are kept for the next run, and are whole each: see workstation.stage_cache.
    left = {path.name for path in folder.iterdir()} - {"out-stages"}
    whole = {"out", *command.beside}
    if ended not in _ENDED:
        return f"ended with {ended}"
    if ended != 0 and not left:
        return None
    # A request that comes while the result is written waits until all of it is there.
    if left != whole:
        return f"ended with {ended} and left {', '.join(sorted(left)) or 'nothing'}"
    try:
        command.check(folder / "out")
    except ImpastoError as error:
        return f"made what is not whole: {error}"
    return None


def _check_pictures(folder: Path) -> None:
    for path in folder.rglob("*.png"):
        # A PNG ends with the chunk IEND and its checksum.
        if not path.read_bytes().endswith(b"IEND\xaeB`\x82"):
            raise SessionError(f"{path}: cut off")


@dataclass(frozen=True)
class Recordings:
    """Recordings killed and resumed: frames acknowledged and lost, and what else was wrong."""

    kills: int
    lost_frames: int
    wrong: tuple[str, ...]


def kill_recordings(rig: Path, place: Path, *, times: int, seed: int = 0) -> Recordings:
    """Kill scans without warning at random moments, look at what was acknowledged, and resume.

    Parameters
    ----------
    rig : Path
        A ``rig.toml`` of simulated devices.
    place : Path
        An empty folder.
    times : int
    seed : int

    Returns
    -------
    Recordings
    """
    random = np.random.default_rng(seed)
    begun = time.perf_counter()
    whole = place / "whole"
    scan = ["scan", str(rig), "--out"]
    subprocess.run([*_COMMAND, *scan, str(whole)], capture_output=True, check=True)
    lasting = time.perf_counter() - begun
    digest = Session.open(whole).digest
    moments = random.uniform(0.3 * lasting, lasting, times)

    def once(number: int) -> tuple[int, str | None]:
        out = place / str(number)
        _cut_off([*scan, str(out)], float(moments[number]), signal.SIGKILL)
        if not (out / JOURNAL_FILE).is_file():
            shutil.rmtree(out, ignore_errors=True)
            return 0, None
        lost = _lost_frames(out)
        subprocess.run([*_COMMAND, "resume", str(out)], capture_output=True, check=False)
        try:
            wrong = None if Session.open(out).digest == digest else "resumed to another manifest"
        except SessionError as error:
            wrong = str(error)
        shutil.rmtree(out)
        return lost, wrong and f"scan killed after {moments[number]:.2f} s: {wrong}"

    with ThreadPoolExecutor(2) as pool:
        ends = list(pool.map(once, range(times)))
    return Recordings(times, sum(n for n, _ in ends), tuple(wrong for _, wrong in ends if wrong))


def _lost_frames(session: Path) -> int:
    """Frames that the journal acknowledges and that are not there as it says."""
    lost = 0
    for event in read_journal(session / JOURNAL_FILE):
        if isinstance(event, FrameRecorded):
            file = session / event.file
            good = file.is_file() and hashlib.sha256(file.read_bytes()).hexdigest() == event.sha256
            lost += not good
    return lost


def _cut_off(words: list[str], after_s: float, sign: signal.Signals) -> int:
    running = subprocess.Popen(
        [*_COMMAND, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        return running.wait(timeout=after_s)
    except subprocess.TimeoutExpired:
        running.send_signal(sign)
    try:
        return running.wait(timeout=_PATIENCE_S)
    except subprocess.TimeoutExpired:
        running.kill()
        return running.wait()
