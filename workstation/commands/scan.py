"""``impasto scan``: a structured-light scan of whatever stands before a rig."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Axes(StrEnum):
    """Projector coordinates that a scan encodes."""

    BOTH = "both"
    COLUMN = "column"
    ROW = "row"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("scan")(scan)


def scan(
    rig: Annotated[Path, typer.Argument(metavar="RIG.toml", help="The rig to scan with.")],
    out: Annotated[Path, typer.Option(metavar="SESSION", help="Session folder to make.")],
    exposure: Annotated[
        list[float] | None,
        typer.Option(
            min=0.001,
            metavar="MS",
            help="Exposure in milliseconds; several times for HDR. Made whole frame periods of "
            "the projector. By default 45.",
        ),
    ] = None,
    period: Annotated[
        float, typer.Option(min=2.001, metavar="PX", help="Finest fringe period on the panel.")
    ] = 24.0,
    coarser: Annotated[
        list[float] | None,
        typer.Option(min=2.001, metavar="PX", help="A further, coarser period; several times."),
    ] = None,
    steps: Annotated[int, typer.Option(min=3, max=64, help="Phase steps of each fringe.")] = 8,
    axes: Annotated[Axes, typer.Option(help="Coordinates to encode.")] = Axes.BOTH,
    inverse: Annotated[
        bool, typer.Option("--inverse", help="Follow each Gray bit by its inverse.")
    ] = False,
    exact: Annotated[
        bool, typer.Option("--exact", help="Take exposures as they are, not in frame periods.")
    ] = False,
    calibration: Annotated[
        Path | None,
        typer.Option(metavar="DIR", exists=True, file_okay=False, help="Calibration in force."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say frames, time and disk needed; record nothing.")
    ] = False,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write figures here.")] = None,
) -> None:
    """Scan with structured light into a session, which can be resumed if it is cut off.

    Example:

        impasto scan rig.toml --out session/ --exposure 17 --exposure 67 --exposure 267
    """
    from acquisition.patterns import Axis
    from acquisition.scan import plan_scan
    from acquisition.scan_plan import whole_periods
    from devices.rig_file import read_rig_file
    from workstation.confirmation import confirm_at_desk
    from workstation.json_output import write_json
    from workstation.recording import describe_plan, record_session

    exposures_s = tuple(ms / 1000 for ms in exposure or [45.0])
    with read_rig_file(rig).open(confirm=confirm_at_desk) as opened:
        if not exact:
            exposures_s = whole_periods(exposures_s, opened.projector.capabilities.frame_period_s)
        for exposure_s in exposures_s:
            opened.camera.capabilities.check_exposure(exposure_s)
        plan = plan_scan(
            opened,
            period_px=period,
            coarser_periods_px=tuple(coarser or ()),
            steps=steps,
            axes=tuple(Axis) if axes is Axes.BOTH else (Axis(axes.value),),
            inverse=inverse,
            exposure_s=exposures_s,
        )
        if dry_run:
            figures = describe_plan(plan, opened, out)
        else:
            figures = record_session(plan, opened, out, calibration=calibration)
    write_json(json, figures)
