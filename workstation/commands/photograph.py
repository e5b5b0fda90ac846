"""``impasto photograph``: photographs under the light arm, from every place of the camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from workstation.json_output import JsonOption, write_json


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("photograph")(photograph)


def photograph(
    rig: Annotated[Path, typer.Argument(metavar="RIG.toml", help="The rig to photograph with.")],
    out: Annotated[Path, typer.Option(metavar="SESSION", help="Session folder to make.")],
    poses: Annotated[int, typer.Option(min=1, max=2000, help="Poses of the lamp.")] = 24,
    least_elevation: Annotated[
        float, typer.Option(min=0, max=89, metavar="DEGREES", help="Of the lamp.")
    ] = 15.0,
    exposure: Annotated[
        list[float] | None,
        typer.Option(
            min=0.001,
            metavar="MS",
            help="An exposure of the bracket, in milliseconds; several times. By default 4, 16, "
            "64 and 256.",
        ),
    ] = None,
    code_exposure: Annotated[
        list[float] | None,
        typer.Option(
            min=0.001, metavar="MS", help="Exposure of the projected code; by default 45."
        ),
    ] = None,
    position: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A place of the camera; several times. By default all."),
    ] = None,
    period: Annotated[
        float, typer.Option(min=2.001, metavar="PX", help="Fringe period of the code.")
    ] = 24.0,
    steps: Annotated[int, typer.Option(min=3, max=64, help="Phase steps of the code.")] = 8,
    reference_every: Annotated[
        int, typer.Option(min=1, help="Poses after which the reference pose is taken again.")
    ] = 12,
    flat_target: Annotated[
        bool, typer.Option("--flat-target", help="Photograph a white target under every light.")
    ] = False,
    colour_chart: Annotated[
        bool, typer.Option("--colour-chart", help="Photograph a colour chart.")
    ] = False,
    warm_up: Annotated[
        float | None,
        typer.Option(
            min=0, max=3600, metavar="SECONDS", help="For the lamp; by default 120, simulated 0."
        ),
    ] = None,
    no_skip: Annotated[
        bool, typer.Option("--no-skip", help="Take exposures that no pixel needs as well.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say frames, time and disk needed; record nothing.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Photograph under the light arm into a session, which can be resumed if it is cut off.

    From every place of the camera: the projected code for registration, frames without light, and
    a bracket of exposures under each light, of which those that no pixel needs are left out.

    Example:

        impasto photograph rig.toml --out photographs/ --poses 36 --position front --position left
    """
    import math

    from acquisition.photograph_plan import PhotographChoices, plan_photographs
    from devices.rig_file import read_rig_file
    from workstation.confirmation import confirm_at_desk
    from workstation.destinations import check_destinations
    from workstation.recording import describe_plan, record_session

    check_destinations(rig, makes={"--out": out}, writes={"--json": json})
    choices = PhotographChoices(
        exposures_s=_seconds(exposure or [4.0, 16.0, 64.0, 256.0]),
        code_exposures_s=_seconds(code_exposure or [45.0]),
        poses=poses,
        least_elevation=math.radians(least_elevation),
        camera_positions=tuple(position) if position else None,
        period_px=period,
        steps=steps,
        adaptive=not no_skip,
        reference_every=reference_every,
        flat_target=flat_target,
        colour_chart=colour_chart,
        warm_up_s=warm_up,
    )
    with read_rig_file(rig).open(confirm=confirm_at_desk) as opened:
        plan = plan_photographs(opened, choices)
        figures = describe_plan(plan, opened, out) if dry_run else record_session(plan, opened, out)
    write_json(json, figures)


def _seconds(milliseconds: list[float]) -> tuple[float, ...]:
    return tuple(ms / 1000 for ms in milliseconds)
