"""``impasto process``: a session becomes a digital copy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devices.bayer import BayerPattern

if TYPE_CHECKING:
    from fitting.digital_copy import DigitalCopy
    from fitting.reflectance.held_out import Comparison
    from workstation.processing import ProcessingOptions


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("process")(process)


def process(
    out: Annotated[Path, typer.Option(metavar="COPY", help="Folder of the copy to make.")],
    session: Annotated[
        Path | None, typer.Argument(metavar="SESSION", help="A finished scan session.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Use this rig calibration instead.")
    ] = None,
    photographs: Annotated[
        Path | None,
        typer.Option(metavar="SESSION", help="Photographs under the light arm, for reflectance."),
    ] = None,
    lamps: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Table of the lamp at each pose of its arm.")
    ] = None,
    lp: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Instead of a scan: pictures with light directions."),
    ] = None,
    linear: Annotated[
        bool, typer.Option(help="8-bit pictures of --lp hold linear values, not sRGB's.")
    ] = False,
    mosaic: Annotated[
        BayerPattern | None, typer.Option(help="Order of the camera's colours, if it has any.")
    ] = None,
    ggx: Annotated[bool, typer.Option(help="Write the reflectance as microfacets too.")] = False,
    keep_normals: Annotated[
        bool, typer.Option(help="Leave the normals as the heights have them.")
    ] = False,
    pitch: Annotated[
        float | None,
        typer.Option(metavar="MM", help="Texel pitch; of --lp, a pixel's. Default: the points'."),
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

    With photographs the copy gets its reflectance, and a picture beside it compares some that were
    kept out of the fit with their renderings.

    Example:

        impasto process session/ --out copy/

        impasto process session/ --photographs photographs/ --lamps lamps.json --out copy/

        impasto process --lp dome/lights.lp --out copy/
    """
    from fitting.canvas import CanvasOptions
    from fitting.copy_files import check_destination
    from fitting.reflectance.maps import MapOptions
    from fitting.reflectance.recorded_photographs import PhotographOptions
    from fitting.relief_classification import ReliefOptions
    from fitting.surface import SurfaceOptions
    from workstation.processing import ProcessingOptions
    from workstation.reflectance_processing import ReflectanceOptions

    if (session is None) == (lp is None):
        raise typer.BadParameter("name a SESSION, or pictures with --lp, and not both")
    if (photographs is None) != (lamps is None):
        raise typer.BadParameter("--photographs and --lamps go together")
    if lp is not None and photographs is not None:
        raise typer.BadParameter("--lp has pictures of its own; leave --photographs out")
    if ggx and lp is None and photographs is None:
        raise typer.BadParameter("--ggx converts reflectance: name --photographs or --lp")
    check_destination(out, replace=force)
    options = ProcessingOptions(
        surface=SurfaceOptions(
            canvas=CanvasOptions(seed=seed),
            relief=ReliefOptions(delta0_mm=delta0, cell=cell),
            pitch_mm=pitch,
        ),
        photographs=PhotographOptions(mosaic=mosaic),
        reflectance=ReflectanceOptions(maps=MapOptions(refine_normals=not keep_normals)),
    )
    if lp is not None:
        figures = _process_pictures(lp, out, pitch or 1.0, linear, options, ggx=ggx, force=force)
    else:
        assert session is not None  # by the check above
        figures = _process_scan(
            session, out, calibration, photographs, lamps, options, ggx=ggx, force=force
        )
    from workstation.json_output import write_json

    write_json(json, figures)


def _process_scan(
    session: Path,
    out: Path,
    calibration: Path | None,
    photographs: Path | None,
    lamps: Path | None,
    options: ProcessingOptions,
    *,
    ggx: bool,
    force: bool,
) -> dict[str, Any]:
    from fitting.relief_picture import draw_relief
    from workstation.processing import add_photographs, process_session
    from workstation.progress import progress

    with progress("processing", total=4 if photographs is None else 8) as steps:

        def begin(stage: str) -> None:
            steps.advance()
            steps.begin(stage)

        done = process_session(session, calibration=calibration, options=options, begin=begin)
        if photographs is not None and lamps is not None:
            done = add_photographs(done, photographs, lamps, options=options, begin=begin)
        begin("writing the copy")
        _write(done.copy, out, done.comparisons, ggx=ggx, force=force)
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
    _say(figures)
    return figures


def _process_pictures(
    lp: Path,
    out: Path,
    pitch_mm: float,
    linear: bool,
    options: ProcessingOptions,
    *,
    ggx: bool,
    force: bool,
) -> dict[str, Any]:
    from workstation.processing import process_light_only
    from workstation.progress import progress

    with progress("processing", total=4) as steps:

        def begin(stage: str) -> None:
            steps.advance()
            steps.begin(stage)

        copy, comparisons, figures = process_light_only(
            lp, pitch_mm=pitch_mm, linear=linear, options=options.reflectance, begin=begin
        )
        begin("writing the copy")
        _write(copy, out, comparisons, ggx=ggx, force=force)
    rows, cols = figures["shape"]
    typer.echo(f"{out}: {cols} × {rows} texels under {len(copy.provenance['pictures'])} lights")
    _say(figures)
    return figures


def _write(
    copy: DigitalCopy, out: Path, comparisons: Sequence[Comparison], *, ggx: bool, force: bool
) -> None:
    from fitting.copy_files import write_copy
    from fitting.reflectance.held_out_picture import draw_held_out
    from fitting.reflectance.microfacet import microfacets_of

    wanted = ggx and copy.reflectance is not None
    facets = microfacets_of(copy.reflectance) if wanted and copy.reflectance else None
    write_copy(copy, out, replace=force, microfacets=facets)
    if comparisons:
        draw_held_out(comparisons, out.with_name(f"{out.name}-held-out.png"))


def _say(figures: dict[str, Any]) -> None:
    """A line on the reflectance, if there is any."""
    reflectance = figures.get("reflectance")
    if reflectance is None:
        return
    line = (
        f"reflectance from {reflectance['photographs']} photographs, "
        f"{reflectance['samples_median']:.0f} samples a texel, "
        f"{len(reflectance['materials'])} materials"
    )
    held_out = reflectance.get("held_out")
    if held_out is not None:
        line += (
            f"; photographs kept out of the fit: {held_out['psnr_db']:.1f} dB, mean ΔE2000 "
            f"{held_out['delta_e']:.2f}"
        )
    typer.echo(line)
