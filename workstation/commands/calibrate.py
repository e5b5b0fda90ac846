"""``impasto calibrate``: poses of a board become a calibrated rig, photographs a light arm."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devices.bayer import BayerPattern
from workstation.json_output import JsonOption, write_json

if TYPE_CHECKING:
    from calibration.boards import Chessboard
    from calibration.gates import KnownDistance
    from calibration.rig_geometry import RigGeometry
    from workstation.calibration_extras import Extras, LightsAsked
    from workstation.calibration_messages import Messages
    from workstation.light_calibration import CalibratedLights
    from workstation.rig_calibration import CalibratedRig


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
        typer.Option("--board-shape", help="Solve for the place of every corner: paper boards."),
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
    then holds lamps.json, which impasto process takes.

    Example:

        for n in 1 2 3 4 5 6 7 8 9 10; do impasto scan rig.toml --out poses/$n; done

        impasto photograph rig.toml --out spheres/ --position front --exposure 0.1 --exposure 30

        impasto calibrate poses/ --corners 14 10 --square 20 --marker 15 --out rig/ --report report/
        --spheres spheres/ --sphere-radius 15
    """
    from workstation.calibration_extras import Extras
    from workstation.calibration_messages import messages_on_lights, messages_on_rig
    from workstation.calibration_options import CalibrationPaths, check_lights_alone, check_models
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
    models = tuple(_model_name(name) for name in model or ())
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
    asked = _lights(spheres, white, sphere_radius, sphere, white_pixel, white_albedo, mosaic,
                    position, lamps_for)  # fmt: skip
    extras = Extras(asked, tuple(greys or ()), chart, mosaic)
    if rig is not None:
        if asked is None:
            raise typer.BadParameter("goes with --spheres", param_hint="--rig")
        _calibrate_lights_alone(rig, extras, out, report, json, force=force)
        return
    if not sessions or corners is None or square is None:
        raise typer.BadParameter("name sessions of a board with --corners and --square, or a "
                                 "calibrated rig with --rig")  # fmt: skip
    board = _board(corners, square, square_sigma, marker, dictionary, legacy=legacy)
    with files_in_progress(report) as page:
        done, lights, figures = _calibrate_all(
            sessions,
            board,
            extras,
            models=models,
            board_shape=board_shape,
            compensate_phases=not raw_phases,
            held_out=held_out,
            known_mm=None if baseline is None else (baseline, baseline_sigma),
            earlier=tuple(earlier or ()),
            report=page,
        )
        too_late_to_stop()
    write_json(json, figures)
    if done.gates.passed and (lights is None or lights.gates.passed):
        _write(done, lights, asked, figures, out, opencv, force=force)
    _say(messages_on_rig(done))
    if lights is not None:
        _say(messages_on_lights(lights))
    _say_where(report)
    done.gates.refuse()
    if lights is not None:
        lights.gates.refuse()


def _lights(
    spheres: Path | None,
    white: Path | None,
    radius_mm: float | None,
    circles: list[str] | None,
    white_pixel: tuple[float, float] | None,
    albedo: float,
    mosaic: BayerPattern | None,
    position: str | None,
    lamps_for: list[Path] | None,
) -> LightsAsked | None:
    from workstation.calibration_extras import LightsAsked
    from workstation.light_calibration import LightOptions

    if spheres is None:
        if white is not None or radius_mm is not None or circles or lamps_for:
            raise typer.BadParameter("--white, --sphere-radius, --sphere and --lamps-for go with "
                                     "--spheres")  # fmt: skip
        return None
    if radius_mm is None:
        raise typer.BadParameter("name the spheres' radius", param_hint="--sphere-radius")
    options = LightOptions(
        sphere_mm=radius_mm,
        spheres_px=tuple(_circle(text) for text in circles or ()),
        target_px=white_pixel,
        albedo=albedo,
        mosaic=mosaic,
        place=position,
    )
    return LightsAsked(spheres, white, options, tuple(lamps_for or ()))


def _circle(text: str) -> tuple[float, float, float]:
    try:
        column, row, radius = map(float, text.split(","))
    except ValueError:
        raise typer.BadParameter(
            f"takes column, row and radius in pixels, 400,300,60 say, not {text!r}",
            param_hint="--sphere",
        ) from None
    return column, row, radius


