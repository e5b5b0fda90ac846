"""``impasto process``: a session becomes a digital copy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("process")(process)


def process(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="A finished session.")],
    out: Annotated[Path, typer.Option(metavar="COPY", help="Folder of the copy to make.")],
    calibration: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Use this rig calibration instead.")
    ] = None,
    pitch: Annotated[
        float | None, typer.Option(metavar="MM", help="Texel pitch; default: the points' spacing.")
    ] = None,
    delta0: Annotated[
        float | None,
        typer.Option(metavar="MM", help="Relief threshold; default: from the heights."),
    ] = None,
    seed: Annotated[
        tuple[int, int] | None,
        typer.Option(metavar="ROW COLUMN", help="A pixel of the scan on the canvas."),
    ] = None,
    cell: Annotated[int, typer.Option(min=1, help="Edge of a relief box in texels.")] = 20,
    force: Annotated[bool, typer.Option(help="Replace the copy if it exists.")] = False,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write figures here.")] = None,
) -> None:
    """Turn a scan session into a digital copy, and a picture of its relief beside it.

    Example:

        impasto process session/ --out copy/
    """
    from fitting.canvas import CanvasOptions
    from fitting.copy_files import check_destination, write_copy
    from fitting.relief_classification import ReliefOptions
    from fitting.relief_picture import draw_relief
    from fitting.surface import SurfaceOptions
    from workstation.json_output import write_json
    from workstation.processing import ProcessingOptions, process_session
    from workstation.progress import progress

    check_destination(out, replace=force)
    relief = ReliefOptions(delta0_mm=delta0, cell=cell)
    canvas = CanvasOptions(seed=seed)
    surface = SurfaceOptions(canvas=canvas, relief=relief, pitch_mm=pitch)
    options = ProcessingOptions(surface=surface)
    with progress("processing", total=4) as steps:

        def begin(stage: str) -> None:
            steps.advance()
            steps.begin(stage)

        done = process_session(session, calibration=calibration, options=options, begin=begin)
        begin("writing the copy")
        write_copy(done.copy, out, replace=force)
        draw_relief(done.copy, out.with_name(f"{out.name}-relief.png"))
    for warning in done.surface.warnings:
        typer.echo(f"warning: {warning}", err=True)
    figures = done.figures
    width, height = figures["size_mm"]
    noise = figures["height_noise"]
    typer.echo(
        f"{out}: {figures['texels']} texels of {figures['pitch_mm']:.3f} mm on "
        f"{width:.1f} × {height:.1f} mm, relief {figures['height_range_mm'][0]:.2f} to "
        f"{figures['height_range_mm'][1]:.2f} mm, δ0 {figures['delta0_mm']:.2f} mm, "
        f"{figures['boxes']} boxes; white noise {noise['observed_mm'] * 1000:.0f} µm, predicted "
        f"{noise['predicted_mm'] * 1000:.0f} µm"
    )
    write_json(json, figures)
