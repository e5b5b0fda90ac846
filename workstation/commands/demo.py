"""``impasto demo``: scan, process and render a simulated painting."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("demo")(demo)


def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to make.")] = Path("out/demo"),
    seed: Annotated[int, typer.Option(min=0, help="Of the painting and the noise.")] = 0,
    force: Annotated[bool, typer.Option(help="Replace the folder if it exists.")] = False,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write figures here.")] = None,
) -> None:
    """Scan a simulated painting, make its copy, render it, and compare it with the truth.

    Example:

        impasto demo --out out/demo
    """
    import time

    from acquisition.atomic_files import folder_in_progress
    from acquisition.errors import SessionError
    from devices.simulated.rig import demo_rig
    from fitting.copy_files import write_copy
    from render.painter import Painter
    from render.painting_node import Mode
    from render.picture_files import write_picture
    from render.views import NamedView, named_view
    from workstation.demo_page import write_demo_page
    from workstation.demonstration import measure_height_error, record_simulated_scan
    from workstation.interruption import stop_if_requested
    from workstation.json_output import write_json
    from workstation.processing import process_session
    from workstation.progress import progress

    if out.exists() and not (force and (out / "figures.json").is_file()):
        raise SessionError(f"{out} exists already; choose another place, or add --force")
    started = time.perf_counter()
    with (
        progress("demo", total=3 + len(NamedView)) as steps,
        folder_in_progress(out, replace=force) as folder,
    ):
        steps.begin("painting and lighting the scene")
        rig = demo_rig(seed=seed)
        steps.advance()
        steps.begin("scanning")
        record_simulated_scan(rig, folder / "session", advance=lambda frame_id: stop_if_requested())
        steps.advance()

        def begin(stage: str) -> None:
            steps.begin(stage)
            steps.advance()

        begin("processing")
        done = process_session(folder / "session")
        write_copy(done.copy, folder / "copy")
        (folder / "renders").mkdir()
        with Painter() as painter:
            for view in NamedView:
                steps.begin(f"rendering {view}")
                camera = named_view(done.copy, view, aspect=4 / 3)
                picture = painter.paint(done.copy, camera, mode=Mode.RELIEF)
                write_picture(picture, folder / "renders" / f"{view}.png")
                steps.advance()
        error = measure_height_error(done.copy, rig)
        figures = done.figures | {
            "truth": {
                "height_rms_mm": error.observed_rms_mm,
                "height_rms_predicted_mm": error.predicted_rms_mm,
                "height_rms_over_predicted": error.ratio,
                "height_bias_mm": error.bias_mm,
                "z_spread": error.spread,
                "texels_outside_canvas": error.outside_canvas,
            },
            "total_seconds": round(time.perf_counter() - started, 2),
        }
        write_json(folder / "figures.json", figures)
        write_demo_page(done, error, figures["total_seconds"], folder / "index.html")
    typer.echo(
        f"height error {error.observed_rms_mm * 1000:.1f} µm RMS, predicted "
        f"{error.predicted_rms_mm * 1000:.1f} µm (ratio {error.ratio:.2f}); "
        f"{error.outside_canvas} texels outside the canvas\nopen {out / 'index.html'}"
    )
    write_json(json, figures)
