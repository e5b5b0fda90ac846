"""``impasto bench``: measured figures against their bounds."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Benchmark(StrEnum):
    """The benchmarks there are: modules of :mod:`workstation.benchmarks`."""

    ACQUIRE = "acquire"
    DECODE = "decode"
    SURFACE = "surface"
    CALIBRATE = "calibrate"
    REFLECTANCE = "reflectance"
    DEMO = "demo"
    STRESS = "stress"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("bench")(bench)


def bench(
    which: Annotated[Benchmark, typer.Argument(help="What to measure.")],
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write records here.")] = None,
) -> None:
    """Measure a stage and hold its figures against their bounds.

    Real captures are used where IMPASTO_REAL_DATA names their folder.

    Example:

        impasto bench surface --json surface.json
    """
    import importlib

    from workstation.benchmark_records import print_records
    from workstation.json_output import write_json

    records = importlib.import_module(f"workstation.benchmarks.{which}").bench()
    print_records(records)
    write_json(json, [record.as_json() for record in records])
