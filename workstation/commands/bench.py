"""``impasto bench``: measured figures against their bounds."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer


class Benchmark(StrEnum):
    """The benchmarks there are: modules of :mod:`workstation.benchmarks`."""

    ACQUIRE = "acquire"
    DECODE = "decode"
    SURFACE = "surface"
    CALIBRATE = "calibrate"
    REFLECTANCE = "reflectance"
    RENDER = "render"
    DEMO = "demo"
    STRESS = "stress"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("bench")(bench)


def bench(
    which: Annotated[Benchmark, typer.Argument(help="What to measure.")],
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write records here.")] = None,
    pictures: Annotated[
        Path | None,
        typer.Option(metavar="DIR", exists=True, file_okay=False, help="Draw its pictures here."),
    ] = None,
    part: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Measure this part alone; repeatable.")
    ] = None,
) -> None:
    """Measure a stage and hold its figures against their bounds.

    Real captures are used where IMPASTO_REAL_DATA names their folder.

    Example:

        impasto bench surface --json surface.json
    """
    import importlib
    import inspect

    from workstation.benchmark_records import print_records
    from workstation.json_output import write_json

    measure = importlib.import_module(f"workstation.benchmarks.{which}").bench
    taken = inspect.signature(measure).parameters
    chosen: dict[str, Any] = {}
    if pictures is not None:
        if "pictures" not in taken:
            raise typer.BadParameter(f"{which} draws none", param_hint="--pictures")
        chosen["pictures"] = pictures
    if part:
        known = list(taken["parts"].default) if "parts" in taken else []
        if not set(part) <= set(known):
            has = f"has {', '.join(known)}" if known else "has no parts"
            raise typer.BadParameter(f"{which} {has}", param_hint="--part")
        chosen["parts"] = part
    records = measure(**chosen)
    print_records(records)
    write_json(json, [record.as_json() for record in records])
