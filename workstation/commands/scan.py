"""``impasto scan``: a structured-light scan of whatever stands before a rig."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from workstation.json_output import JsonOption, write_json

if TYPE_CHECKING:
    from acquisition.plan import Metering
    from acquisition.projector_response import ProjectorResponse

# Of the projector: exposures between which a scan chooses where none are named.
_DEFAULT_PERIODS = (1, 3, 9)


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
            "the projector. By default one, three and nine of them.",
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
    target_px: Annotated[
        float | None,
        typer.Option(
            min=1e-4,
            metavar="PX",
            help="Standard deviation that each coordinate is to have, in pixels of the panel. By "
            "default 0.05.",
        ),
    ] = None,
    target_mm: Annotated[
        float | None,
        typer.Option(
            min=1e-6,
            metavar="MM",
            help="The same of each height; takes --calibration, and plans the coordinate that "
            "tells no height for registration alone.",
        ),
    ] = None,
    no_skip: Annotated[
        bool, typer.Option("--no-skip", help="Take frames that no pixel needs as well.")
    ] = False,
    greys: Annotated[
        int | None,
        typer.Option(
            min=3,
            max=256,
            metavar="N",
            help="Take N uniform greys instead of a code: they tell the projector's response.",
        ),
    ] = None,
    response: Annotated[
        Path | None,
        typer.Option(
            metavar="SESSION", help="Session of --greys, by which fringes are compensated."
        ),
    ] = None,
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
    json: JsonOption = None,
) -> None:
    """Scan with structured light into a session, which can be resumed if it is cut off.

    White, black and a few steps of every fringe come first. They tell the light of each pixel, and
    so which exposures, fringes and steps some pixel needs for its target; the rest is left out, and
    the journal says why.

    Example:

        impasto scan rig.toml --out session/ --exposure 17 --exposure 67 --exposure 267

    With a projector whose response is not linear, measured once on anything bright:

        impasto scan rig.toml --out greys/ --greys 17

        impasto scan rig.toml --out session/ --response greys/
    """
    from acquisition.patterns import Axis
    from acquisition.scan import plan_response_scan, plan_scan
    from acquisition.scan_plan import whole_periods
    from devices.rig_file import read_rig_file
    from workstation.confirmation import confirm_at_desk
    from workstation.destinations import check_destinations
    from workstation.recording import describe_plan, record_session

    check_destinations(*(rig, calibration, response), makes={"--out": out}, writes={"--json": json})
    metering = None if no_skip else _metering(target_px, target_mm, calibration)
    compensated = None if response is None else _response(response)
    with read_rig_file(rig).open(confirm=confirm_at_desk) as opened:
        period_s = opened.projector.capabilities.frame_period_s
        exposures_s = tuple(ms / 1000 for ms in exposure or ())
        if not exposures_s:
            exposures_s = tuple(period_s * count for count in _DEFAULT_PERIODS)
        elif not exact:
            exposures_s = whole_periods(exposures_s, period_s)
        for exposure_s in exposures_s:
            opened.camera.capabilities.check_exposure(exposure_s)
        if greys is not None:
            plan = plan_response_scan(opened, greys=greys, exposure_s=exposures_s)
        else:
            plan = plan_scan(
                opened,
                period_px=period,
                coarser_periods_px=tuple(coarser or ()),
                steps=steps,
                axes=tuple(Axis) if axes is Axes.BOTH else (Axis(axes.value),),
                inverse=inverse,
                metering=metering,
                response=compensated,
                exposure_s=exposures_s,
            )
        if dry_run:
            figures = describe_plan(plan, opened, out)
        else:
            figures = record_session(plan, opened, out, calibration=calibration)
    write_json(json, figures)


def _metering(
    target_px: float | None, target_mm: float | None, calibration: Path | None
) -> Metering:
    """The rule for what is left out."""
    from acquisition.patterns import Axis
    from acquisition.plan import Metering

    if target_mm is None:
        sigma = Metering().column_sigma_px if target_px is None else target_px
        return Metering(column_sigma_px=sigma, row_sigma_px=sigma)
    if target_px is not None or calibration is None:
        raise typer.BadParameter(
            "takes --calibration, which tells what a height takes, and no --target-px",
            param_hint="--target-mm",
        )
    from calibration.rig_geometry import RigGeometry
    from workstation.scan_target import panel_sigma

    targets = panel_sigma(RigGeometry.load(calibration), target_mm)
    return Metering(column_sigma_px=targets[Axis.COLUMN], row_sigma_px=targets[Axis.ROW])


def _response(session: Path) -> ProjectorResponse:
    """Response of the projector whose greys a session holds."""
    from acquisition.plan import Purpose
    from acquisition.response_measurement import measure_response
    from acquisition.session import Session

    opened = Session.open(session)
    return measure_response(opened.plan_of(Purpose.CODE), opened.read_frame)
