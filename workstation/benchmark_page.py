"""Every benchmark, with its records and pictures in one folder and on one page."""

from __future__ import annotations

import importlib
import inspect
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from acquisition.atomic_files import folder_in_progress
from acquisition.errors import SessionError
from devices.errors import ImpastoError
from workstation.benchmark_records import Record, limits_text, record_row
from workstation.interruption import too_late_to_stop
from workstation.json_output import write_json
from workstation.progress import progress
from workstation.report_page import Picture, Section, Table, write_page
from workstation.stage_progress import clock_text


@dataclass(frozen=True)
class BenchmarksRun:
    """What came of some benchmarks.

    Attributes
    ----------
    records : list of Record
    failed : dict of str to str
        Why, by the name of the benchmark.
    """

    records: list[Record]
    failed: dict[str, str]


def run_benchmarks(names: Sequence[str], out: Path) -> BenchmarksRun:
    """Run benchmarks one after the other; one that fails does not keep the others from running.

    Parameters
    ----------
    names : sequence of str
        Modules of :mod:`workstation.benchmarks`.
    out : Path
        Folder to make: ``NAME.json`` and ``NAME/`` with pictures of each, and ``index.html``.

    Raises
    ------
    SessionError
        The folder exists.
    """
    if out.exists():
        raise SessionError(f"{out} exists already; choose another place, or remove it first")
    records: list[Record] = []
    failed: dict[str, str] = {}
    sections = []
    with (
        folder_in_progress(out) as folder,
        progress("benchmarks", total=len(names)) as steps,
    ):
        for name in names:
            steps.begin(name)
            pictures = folder / name
            pictures.mkdir()
            began = time.perf_counter()
            try:
                found = _run(name, pictures)
            except ImpastoError as error:
                failed[name] = str(error)
                sections.append(Section(name, f"It failed: {error}"))
            else:
                records += found
                write_json(folder / f"{name}.json", [record.as_json() for record in found])
                took = clock_text(time.perf_counter() - began)
                sections.append(_section(name, found, pictures, took))
            if not any(pictures.iterdir()):
                pictures.rmdir()
            steps.advance()
        held = sum(record.holds for record in records)
        write_page(
            folder / "index.html",
            title="Benchmarks",
            summary=f"{held} of {len(records)} figures are within their bounds.",
            sections=tuple(sections),
            warnings=(
                *(f"{name} failed: {why}" for name, why in failed.items()),
                *(
                    f"{r.name}: {r.value:.4g} {r.unit}, bound {limits_text(r)}"
                    for r in records
                    if not r.holds
                ),
            ),
        )
        too_late_to_stop()
    return BenchmarksRun(records, failed)


def _run(name: str, pictures: Path) -> list[Record]:
    measure = importlib.import_module(f"workstation.benchmarks.{name}").bench
    draws = "pictures" in inspect.signature(measure).parameters
    found: list[Record] = measure(pictures=pictures) if draws else measure()
    return found


def _section(name: str, records: list[Record], pictures: Path, took: str) -> Section:
    rows = tuple(record_row(record) for record in records)
    drawn = tuple(
        Picture(path.stem.replace("-", " "), path.read_bytes())
        for path in sorted(pictures.glob("*.png"))
    )
    heading = ("figure", "value", "bound", "holds", "note")
    return Section(name, f"Took {took}.", (Table(rows, heading),), pictures=drawn)
