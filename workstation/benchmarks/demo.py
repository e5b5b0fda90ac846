"""The demo as a whole process: time, memory, its figures, and what is made of its recordings."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from acquisition.file_tree import files_below
from acquisition.session import Session
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.session_differences import frame_differences
from workstation.demo_bounds import demo_records
from workstation.demo_job import COPY_FOLDER, REPORT_FILE, SESSIONS_FOLDER
from workstation.demo_processing import LAMPS_FILE, RIG_FOLDER
from workstation.demo_recording import (
    PHOTOGRAPHS_SESSION,
    SCAN_SESSION,
    replay_sessions,
    sessions_of,
)
from workstation.processing import DECODING, REFLECTANCE, REGISTRATION, SURFACE
from workstation.stage_cache import digest_of_files

# The heights decide a threshold of some tenths of a millimetre by themselves.
_OTHER_DELTA0_MM = 0.123
# Of what differs where nothing should.
_NAMED = 5


def bench() -> list[Record]:
    """The demo as a whole process, twice, and its copy made again from what it recorded."""
    with TemporaryDirectory() as folder:
        first, second = Path(folder) / "first", Path(folder) / "second"
        seconds = _impasto("demo", "--out", first)
        _impasto("demo", "--out", second)
        figures = json.loads((first / REPORT_FILE).read_text())
        return [
            # By the clock, with the start of Python.
            *(
                replace(record, value=seconds) if record.name == "demo.seconds" else record
                for record in demo_records(figures)
            ),
            _differing(
                "demo.differing_copies",
                *(first, second),
                "of two runs with one seed" + _first_difference(first, second),
            ),
            *_processed_again(first, Path(folder) / "replayed"),
        ]


def _processed_again(demo: Path, folder: Path) -> Iterator[Record]:
    """The demo's sessions replayed and processed by the command: once, unchanged, with another δ0.

    The calibration stands in the sessions' own folders.
    """
    replay_sessions(demo / SESSIONS_FOLDER, folder)
    process = (
        *("process", folder / SCAN_SESSION, "--photographs", folder / PHOTOGRAPHS_SESSION),
        *("--lamps", demo / LAMPS_FILE, "--out", folder / COPY_FOLDER),
    )
    _impasto(*process)
    yield _differing("demo.replayed_copy_differs", demo, folder, "of what the demo recorded")
    yield Record(
        name="demo.unchanged_process_s",
        value=_impasto(*process),
        unit="s",
        bound=2.0,
        sense=Sense.AT_MOST,
        note="nothing changed, start of Python included",
    )
    report = folder / REPORT_FILE
    _impasto(*process, "--delta0", _OTHER_DELTA0_MM, "--json", report)
    ran = {
        stage["name"] for stage in json.loads(report.read_text())["stages"] if not stage["skipped"]
    }
    yield Record(
        name="demo.stages_run_for_delta0",
        value=len(ran & {DECODING, SURFACE, REGISTRATION, REFLECTANCE}),
        unit="",
        bound=0,
        sense=Sense.AT_MOST,
        note=f"of those that do not depend on it; run: {', '.join(sorted(ran)) or 'none'}",
    )


def _differing(name: str, one: Path, other: Path, note: str) -> Record:
    copies = {digest_of_files(folder / COPY_FOLDER) for folder in (one, other)}
    return Record(
        name=name,
        value=len(copies) - 1,
        unit="",
        bound=0,
        sense=Sense.AT_MOST,
        runs=2,
        note=note,
    )


def _first_difference(first: Path, second: Path) -> str:
    """What of two demos differs, in the order in which it is made; empty if nothing does."""
    for path in sessions_of(first / SESSIONS_FOLDER):
        name = path.relative_to(first)
        frames = frame_differences(Session.open(second / name), Session.open(path))
        if frames:
            return f"; {name} differs: {', '.join(frames[:_NAMED])}"
    made, again = (files_below(demo) for demo in (first, second))
    for part in (RIG_FOLDER, LAMPS_FILE, COPY_FOLDER):
        names = [name for name in sorted(made | again) if Path(name).parts[0] == part]
        files = [name for name in names if not _same(made.get(name), again.get(name))]
        if files:
            return f"; differ: {', '.join(files[:_NAMED])}"
    return ""


def _same(one: Path | None, other: Path | None) -> bool:
    return one is not None and other is not None and one.read_bytes() == other.read_bytes()


def _impasto(*words: Any) -> float:
    """Seconds that a command takes as a process of its own."""
    started = time.perf_counter()
    command = [sys.executable, "-m", "workstation.command_line", *map(str, words)]
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - started
