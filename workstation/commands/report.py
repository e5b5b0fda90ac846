"""``impasto report``: a page on a digital copy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


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
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write figures here.")] = None,
) -> None:
    """Write a page on a digital copy: frames, calibration, heights, errors and views.

    The page is one file that asks for nothing outside itself; print it, or send it.

    Example:

        impasto report copy/ --session session/ --photographs photographs/ --out report.html
    """
    from acquisition.session import Session
    from fitting.errors import CopyError
    from workstation.copy_writing import read_run
    from workstation.json_output import write_json
    from workstation.progress import progress
    from workstation.session_report import PARTS, write_session_report

    if not out.parent.is_dir():
        raise CopyError(f"{out}: there is no folder {out.parent}; make it first")
    scan, pictures = (
        None if path is None else Session.open(path) for path in (session, photographs)
    )
    with progress("report", total=PARTS) as steps:

        def begin(part: str) -> None:
            steps.advance()
            steps.begin(part)

        figures = write_session_report(
            copy, out, session=scan, photographs=pictures, run=read_run(copy), begin=begin
        )
    typer.echo(f"open {out}")
    write_json(json, figures)
