"""``impasto calibrate``: poses of a board become a calibrated rig."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from calibration.boards import Chessboard
    from calibration.gates import KnownDistance
    from calibration.rig_geometry import RigGeometry
    from workstation.rig_calibration import CalibratedRig


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("calibrate")(calibrate)


def calibrate(
    sessions: Annotated[
        list[Path],
        typer.Argument(
            metavar="SESSION...",
            help="Sessions of one board pose each, or folders of such sessions.",
        ),
    ],
    corners: Annotated[
        tuple[int, int],
        typer.Option(metavar="COLUMNS ROWS", min=3, help="Inner corners of the board."),
    ],
    square: Annotated[float, typer.Option(metavar="MM", min=0.01, help="Side of a square.")],
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
    opencv: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write OpenCV's matrices as .yml or .xml.")
    ] = None,
    force: Annotated[bool, typer.Option(help="Replace --out if it exists.")] = False,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write figures here.")] = None,
) -> None:
    """Calibrate camera and projector from sessions of a board, one pose each.

    Scan the board at ten poses or more, tilted by 20° to 40° to all four sides, at the distances
    and over all of the field at which paintings will stand. A calibration that fails a gate is
    reported but not written, and the exit code is 5.

    Example:

        for n in 1 2 3 4 5 6 7 8 9 10; do impasto scan rig.toml --out poses/$n; done

        impasto calibrate poses/ --corners 14 10 --square 20 --marker 15 --out rig/ --report report/
    """
    from calibration.procam import OPENCV_MODELS, ProcamOptions
    from workstation.calibration_figures import calibration_figures
    from workstation.calibration_report import ReportSections, write_report
    from workstation.json_output import write_json
    from workstation.progress import progress
    from workstation.rig_calibration import calibrate_rig, find_sessions, measure_poses

    _check_outputs(out, opencv, force=force)
    board = _board(corners, square, square_sigma, marker, dictionary, legacy=legacy)
    models = tuple(_model_name(name) for name in model) if model else OPENCV_MODELS
    found = find_sessions(sessions)
    with progress("calibrating", total=len(found) + 3 + (report is not None)) as steps:

        def begin(stage: str) -> None:
            steps.advance()
            steps.begin(stage)

        poses = measure_poses(found, board, compensate_phases=not raw_phases, begin=begin)
        done = calibrate_rig(
            poses,
            options=ProcamOptions(models=models, board_shape=board_shape),
            distances=lambda rig: _distances(rig, baseline, baseline_sigma),
            earlier=tuple(earlier or ()),
            begin=begin,
        )
        figures = calibration_figures(done)
        if report is not None:
            begin("writing the report")
            write_report(done, report, sections=ReportSections())
    write_json(json, figures)
    _say(done, report)
    done.gates.refuse()
    _write(done, out, opencv, force=force)


def _check_outputs(out: Path | None, opencv: Path | None, *, force: bool) -> None:
    from calibration.errors import CalibrationError

    if out is not None and out.exists() and not force:
        raise CalibrationError(f"{out} exists already; choose another place, or replace it "
                               "with --force")  # fmt: skip
    if opencv is not None and opencv.suffix not in (".yml", ".yaml", ".xml"):
        raise typer.BadParameter("takes a file in .yml, .yaml or .xml", param_hint="--opencv")


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


def _distances(rig: RigGeometry, known: float | None, sigma: float) -> list[KnownDistance]:
    import numpy as np

    from calibration.gates import KnownDistance

    if known is None:
        return []
    return [KnownDistance(float(np.linalg.norm(rig.rt_proj_cam[3:])), known, sigma)]


def _write(done: CalibratedRig, out: Path | None, opencv: Path | None, *, force: bool) -> None:
    from acquisition.atomic_files import folder_in_progress
    from workstation.calibration_figures import FIGURES_FILE, calibration_figures
    from workstation.json_output import write_json

    if out is not None:
        with folder_in_progress(out, replace=force) as folder:
            done.calibration.save(folder)
            write_json(folder / FIGURES_FILE, calibration_figures(done))
        typer.echo(f"{out}: calibration of the rig")
    if opencv is not None:
        done.calibration.save_opencv(opencv)
        typer.echo(f"{opencv}: for OpenCV")


def _say(done: CalibratedRig, report: Path | None) -> None:
    calibration = done.calibration
    solution = calibration.solution
    typer.echo(
        f"{len(calibration.views)} poses, {int(solution.inliers.sum())} corners, "
        f"{calibration.rig.camera.model}: {solution.rms_per_point_px:.3f} px per point at "
        f"{calibration.working_distance_mm:.0f} mm"
    )
    if done.heights is not None:
        typer.echo(
            f"heights by this calibration are uncertain by {1000 * done.heights.rms_mm:.1f} µm "
            f"about their plane, lengths by {100 * done.heights.scale_sigma:.3f} %"
        )
    for pose in done.poses.unread:
        typer.echo(f"warning: {pose.name} was left out: {pose.why}", err=True)
    for corner in calibration.rejected_corners:
        typer.echo(f"warning: left out {corner}", err=True)
    for verdict in done.gates.failures:
        if not verdict.refuses:
            typer.echo(f"warning: {verdict.gate}: {verdict.remedy}", err=True)
    if report is not None:
        typer.echo(f"look at {report / 'index.html'}")
