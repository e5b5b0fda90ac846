"""The whole pipeline: run time against error, and what every skip saves and costs.

One choice at a time is varied about the defaults: texel pitch, phase steps and exposures of the
scan, number of photographs, options of the solver; and the three qualities of ``impasto process``.
The processor's time is that of processing, not of recording. Heights are judged on a grid that is
the same for every pitch, so that what a coarse pitch cuts off counts; reflectance is judged by
photographs that no setting sees.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from fitting.reflectance.solver import SolverOptions
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.pipeline_plots import draw_curves
from workstation.benchmarks.pipeline_scenes import Capture, Point, RecordedScene, pareto_front
from workstation.processing import ProcessingOptions
from workstation.progress import progress
from workstation.quality import Quality, quality_options

PAINTINGS = ("small_oil", "oil", "torture")
_USUAL = Capture()
# Two points are alike where they differ by less: processors are not the same from run to run.
_SAME_TIME, _SAME_DB, _SAME_HEIGHT = 1.1, 0.1, 1.02


def bench(
    *,
    pictures: Path | None = None,
    width: int = 240,
    paintings: tuple[str, ...] = PAINTINGS,
    curves: bool = True,
) -> list[Record]:
    """Run time against error of the whole pipeline, and what every skip saves.

    Parameters
    ----------
    pictures : Path, optional
        Folder for ``pipeline.png`` and ``pipeline.json``'s curves.
    width : int
        Of the camera's pictures.
    paintings : tuple of str
        On which skips are measured; the first of them gives the curves.
    curves : bool
        Whether the curves are measured at all.
    """
    with TemporaryDirectory() as folder:
        records: list[Record] = []
        points: list[Point] = []
        scenes = {
            name: RecordedScene.of(name, Path(folder) / name, width=width) for name in paintings
        }
        if curves:
            points = list(_measure(scenes[paintings[0]]))
            records += _curve_records(points)
        for name, scene in scenes.items():
            records += list(_skips(name, scene))
    if pictures is not None and points:
        draw_curves(points, pictures / "pipeline.png")
    return records


def settings() -> Iterator[tuple[str, str, Capture, ProcessingOptions, bool]]:
    """Curve, name, what is recorded, options, and whether it is the default."""
    usual = quality_options(Quality.NORMAL)
    for quality in Quality:
        options = quality_options(quality)
        yield "quality", str(quality), _USUAL, options, quality is Quality.NORMAL
    for factor in (0.7, 1.6, 2.2):
        surface = replace(usual.surface, pitch_factor=factor)
        yield "texel pitch", f"× {factor:g}", _USUAL, replace(usual, surface=surface), False
    for steps in (4, 16):
        yield "phase steps", f"{steps}", replace(_USUAL, steps=steps), usual, False
    twice = replace(_USUAL, exposures_s=(0.0225, 0.09))
    yield "exposures", "two", twice, usual, False
    for lamps in (5, 20):
        yield "photographs", f"{2 * lamps}", replace(_USUAL, lamp_poses=lamps), usual, False
    for name, solver in (
        ("one start", SolverOptions(starts=1, weak_starts=1)),
        ("tolerance 10⁻³", SolverOptions(tolerance=1e-3)),
    ):
        yield "solver", name, _USUAL, _with_maps(usual, solver=solver), False
    yield "solver", "normals of heights", _USUAL, _with_maps(usual, refine_normals=False), False


def _measure(scene: RecordedScene) -> Iterator[Point]:
    chosen = list(settings())
    with progress("run time against error", total=len(chosen)) as steps:
        for curve, name, capture, options, default in chosen:
            steps.begin(f"{curve}: {name}")
            yield scene.measure(capture, options, curve=curve, name=name, default=default)
            steps.advance()


def _curve_records(points: list[Point]) -> Iterator[Record]:
    usual = next(point for point in points if point.default)
    for what, beaten in (
        ("heights", _beaten_in_heights(points, usual)),
        ("reflectance", _beaten_in_reflectance(points, usual)),
    ):
        yield Record(
            name=f"pipeline.{what}_beat_normal",
            value=len(beaten),
            unit="",
            bound=0,
            sense=Sense.AT_MOST,
            runs=len(points),
            note="; ".join(f"{p.curve} {p.name}" for p in beaten)
            or "nothing is both quicker and more accurate than the defaults",
        )
    for point in points:
        yield Record(
            name=f"pipeline.{point.curve}.{point.name}".replace(" ", "_"),
            value=point.seconds,
            unit="s",
            bound=600.0,
            sense=Sense.AT_MOST,
            note=f"heights {1e3 * point.height_mm:.1f} µm RMS, photographs kept out "
            f"{point.heldout_db:.2f} dB, {point.texels} texels"
            + (", on the front" if point in pareto_front(points) else ""),
        )


def _beaten_in_heights(points: Iterable[Point], usual: Point) -> list[Point]:
    return [
        p
        for p in points
        if p.seconds * _SAME_TIME < usual.seconds and p.height_mm * _SAME_HEIGHT < usual.height_mm
    ]


def _beaten_in_reflectance(points: Iterable[Point], usual: Point) -> list[Point]:
    return [
        p
        for p in points
        if p.seconds * _SAME_TIME < usual.seconds and p.heldout_db > usual.heldout_db + _SAME_DB
    ]


def _skips(name: str, scene: RecordedScene) -> Iterator[Record]:
    """Each skip switched off: how much longer it takes, and what the skip costs in accuracy."""
    draft = quality_options(Quality.DRAFT)
    sampling = replace(draft.reflectance.sampling, skip_above_horizon=False)
    all_rays = replace(draft, reflectance=replace(draft.reflectance, sampling=sampling))
    solver = replace(draft.reflectance.maps.solver, skip_diffuse=False)
    every_lobe = _with_maps(draft, solver=solver)
    with_skips = scene.measure(_USUAL, draft, curve="skips", name="all", default=False)
    for skip, capture, options in (
        ("rays_above_horizon", _USUAL, all_rays),
        ("lobes_of_diffuse_texels", _USUAL, every_lobe),
        ("exposures_not_needed", replace(_USUAL, adaptive=False), draft),
    ):
        without = scene.measure(capture, options, curve="skips", name=skip, default=False)
        added = without.heldout_db - with_skips.heldout_db
        frames = without.frames - with_skips.frames
        yield Record(
            name=f"pipeline.skip.{skip}.{name}",
            value=added,
            unit="dB",
            bound=0.2,
            sense=Sense.AT_MOST,
            note=f"lost of photographs kept out; saves "
            f"{without.seconds - with_skips.seconds:.1f} of {without.seconds:.1f} s of the "
            f"processor and {frames} of {without.frames} frames",
        )


def _with_maps(options: ProcessingOptions, **choices: object) -> ProcessingOptions:
    maps = replace(options.reflectance.maps, **choices)  # type: ignore[arg-type]
    return replace(options, reflectance=replace(options.reflectance, maps=maps))
