"""``impasto demo``: the whole way from an unknown rig to a copy, on a simulated painting."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from workstation.json_output import JsonOption, write_json


class Size(StrEnum):
    """Those of :class:`workstation.demo_recording.DemoSize`, without what importing that takes."""

    USUAL = "usual"
    TINY = "tiny"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("demo")(demo)


def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to make.")] = Path("out/demo"),
    seed: Annotated[
        int, typer.Option(min=0, max=2**31 - 1, help="Of the painting and the noise.")
    ] = 0,
    size: Annotated[
        Size, typer.Option(help="A tiny one has small pictures, and a rig that is declared.")
    ] = Size.USUAL,
    force: Annotated[bool, typer.Option(help="Replace the folder if it exists.")] = False,
    json: JsonOption = None,
) -> None:
    """Digitise a simulated painting, from a board and mirror spheres to a copy and its report.

    The rig is calibrated, the painting scanned and photographed, its copy made, rendered, and held
    against photographs that the fit has not seen and against the truth.

    Example:

        impasto demo --out out/demo
    """
    from acquisition.atomic_files import folder_in_progress
    from workstation.demo_job import EXPECTED_S, run_demo
    from workstation.demo_recording import DemoSize
    from workstation.destinations import (
        DEMO_FILE,
        DEMO_FORMAT,
        Kind,
        check_destinations,
        check_replaced,
    )
    from workstation.interruption import too_late_to_stop
    from workstation.stage_progress import clock_text, stage_progress

    check_destinations(makes={"--out": out}, writes={"--json": json})
    check_replaced(out, Kind.DEMO, force=force)
    chosen = DemoSize(size.value)
    with (
        stage_progress("demo", EXPECTED_S[chosen]) as steps,
        folder_in_progress(out, replace=force) as folder,
    ):
        figures = run_demo(folder, chosen, seed=seed, begin=steps.begin, done=steps.done)
        write_json(folder / DEMO_FILE, {"format": DEMO_FORMAT, "size": size, "seed": seed})
        too_late_to_stop()
    write_json(json, figures)
    truth, held = figures["truth"], figures["reflectance"]["held_out"]
    typer.echo(
        f"height error {truth['height_rms_mm'] * 1000:.1f} µm RMS, predicted "
        f"{truth['height_rms_predicted_mm'] * 1000:.1f} µm (ratio "
        f"{truth['height_rms_over_predicted']:.2f}); photographs kept out of the fit "
        f"{held['psnr_db']:.1f} dB, mean ΔE2000 {held['delta_e']:.2f}; "
        f"{truth['texels_outside_canvas']} texels outside the canvas; "
        f"{clock_text(figures['total_seconds'])}, {figures['peak_mb']:.0f} MB"
    )
    typer.echo(f"open {out / 'index.html'}")
