"""``impasto devices``: which devices there are, and whether those of a rig answer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from workstation.json_output import JsonOption, write_json

if TYPE_CHECKING:
    from devices.probing import Probe
    from devices.search import Search

_WIDTH = 160


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("devices")(devices)


def devices(
    rig: Annotated[
        Path | None, typer.Argument(metavar="[RIG.toml]", help="Probe this rig's devices.")
    ] = None,
    limit: Annotated[
        float,
        typer.Option(min=0.1, max=86400, metavar="SECONDS", help="Time for each driver or device."),
    ] = 30.0,
    json: JsonOption = None,
) -> None:
    """Search for devices with every driver, or open and probe those of a rig.

    Probing moves nothing and lights nothing; the camera takes one frame. A device of the rig that
    does not answer ends the command with exit code 4.

    Example:

        impasto devices rig.toml
    """
    from workstation.destinations import check_destinations

    check_destinations(rig, writes={"--json": json})
    if rig is None:
        _search(limit, json)
    else:
        _probe(rig, limit, json)


def _search(limit_s: float, json: Path | None) -> None:
    from devices.search import SEARCHED, search
    from workstation.progress import progress

    results: list[Search] = []
    with progress("searching for devices", total=len(SEARCHED)) as steps:
        for result in search(limit_s=limit_s):
            results.append(result)
            steps.begin(f"{result.driver.name} is done")
            steps.advance()
    results.sort(key=lambda result: (result.driver.kind, result.driver.name))
    _print_table(
        ("driver", "for", "address", "model", "state"),
        [row for result in results for row in _rows_of_search(result)],
    )
    write_json(json, [_figures_of_search(result) for result in results])


def _rows_of_search(result: Search) -> list[tuple[str, ...]]:
    name, kind = result.driver.name, str(result.driver.kind)
    if result.missing is not None:
        return [(name, kind, "", "", f"not installed: {result.missing}")]
    if result.problem is not None:
        return [(name, kind, "", "", result.problem)]
    if not result.found:
        return [(name, kind, "", "", "none found")]
    return [
        (name, kind, found.address, found.model, found.problem or "answers")
        for found in result.found
    ]


def _figures_of_search(result: Search) -> dict[str, Any]:
    return {
        "driver": result.driver.name,
        "kind": str(result.driver.kind),
        "missing": result.missing,
        "problem": result.problem,
        "found": [
            {"address": found.address, "model": found.model, "problem": found.problem}
            for found in result.found
        ],
    }


def _probe(rig: Path, limit_s: float, json: Path | None) -> None:
    from devices.errors import DeviceError
    from devices.probing import probe
    from devices.rig_file import read_rig_file
    from workstation.progress import progress

    rig_file = read_rig_file(rig)
    probes: list[Probe] = []
    with progress(f"probing {rig}", total=len(rig_file.devices)) as steps:
        for result in probe(rig_file, limit_s=limit_s, begin=steps.begin):
            probes.append(result)
            steps.advance()
    _print_table(
        ("device", "driver", "model", "state"),
        [(str(p.kind), p.driver, p.model, p.problem or p.detail) for p in probes],
    )
    write_json(
        json,
        [
            {
                "device": str(p.kind),
                "driver": p.driver,
                "model": p.model,
                "detail": p.detail,
                "problem": p.problem,
            }
            for p in probes
        ],
    )
    failed = [str(p.kind) for p in probes if p.problem is not None]
    if failed:
        raise DeviceError(
            f"{rig}: {', '.join(failed)} of {len(probes)} devices did not answer as they should; "
            "the table says what is wrong with each"
        )


def _print_table(columns: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for column in columns:
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(*map(escape, row))
    console = Console(highlight=False)
    if not console.is_terminal:
        # A file or a pipe has no width of its own.
        console.width = _WIDTH
    console.print(table)
