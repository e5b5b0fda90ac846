"""``impasto bench``: measured figures against their bounds."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Benchmark(StrEnum):
    """The benchmarks there are."""

    SURFACE = "surface"
    DEMO = "demo"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("bench")(bench)


def bench(
    which: Annotated[Benchmark, typer.Argument(help="surface or demo.")],
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write records here.")] = None,
) -> None:
    """Measure a stage and hold its figures against their bounds.

    Real captures are used where IMPASTO_REAL_DATA names their folder.

    Example:

        impasto bench surface --json surface.json
    """
    from workstation.benchmark_records import print_records
    from workstation.benchmarks import bench_demo, bench_surface
    from workstation.json_output import write_json

    records = bench_surface() if which is Benchmark.SURFACE else bench_demo()
    print_records(records)
    write_json(json, [record.as_json() for record in records])
