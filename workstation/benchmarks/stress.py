"""Stress: damaged files, changes that must not matter, commands cut off at any moment.

Each part can be measured by itself; every record says how often it was tried and by which seeds.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from acquisition.session import Session
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks import interrupted_commands
from workstation.benchmarks.appearance_invariances import (
    reflectance_invariances,
    render_invariances,
)
from workstation.benchmarks.calibration_invariances import (
    calibration_invariances,
    light_arm_invariances,
)
from workstation.benchmarks.decoding_invariances import decoding_invariances, merging_invariances
from workstation.benchmarks.fuzz_targets import TARGETS, make_targets
from workstation.benchmarks.fuzzing import End, Outcome, Target, fuzz
from workstation.benchmarks.interrupted_commands import Inputs
from workstation.benchmarks.interruptions import (
    Interruptions,
    Recordings,
    interrupt,
    kill_recordings,
)
from workstation.benchmarks.invariances import Invariance
from workstation.benchmarks.surface_invariances import (
    registration_invariances,
    surface_invariances,
)
from workstation.progress import progress

# Trials of each target, by how long one takes and how much there is to get wrong.
_TRIALS = {
    "session as recorded": 6000,
    "session resealed": 1500,
    "rig.toml": 4000,
    "capture.toml": 1500,
    "pictures of many formats": 2000,
    "camera models": 3000,
    "OpenCV calibration": 2000,
    "copy": 4000,
    "table of lamps": 1500,
    "light arm": 1500,
    "pictures under lights": 1500,
    "stored result": 1000,
    "results of stages": 1000,
}
_LEAST_INPUTS = 20_000
_INTERRUPTIONS = 50
_KILLS = 50
INVARIANCES, KILLS = "invariances", "kills"
INTERRUPTED = tuple(f"interrupting {name}" for name in interrupted_commands.NAMES)
PARTS = (*TARGETS, INVARIANCES, *INTERRUPTED, KILLS)
_SCAN_RIG = """
[camera]
driver = "simulated"

[projector]
driver = "simulated"

