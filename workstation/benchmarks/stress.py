"""Stress: damaged files, changes that must not matter, commands cut off at any moment."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.fuzz_targets import make_targets
from workstation.benchmarks.fuzzing import End, Outcome, Target, fuzz
from workstation.benchmarks.interruptions import Recordings, commands, interrupt, kill_recordings
from workstation.benchmarks.invariances import Invariance, measure_invariances
from workstation.progress import progress

# By how long one trial takes, and how much there is to get wrong.
_TRIALS = {
    "session as recorded": 6000,
    "session resealed": 1500,
    "rig.toml": 4000,
    "capture.toml": 1500,
    "camera models": 3000,
    "OpenCV calibration": 2000,
    "copy": 4000,
}
_INTERRUPTIONS = 50
_KILLS = 50
_SCAN_RIG = """
[camera]
driver = "simulated"

[projector]
driver = "simulated"

[simulation]
painting = "white"
camera_width = 96
"""


def bench(
    *,
    first_trial: int = 0,
    share: float = 1.0,
    interruptions: int = _INTERRUPTIONS,
    kills: int = _KILLS,
) -> list[Record]:
    """Fuzz every file that is read, change what must not matter, and cut commands off.

    Parameters
    ----------
    first_trial : int
        Number of the first trial of each target: others are other trials.
    share : float
        Of the trials of each target.
    interruptions : int
        Of each command that makes one thing.
    kills : int
        Of recordings.
    """
    with TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "files").mkdir()
        targets = make_targets(place / "files")
        outcomes = _fuzz(targets, first_trial, share)
        invariances = measure_invariances(place / "files" / "session")
        wrong = _interrupt(place, interruptions)
        rig = place / "rig.toml"
        rig.write_text(_SCAN_RIG)
        (place / "kills").mkdir()
        recordings = kill_recordings(rig, place / "kills", times=kills)
    return [
        *_fuzz_records(outcomes),
        _silent(outcomes, invariances),
        *_cut_off_records(wrong, 3 * interruptions, recordings),
    ]


def _fuzz(
    targets: tuple[Target, ...], first: int, share: float
) -> list[tuple[Target, range, Outcome]]:
    ranges = [range(first, first + max(1, round(share * _TRIALS[t.name]))) for t in targets]
    outcomes = []
    with progress("fuzzing", total=sum(map(len, ranges))) as steps:
        for target, trials in zip(targets, ranges, strict=True):
            steps.begin(target.name)
            outcome = fuzz(target, trials, advance=lambda done: steps.advance())
            outcomes.append((target, trials, outcome))
    return outcomes


def _interrupt(place: Path, times: int) -> list[str]:
    files = place / "files"
    capture = files / "capture"
    wrong: list[str] = []
    made = commands(files / "session", files / "copy", capture, capture / "capture.toml")
    with progress("interrupting", total=len(made)) as steps:
        for command in made:
            steps.begin(command.name)
            folder = place / f"interrupted-{command.name}"
            folder.mkdir()
            wrong += interrupt(command, folder, times=times)
            steps.advance()
    return wrong


def _fuzz_records(outcomes: list[tuple[Target, range, Outcome]]) -> list[Record]:
    trials = sum(outcome.trials for _, _, outcome in outcomes)
    unnamed = sum(outcome.ends[End.UNNAMED] for _, _, outcome in outcomes)
    counts = "; ".join(
        f"{target.name} {numbers.start}–{numbers.stop - 1}: "
        + ", ".join(f"{outcome.ends[end]} {end}" for end in End)
        for target, numbers, outcome in outcomes
    )
    failures = [
        f"{target.name} {number}: {why}"
        for target, _, outcome in outcomes
        for why, number in outcome.failures.items()
    ]
    return [
        Record(
            name="stress.inputs",
            value=trials,
            unit="",
            bound=20_000,
            sense=Sense.AT_LEAST,
            runs=trials,
            note=counts,
        ),
        Record(
            name="stress.unnamed_errors",
            value=unnamed,
            unit="",
            bound=0,
            sense=Sense.AT_MOST,
            runs=trials,
            note="; ".join(failures),
        ),
    ]


def _silent(outcomes: list[tuple[Target, range, Outcome]], invariances: list[Invariance]) -> Record:
    passed = sum(outcome.ends[End.OTHER] for target, _, outcome in outcomes if target.sealed)
    broken = [i for i in invariances if not i.holds]
    closest = max(invariances, key=lambda i: i.deviation / (i.tolerance or 1.0))
    return Record(
        name="stress.silent_wrong",
        value=passed + len(broken),
        unit="",
        bound=0,
        sense=Sense.AT_MOST,
        runs=sum(o.trials for t, _, o in outcomes if t.sealed) + len(invariances),
        note=f"{passed} damaged files read as others; {len(broken)} of {len(invariances)} changes "
        + ("mattered: " + "; ".join(f"{i.name} {i.deviation:.2g} {i.unit}" for i in broken)
           if broken
           else f"mattered, the most {closest.name}: {closest.deviation:.2g} {closest.unit}"),
    )  # fmt: skip


def _cut_off_records(wrong: list[str], times: int, recordings: Recordings) -> list[Record]:
    return [
        Record(
            name="stress.partial_outputs",
            value=len(wrong),
            unit="",
            bound=0,
            sense=Sense.AT_MOST,
            runs=times,
            note="; ".join(wrong),
        ),
        Record(
            name="stress.kills",
            value=recordings.kills,
            unit="",
            bound=_KILLS,
            sense=Sense.AT_LEAST,
            runs=recordings.kills,
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
