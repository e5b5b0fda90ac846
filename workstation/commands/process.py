"""``impasto process``: a session becomes a digital copy."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devices.bayer import BayerPattern
from workstation.json_output import JsonOption, write_json

if TYPE_CHECKING:
    from workstation.processing import ProcessingOptions
    from workstation.stage_cache import StageRun


class QualityChoice(StrEnum):
    """Those of :class:`workstation.quality.Quality`, without what importing that takes."""

    DRAFT = "draft"
    NORMAL = "normal"
    BEST = "best"


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
        BayerPattern | None,
        typer.Option(help="Order of the camera's colours, where the photographs do not say."),
    ] = None,
    ggx: Annotated[bool, typer.Option(help="Write the reflectance as microfacets too.")] = False,
    exact_maps: Annotated[
        bool, typer.Option(help="Keep bits of the maps that are below their standard errors.")
    ] = False,
    keep_normals: Annotated[
        bool, typer.Option(help="Leave the normals as the heights have them.")
    ] = False,
    quality: Annotated[
        QualityChoice, typer.Option(help="Run time against error; both are said beforehand.")
    ] = QualityChoice.NORMAL,
    stages: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Keep results of the stages here; default: COPY-stages."),
    ] = None,
    afresh: Annotated[
        bool, typer.Option("--afresh", help="Run every stage, and keep no results of them.")
    ] = False,
    pitch: Annotated[
        float | None,
        typer.Option(
            min=1e-6, metavar="MM", help="Texel pitch; of --lp, a pixel's. Default: the points'."
        ),
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
    json: JsonOption = None,
) -> None:
    """Turn a scan session into a digital copy, and a picture of its relief beside it.

    With photographs the copy gets its reflectance, and a picture beside it compares some that were
    kept out of the fit with their renderings. Run again, it runs only the stages whose recording,
    calibration or parameters have changed; cut off, it goes on after the last stage that ended. A
    copy of the same session is replaced, any other only with --force.

    Example:

        impasto process session/ --out copy/

        impasto process session/ --photographs photographs/ --lamps lamps.json --out copy/

        impasto process --lp dome/lights.lp --out copy/
    """
    from workstation.copy_places import places_beside, stages_folder
    from workstation.destinations import check_destinations
    from workstation.stage_cache import sole_use

    if (session is None) == (lp is None):
        raise typer.BadParameter("name a SESSION, or pictures with --lp, and not both")
    if (photographs is None) != (lamps is None):
        raise typer.BadParameter("--photographs and --lamps go together")
    if lp is not None and photographs is not None:
        raise typer.BadParameter("--lp has pictures of its own; leave --photographs out")
    if ggx and lp is None and photographs is None:
        raise typer.BadParameter("--ggx converts reflectance: name --photographs or --lp")

    choices = _Choices(quality, seed, delta0, cell, pitch, mosaic, keep_normals, ggx, exact_maps)
    if out.name in ("", ".."):
        out = out.resolve()
    place = stages or stages_folder(out)
    check_destinations(
        *(session, calibration, photographs, lamps, lp),
        makes={"--out": out},
        fills={} if lp is not None else {"--stages": place},
        writes={"--json": json},
        beside={f"--out ({what})": path for what, path in places_beside(out).items()},
    )
    if lp is not None:
        _process_pictures(
            lp, out, 1.0 if pitch is None else pitch, linear, choices, json, force=force
        )
        return
    assert session is not None  # by the check above
    inputs = _Inputs(session, calibration, photographs, lamps)
    kept = None if afresh else place
    current = _is_up_to_date(inputs, out, choices, kept, json)
    with sole_use(place):
        if not current:
            _process_scan(inputs, out, choices, kept, json, force=force)


@dataclass(frozen=True)
class _Inputs:
    """What a copy is made of."""

    session: Path
    calibration: Path | None
    photographs: Path | None
    lamps: Path | None


@dataclass(frozen=True)
class _Choices:
    """How it is made."""

    quality: QualityChoice
    seed: tuple[int, int] | None
    delta0: float | None
    cell: int
    pitch: float | None
    mosaic: BayerPattern | None
    keep_normals: bool
    ggx: bool
    exact_maps: bool


def _options(choices: _Choices) -> ProcessingOptions:
    from dataclasses import replace

    from fitting.canvas import CanvasOptions
    from fitting.reflectance.recorded_photographs import PhotographOptions
    from fitting.relief_classification import ReliefOptions
    from workstation.quality import Quality, quality_options

    chosen = quality_options(Quality(choices.quality.value))
    surface = replace(
        chosen.surface,
        canvas=CanvasOptions(seed=choices.seed),
        relief=ReliefOptions(delta0_mm=choices.delta0, cell=choices.cell),
        pitch_mm=choices.pitch,
    )
    if choices.keep_normals:
        chosen = chosen.with_maps(refine_normals=False)
    photographs = PhotographOptions(mosaic=choices.mosaic)
    return replace(chosen, surface=surface, photographs=photographs)


def _request(inputs: _Inputs, choices: _Choices) -> str:
    from workstation.up_to_date import digest_of_request

    return digest_of_request(vars(inputs), vars(choices))


def _is_up_to_date(
    inputs: _Inputs, out: Path, choices: _Choices, kept: Path | None, json: Path | None
) -> bool:
    """Whether a copy is there already as it would be made; says and writes its figures."""
    from workstation.up_to_date import figures_if_written

    figures = figures_if_written(out, kept, _request(inputs, choices))
    if figures is None:
        return False
    saved = sum(run["seconds"] + run["saved_s"] for run in figures["stages"])
    figures["stages"] = [
        run | {"skipped": True, "seconds": 0.0, "saved_s": run["seconds"] + run["saved_s"]}
        for run in figures["stages"]
    ]
    write_json(json, figures)
    _say_heights(figures, out, current=True)
    _say(figures)
    typer.echo(f"no stage had to run, {saved:.1f} s spared")
    return True


def _process_scan(
    inputs: _Inputs,
    out: Path,
    choices: _Choices,
    kept: Path | None,
    json: Path | None,
    *,
    force: bool,
) -> None:
    from acquisition.session import Session
    from acquisition.session_mosaic import mosaic_of
    from workstation.copy_writing import check_copy_destination, write_processed, write_run
    from workstation.expected_time import expected_seconds
    from workstation.interruption import too_late_to_stop
    from workstation.processing import add_photographs, process_session
    from workstation.quality import Quality, describe
    from workstation.stage_cache import StageCache
    from workstation.stage_progress import clock_text, stage_progress
    from workstation.stage_times import note_times, times_before
    from workstation.up_to_date import note_written

    quality = Quality(choices.quality.value)
    request = _request(inputs, choices)
    session = Session.open(inputs.session)
    check_copy_destination(out, session.digest, force=force)
    pictures = None if inputs.photographs is None else Session.open(inputs.photographs)
    if pictures is not None:
        mosaic_of(pictures, choices.mosaic)
    stages = StageCache(kept)
    before = times_before(kept, str(quality))
    expected = expected_seconds(session, photographs=pictures, quality=quality, before=before)
    total = sum(expected.values())
    typer.echo(
        f"{quality}: about {clock_text(total)} if every stage runs; {describe(quality)}", err=True
    )
    with stage_progress("processing", expected) as steps:
        stages.begin, stages.done = steps.begin, steps.done
        done = process_session(
            inputs.session,
            calibration=inputs.calibration,
            options=_options(choices),
            stages=stages,
        )
        if inputs.photographs is not None and inputs.lamps is not None:
            done = add_photographs(done, inputs.photographs, inputs.lamps)
        steps.begin("writing the copy")
        expectation = {"quality": str(quality), "expected_seconds": expected}
        figures = done.figures | expectation
        too_late_to_stop()
        write_processed(done, out, ggx=choices.ggx, exact_maps=choices.exact_maps)
        write_run(done, out, expectation)
        note_times(kept, str(quality), stages.runs)
        note_written(out, kept, request, figures)
        write_json(json, figures)
    for warning in done.warnings:
        typer.echo(f"warning: {warning}", err=True)
    _say_heights(figures, out, current=False)
    _say(figures)
    _say_times(stages.runs)


def _say_times(runs: list[StageRun]) -> None:
    from workstation.stage_progress import clock_text

    took = sum(run.seconds for run in runs)
    saved = sum(run.saved_s for run in runs)
    spared = f", and {clock_text(saved)} spared" if saved else ""
    typer.echo(f"{clock_text(took)} taken{spared}")


def _say_heights(figures: dict[str, Any], out: Path, *, current: bool) -> None:
    width, height = figures["size_mm"]
    noise = figures["height_noise"]
    typer.echo(
        f"{out}{' is up to date' if current else ''}: {figures['texels']} texels of "
        f"{figures['pitch_mm']:.3f} mm on {width:.1f} × {height:.1f} mm, relief "
        f"{figures['height_range_mm'][0]:.2f} to {figures['height_range_mm'][1]:.2f} mm, "
        f"δ0 {figures['delta0_mm']:.2f} mm, {figures['boxes']} boxes; standard error of a height "
        f"{figures['height_sigma_mm'] * 1000:.0f} µm, white noise "
        f"{noise['observed_mm'] * 1000:.0f} µm, predicted {noise['predicted_mm'] * 1000:.0f} µm"
    )


def _process_pictures(
    lp: Path,
    out: Path,
    pitch_mm: float,
    linear: bool,
    choices: _Choices,
    json: Path | None,
    *,
    force: bool,
) -> None:
    from calibration.light_directions import read_lp
    from fitting.copy_files import check_destination
    from workstation.copy_writing import write_pictured
    from workstation.destinations import check_destinations
    from workstation.interruption import too_late_to_stop
    from workstation.light_only_processing import process_light_only
    from workstation.progress import progress

    check_destination(out, replace=force)
    options = _options(choices).reflectance
    pictures = read_lp(lp, pictures=lp.parent).pictures
    check_destinations(*(lp.parent / name for name in pictures), writes={"--json": json})

    with progress("processing", total=4) as steps:

        def begin(stage: str) -> None:
            steps.advance()
            steps.begin(stage)

        copy, comparisons, figures = process_light_only(
            lp, pitch_mm=pitch_mm, linear=linear, options=options, begin=begin
        )
        begin("writing the copy")
        too_late_to_stop()
        write_pictured(
            *(copy, out, comparisons),
            ggx=choices.ggx,
            exact_maps=choices.exact_maps,
            replace=force,
        )
        write_json(json, figures)
    rows, cols = figures["shape"]
    typer.echo(f"{out}: {cols} × {rows} texels under {len(copy.provenance['pictures'])} lights")
    _say(figures)


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