[simulation]
painting = "white"
camera_width = 96
"""


@dataclass(frozen=True)
class Fuzzed:
    """Trials of a target and how they ended."""

    target: Target
    trials: range
    outcome: Outcome


def bench(
    *,
    first_trial: int = 0,
    share: float = 1.0,
    interruptions: int = _INTERRUPTIONS,
    kills: int = _KILLS,
    parts: Collection[str] = PARTS,
) -> list[Record]:
    """Fuzz every file that is read, change what must not matter, and cut commands off.

    Parameters
    ----------
    first_trial : int
        Number of the first trial of each target: others are other trials.
    share : float
        Of the trials of each target.
    interruptions : int
        Of each command that writes.
    kills : int
        Of recordings.
    parts : collection of str
        Of :data:`PARTS`: files to damage by name, and what else is tried.
    """
    with TemporaryDirectory() as folder:
        place = Path(folder)
        fuzzed, invariances = _read_damaged(place / "files", parts, first_trial, share)
        interrupted = _interrupt(place, parts, interruptions)
        recordings = _kill(place, kills) if KILLS in parts else None
    return [
        *_fuzz_records(fuzzed),
        *_silent_records(fuzzed, invariances),
        *_interruption_records(interrupted, interruptions),
        *(_kill_records(recordings) if recordings is not None else ()),
    ]


def _read_damaged(
    place: Path, parts: Collection[str], first: int, share: float
) -> tuple[list[Fuzzed], list[Invariance]]:
    if not set(parts) & {*TARGETS, INVARIANCES}:
        return [], []
    place.mkdir()
    targets = make_targets(place)
    fuzzed = _fuzz([t for t in targets if t.name in parts], first, share)
    return fuzzed, list(_invariances(place / "session")) if INVARIANCES in parts else []


def _invariances(session: Path) -> Iterator[Invariance]:
    """Of every stage, from the frames on; the session is a small scan."""
    yield from decoding_invariances(Session.open(session))
    yield from merging_invariances()
    yield from calibration_invariances()
    yield from light_arm_invariances()
    yield from registration_invariances()
    yield from surface_invariances()
    yield from reflectance_invariances()
    yield from render_invariances()


def _fuzz(targets: list[Target], first: int, share: float) -> list[Fuzzed]:
    ranges = [range(first, first + max(1, round(share * _TRIALS[t.name]))) for t in targets]
    fuzzed = []
    with progress("fuzzing", total=sum(map(len, ranges))) as steps:
        for target, trials in zip(targets, ranges, strict=True):
            steps.begin(target.name)
            outcome = fuzz(target, trials, advance=lambda done: steps.advance())
            fuzzed.append(Fuzzed(target, trials, outcome))
    return fuzzed


def _interrupt(place: Path, parts: Collection[str], times: int) -> list[Interruptions]:
    (place / "inputs").mkdir()
    made = interrupted_commands.commands(Inputs(place / "inputs"))
    chosen = [name for name in made if f"interrupting {name}" in parts]
    found = []
    with progress("interrupting", total=times * len(chosen)) as steps:
        for number, name in enumerate(chosen):
            steps.begin(name)
            folder = place / f"interrupted-{number}"
            folder.mkdir()
            found.append(interrupt(made[name](), folder, times=times, advance=steps.advance))
    return found


def _kill(place: Path, times: int) -> Recordings:
    rig = place / "rig.toml"
    rig.write_text(_SCAN_RIG)
    (place / "kills").mkdir()
    with progress("killing recordings", total=times) as steps:
        return kill_recordings(rig, place / "kills", times=times, advance=steps.advance)


def _fuzz_records(fuzzed: list[Fuzzed]) -> Iterator[Record]:
    if not fuzzed:
        return
    trials = sum(one.outcome.trials for one in fuzzed)
    yield Record(
        name="stress.inputs",
        value=trials,
        unit="",
        bound=_LEAST_INPUTS,
        sense=Sense.AT_LEAST,
        runs=trials,
        note="damaged files; each by the seed [CRC-32 of the target's name, number of the trial]",
    )
    yield Record(
        name="stress.unnamed_errors",
        value=sum(one.outcome.ends[End.UNNAMED] for one in fuzzed),
        unit="",
        bound=0,
        sense=Sense.AT_MOST,
        runs=trials,
        note="damaged files that ended otherwise than read, or refused by a named error",
    )
    for one in fuzzed:
        ends = ", ".join(f"{one.outcome.ends[end]} {end}" for end in End)
        failures = [f"; {number}: {why}" for why, number in one.outcome.failures.items()]
        yield Record(
            name=f"stress.unnamed_errors.{_dotted(one.target.name)}",
            value=one.outcome.ends[End.UNNAMED],
            unit="",
            bound=0,
            sense=Sense.AT_MOST,
            runs=one.outcome.trials,
            note=f"trials {one.trials.start} to {one.trials.stop - 1}: {ends}" + "".join(failures),
        )


def _silent_records(fuzzed: list[Fuzzed], invariances: list[Invariance]) -> Iterator[Record]:
    sealed = [one.outcome for one in fuzzed if one.target.sealed]
    passed = sum(outcome.ends[End.OTHER] for outcome in sealed)
    broken = [i for i in invariances if not i.holds]
    runs = sum(outcome.trials for outcome in sealed) + len(invariances)
    if runs == 0:
        return
    yield Record(
        name="stress.silent_wrong",
        value=passed + len(broken),
        unit="",
        bound=0,
        sense=Sense.AT_MOST,
        runs=runs,
        note=f"{passed} damaged files read as others; {len(broken)} of {len(invariances)} changes "
        "mattered",
    )
    for stage, changes in _by_stage(invariances).items():
        most = max(changes, key=lambda i: i.deviation / (i.tolerance or 1.0))
        yield Record(
            name=f"stress.changes_that_mattered.{_dotted(stage)}",
            value=sum(not i.holds for i in changes),
            unit="",
            bound=0,
            sense=Sense.AT_MOST,
            runs=len(changes),
            note="; ".join(str(i) for i in changes if not i.holds) or f"the most {most}",
        )


def _by_stage(invariances: list[Invariance]) -> dict[str, list[Invariance]]:
    found: dict[str, list[Invariance]] = {}
    for one in invariances:
        found.setdefault(one.stage, []).append(one)
    return found


def _interruption_records(found: list[Interruptions], times: int) -> Iterator[Record]:
    if not found:
        return
    yield Record(
        name="stress.partial_outputs",
        value=sum(len(one.wrong) for one in found),
        unit="",
        bound=0,
        sense=Sense.AT_MOST,
        runs=sum(len(one.moments_s) for one in found),
        note=f"of {len(found)} commands, by SIGINT while they ran",
    )
    yield Record(
        name="stress.interruptions",
        value=min(len(one.moments_s) for one in found),
        unit="",
        bound=_INTERRUPTIONS,
        sense=Sense.AT_LEAST,
        runs=sum(len(one.moments_s) for one in found),
        note="of the command that was interrupted least often",
    )
    for one in found:
        struck = one.moments_s or [0.0]
        yield Record(
            name=f"stress.partial_outputs.{_dotted(one.command)}",
            value=len(one.wrong),
            unit="",
            bound=0,
            sense=Sense.AT_MOST,
            runs=len(one.moments_s),
            note=f"{len(one.moments_s)} of {times} SIGINTs while it ran, {min(struck):.2f} to "
            f"{max(struck):.2f} s after its start, of {one.lasting_s:.2f} s; {one.finished} too "
            f"late: all was there; seed {one.seed}" + "".join(f"; {why}" for why in one.wrong),
        )


def _kill_records(recordings: Recordings) -> list[Record]:
    return [
        Record(
            name="stress.kills",
            value=recordings.kills,
            unit="",
            bound=_KILLS,
            sense=Sense.AT_LEAST,
            runs=recordings.kills,
            note=f"while they recorded; {recordings.missed} other runs were killed before, or had "
            "ended",
        ),
        Record(
            name="stress.lost_frames",
            value=recordings.lost_frames,
            unit="",
            bound=0,
            sense=Sense.AT_MOST,
            runs=recordings.kills,
        ),
        Record(
            name="stress.broken_resumptions",
            value=len(recordings.wrong),
            unit="",
            bound=0,
            sense=Sense.AT_MOST,
            runs=recordings.kills,
            note="; ".join(recordings.wrong),
        ),
    ]


def _dotted(name: str) -> str:
    return name.replace("--", "").replace(" ", "_")
