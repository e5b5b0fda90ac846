"""``impasto bench``: measured figures against their bounds."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from workstation.json_output import JsonOption, write_json


class Benchmark(StrEnum):
    """The benchmarks there are: modules of :mod:`workstation.benchmarks`, and all of them."""

    ACQUIRE = "acquire"
    DECODE = "decode"
    SURFACE = "surface"
    CALIBRATE = "calibrate"
    REFLECTANCE = "reflectance"
    RENDER = "render"
    PIPELINE = "pipeline"
    DEMO = "demo"
    STRESS = "stress"
    ALL = "all"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("bench")(bench)


def bench(
    which: Annotated[Benchmark, typer.Argument(help="What to measure.")],
    json: JsonOption = None,
    pictures: Annotated[
        Path | None,
        typer.Option(metavar="DIR", file_okay=False, help="Draw its pictures in this folder."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Of all: make this folder of records and a page."),
    ] = None,
    part: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Measure this part alone; repeatable.")
    ] = None,
) -> None:
    """Measure a stage and hold its figures against their bounds.

    Real captures are used where IMPASTO_REAL_DATA names their folder.

    Example:

        impasto bench surface --json surface.json

        impasto bench all --out benchmarks/
    """
    import importlib
    import inspect

    from workstation.benchmark_records import print_records
    from workstation.destinations import check_destinations
    from workstation.files_in_progress import files_in_progress
    from workstation.interruption import too_late_to_stop

    if (which is Benchmark.ALL) != (out is not None):
        raise typer.BadParameter("all benchmarks go to a folder, and no others", param_hint="--out")
    if which is Benchmark.ALL and (pictures or part):
        raise typer.BadParameter("all benchmarks have their pictures and parts in --out")
    # Before minutes of measuring, not after them.
    check_destinations(
        makes={"--out": out}, fills={"--pictures": pictures}, writes={"--json": json}
    )
    if pictures is not None and not pictures.parent.is_dir():
        raise typer.BadParameter(
            f"there is no folder {pictures.parent}; make it first", param_hint="--pictures"
        )
    if out is not None:
        _bench_all(out, json)
        return
    measure = importlib.import_module(f"workstation.benchmarks.{which}").bench
    taken = inspect.signature(measure).parameters
    chosen: dict[str, Any] = {}
    if pictures is not None and "pictures" not in taken:
        raise typer.BadParameter(f"{which} draws none", param_hint="--pictures")
    if part:
        known = list(taken["parts"].default) if "parts" in taken else []
        if not set(part) <= set(known):
            has = f"has {', '.join(known)}" if known else "has no parts"
            raise typer.BadParameter(f"{which} {has}", param_hint="--part")
        chosen["parts"] = part
    with files_in_progress(pictures) as drawn:
        if drawn is not None:
            chosen["pictures"] = drawn
        records = measure(**chosen)
        too_late_to_stop()
    write_json(json, [record.as_json() for record in records])
    print_records(records)


def _bench_all(out: Path, json: Path | None) -> None:
    from workstation.benchmark_page import run_benchmarks
    from workstation.benchmark_records import print_records

    every = [str(one) for one in Benchmark if one is not Benchmark.ALL]
    done = run_benchmarks(every, out)
    print_records(done.records)
    write_json(json, [record.as_json() for record in done.records])
    for name, why in done.failed.items():
        typer.echo(f"warning: {name} failed: {why}", err=True)
    typer.echo(f"open {out / 'index.html'}")
    if done.failed:
        raise typer.Exit(3)