def _calibrate_all(
    sessions: list[Path],
    board: Chessboard,
    extras: Extras,
    *,
    models: tuple[str, ...],
    board_shape: bool,
    compensate_phases: bool,
    held_out: int,
    known_mm: tuple[float, float] | None,
    earlier: tuple[Path, ...],
    report: Path | None,
) -> tuple[CalibratedRig, CalibratedLights | None, dict[str, Any]]:
    from calibration.procam import OPENCV_MODELS, ProcamOptions
    from workstation.board_poses import find_sessions, measure_poses
    from workstation.calibration_figures import calibration_figures
    from workstation.calibration_report import write_report
    from workstation.progress import progress
    from workstation.rig_calibration import calibrate_rig

    found = find_sessions(sessions)
    steps_of_lights = 3 if extras.lights is not None else 0
    total = len(found) + 3 + (report is not None) + steps_of_lights
    with progress("calibrating", total=total) as steps:

        def begin(stage: str) -> None:
            steps.advance()
            steps.begin(stage)

        poses = measure_poses(found, board, compensate_phases=compensate_phases, begin=begin)
        done = calibrate_rig(
            poses,
            options=ProcamOptions(models=models or OPENCV_MODELS, board_shape=board_shape),
            distances=lambda rig: _distances(rig, known_mm),
            earlier=earlier,
            held_out=held_out,
            begin=begin,
        )
        figures = calibration_figures(done)
        lights = None
        if extras.lights is not None and done.gates.passed:
            lights = extras.lights.calibrate(done.calibration.rig, begin=begin)
            figures |= {"light_arm": lights.figures()}
        if report is not None:
            begin("writing the report")
            write_report(
                done,
                report,
                sections=extras.sections(lights),
                figures=figures,
                light_gates=None if lights is None else lights.gates,
            )
    return done, lights, figures


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
    from calibration.rig_geometry import RigGeometry
    from workstation.calibration_messages import messages_on_lights
    from workstation.calibration_report import write_light_report
    from workstation.files_in_progress import files_in_progress
    from workstation.interruption import too_late_to_stop
    from workstation.progress import progress

    assert extras.lights is not None  # by the check of the options
    with progress("calibrating the lights", total=4) as steps:

        def begin(stage: str) -> None:
            steps.advance()
            steps.begin(stage)

        lights = extras.lights.calibrate(RigGeometry.load(rig), begin=begin)
        with files_in_progress(report) as page:
            if page is not None:
                write_light_report(lights, extras.sections(lights), page)
            too_late_to_stop()
    write_json(json, {"light_arm": lights.figures()})
    if out is not None and lights.gates.passed:
        with folder_in_progress(out, replace=force) as folder:
            extras.lights.write(lights, folder)
        typer.echo(f"{out}: calibration of the light arm")
    _say(messages_on_lights(lights))
    _say_where(report)
    lights.gates.refuse()


def _board(
    corners: tuple[int, int],
    square: float,
    sigma: float,
    marker: float | None,
    dictionary: str,
    *,
    legacy: bool,
) -> Chessboard:
    from calibration.boards import CharucoBoard, Chessboard

    columns, rows = corners
    if marker is None:
        return Chessboard(columns=columns, rows=rows, square_mm=square, square_sigma_mm=sigma)
    return CharucoBoard(
        columns=columns,
        rows=rows,
        square_mm=square,
        square_sigma_mm=sigma,
        marker_mm=marker,
        dictionary=dictionary,
        legacy=legacy,
    )


def _model_name(name: str) -> str:
    return name if name.startswith("LENSMODEL_") else f"LENSMODEL_{name.upper()}"


def _distances(rig: RigGeometry, baseline_mm: tuple[float, float] | None) -> list[KnownDistance]:
    import numpy as np

    from calibration.gates import KnownDistance

    if baseline_mm is None:
        return []
    return [KnownDistance(float(np.linalg.norm(rig.rt_proj_cam[3:])), *baseline_mm)]


def _write(
    done: CalibratedRig,
    lights: CalibratedLights | None,
    asked: LightsAsked | None,
    figures: dict[str, Any],
    out: Path | None,
    opencv: Path | None,
    *,
    force: bool,
) -> None:
    from acquisition.atomic_files import folder_in_progress
    from workstation.calibration_figures import FIGURES_FILE

    if out is not None:
        with folder_in_progress(out, replace=force) as folder:
            done.calibration.save(folder)
            if lights is not None and asked is not None:
                asked.write(lights, folder)
            write_json(folder / FIGURES_FILE, figures)
        typer.echo(f"{out}: calibration of the rig")
    if opencv is not None:
        done.calibration.save_opencv(opencv)
        typer.echo(f"{opencv}: for OpenCV")


def _say_where(report: Path | None) -> None:
    if report is not None:
        typer.echo(f"look at {report / 'index.html'}")


def _say(messages: Messages) -> None:
    for line in messages.said:
        typer.echo(line)
    for warning in messages.warnings:
        typer.echo(f"warning: {warning}", err=True)
