"""``impasto calibrate``: poses of a board become a calibrated rig, photographs a light arm."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devices.bayer import BayerPattern
from workstation.json_output import JsonOption, write_json

if TYPE_CHECKING:
    from workstation.calibration_extras import Extras
    from workstation.calibration_messages import Messages


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("calibrate")(calibrate)


def calibrate(
    sessions: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="SESSION...",
            help="Sessions of one board pose each, or folders of such sessions.",
        ),
    ] = None,
    corners: Annotated[
        tuple[int, int] | None,
        typer.Option(metavar="COLUMNS ROWS", min=3, help="Inner corners of the board."),
    ] = None,
    square: Annotated[
        float | None, typer.Option(metavar="MM", min=0.01, help="Side of a square.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the rig calibration to make.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write index.html and report.json here.")
    ] = None,
    marker: Annotated[
        float | None,
        typer.Option(metavar="MM", min=0.01, help="Side of the markers of a ChArUco board."),
    ] = None,
    dictionary: Annotated[
        str, typer.Option(metavar="NAME", help="OpenCV's dictionary of the markers.")
    ] = "DICT_5X5_250",
    legacy: Annotated[
        bool, typer.Option("--legacy", help="The board was printed by OpenCV before 4.6.")
    ] = False,
    square_sigma: Annotated[
        float, typer.Option(metavar="MM", min=0.0, help="Standard error of the square's side.")
    ] = 0.0,
    model: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Lens model of mrcal; several times, from the simplest to the richest, to choose "
            "by cross-validation. By default OPENCV4, 5 and 8.",
        ),
    ] = None,
    board_shape: Annotated[
        bool,
        typer.Option(
            "--board-shape",
            help="Solve for the shape of the board, from all of its white surface: paper boards. "
            "Says how askew it is printed, and by how much camera and projector moved.",
        ),
    ] = False,
    raw_phases: Annotated[
        bool, typer.Option("--raw-phases", help="Leave periodic errors of the fringes in.")
    ] = False,
    held_out: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=0,
            help="Poses to be held out, one by one, and compared as reconstructed surfaces.",
        ),
    ] = 3,
    baseline: Annotated[
        float | None,
        typer.Option(
            metavar="MM", min=0.01, help="Distance of camera and projector, measured by hand."
        ),
    ] = None,
    baseline_sigma: Annotated[
        float, typer.Option(metavar="MM", min=0.0, help="Standard error of --baseline.")
    ] = 1.0,
    earlier: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR",
            exists=True,
            file_okay=False,
            help="Earlier calibration, to check for drift; several times, the latest first.",
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Calibrate lights only, with this calibration of the rig."
        ),
    ] = None,
    spheres: Annotated[
        Path | None,
        typer.Option(metavar="SESSION", help="Photographs of mirror spheres under the light arm."),
    ] = None,
    white: Annotated[
        Path | None,
        typer.Option(
            metavar="SESSION",
            help="Photographs of a flat white target; by default it is in those of --spheres.",
        ),
    ] = None,
    sphere_radius: Annotated[
        float | None, typer.Option(metavar="MM", min=0.1, help="Radius of the mirror spheres.")
    ] = None,
    sphere: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN,ROW,RADIUS",
            help="Where a sphere is, pixels; several times. By default they are looked for.",
        ),
    ] = None,
    white_pixel: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="COLUMN ROW", help="On the white target; by default the middle."),
    ] = None,
    white_albedo: Annotated[
        float, typer.Option(min=0.01, max=1.0, help="Reflectance of the white target.")
    ] = 1.0,
    mosaic: Annotated[
        BayerPattern | None,
        typer.Option(help="Order of the camera's colours, where the photographs do not say."),
    ] = None,
    position: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Place of the rig's camera; by default the first."),
    ] = None,
    lamps_for: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="SESSION", help="Photographs whose lamp poses lamps.json is to hold too."
        ),
    ] = None,
    greys: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="SESSION",
            help="Greys of the projector, for the report; several times for standard errors.",
        ),
    ] = None,
    chart: Annotated[
        Path | None,
        typer.Option(metavar="SESSION", help="Photographs with a colour chart, for the report."),
    ] = None,
    opencv: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write OpenCV's matrices as .yml or .xml.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace --out if it is a calibration.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Calibrate camera and projector from sessions of a board, and the light arm from photographs.

    Scan the board at ten poses or more, tilted by 20° to 40° to all four sides, at the distances
    and over all of the field at which paintings will stand. A calibration that fails a gate is
    reported but not written, and the exit code is 5.

    For the lights, photograph two mirror spheres with a flat white target between them. The folder
    then holds lamps.json, which impasto process takes. Lights that fail leave it out: a rig that
    passed is written all the same.

    Example:

        for n in 1 2 3 4 5 6 7 8 9 10; do impasto scan rig.toml --out poses/$n; done

        impasto photograph rig.toml --out spheres/ --position front --exposure 0.1 --exposure 30

        impasto calibrate poses/ --corners 14 10 --square 20 --marker 15 --out rig/ --report report/
        --spheres spheres/ --sphere-radius 15
    """
    from calibration.procam import OPENCV_MODELS, ProcamOptions
    from workstation.calibration_extras import Extras
    from workstation.calibration_messages import messages_on_lights, messages_on_rig
    from workstation.calibration_options import (
        CalibrationPaths,
        board_of,
        check_lights_alone,
        check_models,
        lights_of,
        model_name,
    )
    from workstation.calibration_run import RigAsked, run_calibration
    from workstation.files_in_progress import files_in_progress
    from workstation.interruption import too_late_to_stop

    if rig is not None:
        check_lights_alone(
            {
                "sessions of a board": sessions,
                "--corners": corners,
                "--square": square,
                "--marker": marker,
                "--model": model,
                "--board-shape": board_shape,
                "--baseline": baseline,
                "--earlier": earlier,
                "--opencv": opencv,
            }
        )
    models = tuple(model_name(name) for name in model or ())
    check_models(models)
    CalibrationPaths(
        sessions=tuple(sessions or ()),
        earlier=tuple(earlier or ()),
        lamps_for=tuple(lamps_for or ()),
        greys=tuple(greys or ()),
        rig=rig,
        spheres=spheres,
        white=white,
        chart=chart,
        out=out,
        report=report,
        opencv=opencv,
        json=json,
    ).check(force=force)
    lights_asked = lights_of(
        spheres=spheres,
        white=white,
        radius_mm=sphere_radius,
        circles=sphere or (),
        white_pixel=white_pixel,
        albedo=white_albedo,
        mosaic=mosaic,
        position=position,
        lamps_for=tuple(lamps_for or ()),
    )
    extras = Extras(lights_asked, tuple(greys or ()), chart, mosaic)
    if rig is not None:
        if lights_asked is None:
            raise typer.BadParameter("goes with --spheres", param_hint="--rig")
        _calibrate_lights_alone(rig, extras, out, report, json, force=force)
        return
    if not sessions or corners is None or square is None:
        raise typer.BadParameter("name sessions of a board with --corners and --square, or a "
                                 "calibrated rig with --rig")  # fmt: skip
    asked = RigAsked(
        sessions=sessions,
        board=board_of(corners, square, square_sigma, marker, dictionary, legacy=legacy),
        options=ProcamOptions(models=models or OPENCV_MODELS, board_shape=board_shape),
        compensate_phases=not raw_phases,
        held_out=held_out,
        baseline_mm=None if baseline is None else (baseline, baseline_sigma),
        earlier=tuple(earlier or ()),
    )
    with files_in_progress(report) as page:
        done = run_calibration(asked, extras, report=page)
        too_late_to_stop()
    write_json(json, done.figures)
    if done.rig.gates.passed:
        if out is not None:
            done.save(out, extras, replace=force)
            typer.echo(f"{out}: calibration of the rig")
        if opencv is not None:
            done.rig.calibration.save_opencv(opencv)
            typer.echo(f"{opencv}: for OpenCV")
    _say(messages_on_rig(done.rig))
    if done.lights is not None:
        _say(messages_on_lights(done.lights))
    _say_where(report)
    done.refuse(out)


def _calibrate_lights_alone(
    rig: Path,
    extras: Extras,
    out: Path | None,
    report: Path | None,
    json: Path | None,
    *,
    force: bool,
) -> None:
    from acquisition.atomic_files import folder_in_progress
    from workstation.calibration_messages import messages_on_lights
    from workstation.calibration_run import run_light_calibration
    from workstation.files_in_progress import files_in_progress
    from workstation.interruption import too_late_to_stop

    with files_in_progress(report) as page:
        lights = run_light_calibration(rig, extras, report=page)
        too_late_to_stop()
    write_json(json, {"light_arm": lights.figures()})
    if out is not None and extras.lights is not None and lights.gates.passed:
        with folder_in_progress(out, replace=force) as folder:
            extras.lights.write(lights, folder)
        typer.echo(f"{out}: calibration of the light arm")
    _say(messages_on_lights(lights))
    _say_where(report)
    lights.gates.refuse()


def _say_where(report: Path | None) -> None:
    if report is not None:
        typer.echo(f"look at {report / 'index.html'}")


def _say(messages: Messages) -> None:
    for line in messages.said:
        typer.echo(line)
    for warning in messages.warnings:
        typer.echo(f"warning: {warning}", err=True)
