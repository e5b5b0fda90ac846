"""``impasto report``: a page on a digital copy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from workstation.json_output import JsonOption, write_json


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("report")(report)


def report(
    copy: Annotated[Path, typer.Argument(metavar="COPY", help="Folder of a digital copy.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="HTML page to write.")],
    session: Annotated[
        Path | None,
        typer.Option(metavar="SESSION", help="What it was made from: adds frames and calibration."),
    ] = None,
    photographs: Annotated[
        Path | None,
        typer.Option(metavar="SESSION", help="What its reflectance was made from."),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="What it was made with, if not the session's own."),
    ] = None,
    curve: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Run time against error as impasto bench pipeline measured it here, instead of "
            "the curve that comes with the program.",
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Write a page on a digital copy: frames, calibration, heights, errors and views.

    The page is one file that asks for nothing outside itself; print it, or send it.

    Example:

        impasto report copy/ --session session/ --photographs photographs/ --out report.html
    """
    from acquisition.atomic_files import file_in_progress
    from fitting.copy_files import read_copy
    from workstation.destinations import check_destinations
    from workstation.interruption import too_late_to_stop
    from workstation.progress import progress
    from workstation.quality_curve import QualityCurve, shipped_curve
    from workstation.report_sources import find_sources
    from workstation.session_report import PARTS, write_session_report

    check_destinations(
        *(copy, session, photographs, calibration, curve),
        writes={"--out": out, "--json": json},
    )
    sources = find_sources(
        *(copy, read_copy(copy).provenance),
        session=session,
        photographs=photographs,
        calibration=calibration,
    )
    for warning in sources.warnings:
        typer.echo(f"warning: {warning}", err=True)
    measured = shipped_curve() if curve is None else QualityCurve.load(curve)
    with progress("report", total=PARTS) as steps:

        def begin(part: str) -> None:
            steps.advance()
            steps.begin(part)

        with file_in_progress(out) as page:
            figures = write_session_report(
                copy,
                page,
                session=sources.session,
                photographs=sources.photographs,
                calibration=calibration,
                run=sources.run,
                curve=measured,
                begin=begin,
            )
            too_late_to_stop()
    write_json(json, {"page": str(out)} | figures)
    typer.echo(f"open {out}")
