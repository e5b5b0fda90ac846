"""The whole pipeline: run time against error, and what every skip saves and costs.

One choice at a time is varied about the defaults: texel pitch, phase steps and exposures of the
scan, number of photographs, options of the solver; and the three qualities of ``impasto process``.
Time is what a rig would take to record, but for what is done by hand, and the processor's for
processing. Heights are judged on a grid that is
the same for every pitch, so that what a coarse pitch cuts off counts; reflectance is judged by
photographs that no setting sees.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from acquisition.atomic_files import write_bytes
from fitting.reflectance.solver import SolverOptions
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.pipeline_scenes import DIME, PAINTINGS, Capture, RecordedScene
from workstation.benchmarks.pipeline_skips import skip_records
from workstation.processing import ProcessingOptions
from workstation.progress import progress
from workstation.quality import Quality, quality_options, stated_options
from workstation.quality_curve import ALIKE, QUALITY, QualityCurve, this_machine
from workstation.quality_plots import curve_pictures

CURVES = "curves"
PARTS = (CURVES, *(f"skips of {name}" for name in PAINTINGS))
CURVE_FILE = "quality-curve.json"
_CURVE_PAINTING = PAINTINGS[0]
# On smaller canvases looking for materials outweighs all else.
_CURVE_WIDTH = 480
_USUAL = Capture()


def bench(
    *,
    pictures: Path | None = None,
    width: int = 240,
    parts: Collection[str] = PARTS,
) -> list[Record]:
    """Run time against error of the whole pipeline, and what every skip saves.

    Parameters
    ----------
    pictures : Path, optional
        Folder for the curve, drawn and as ``quality-curve.json``.
    width : int
        Of the camera's pictures for the skips.
    parts : collection of str
        Of :data:`PARTS`: the curves, and the skips of each painting. The coin is there where
        IMPASTO_REAL_DATA names the folder of real captures.
    """
    records: list[Record] = []
    with TemporaryDirectory() as folder:
        for name in PAINTINGS:
            curves = name == _CURVE_PAINTING and CURVES in parts
            skips = f"skips of {name}" in parts
            if not (curves or skips) or (name == DIME and not RecordedScene.has_dime()):
                continue
            if curves:
                scene = RecordedScene.of(name, Path(folder) / f"{name}-curve", width=_CURVE_WIDTH)
                curve = measure_curve(scene)
                records += curve_records(curve)
                if pictures is not None:
                    _write_curve(curve, pictures)
            if skips:
                scene = RecordedScene.of(name, Path(folder) / name, width=width)
                records += skip_records(scene)
    return records


def settings() -> Iterator[tuple[str, str, Capture, ProcessingOptions, bool]]:
    """Curve, name, what is recorded, options, and whether it is the default."""
    usual = quality_options(Quality.NORMAL)
    for quality in Quality:
        options = quality_options(quality)
        yield QUALITY, str(quality), _USUAL, options, quality is Quality.NORMAL
    # The finer one is that of best.
    for factor in (1.6, 2.2):
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
        yield "solver", name, _USUAL, usual.with_maps(solver=solver), False
    yield "solver", "normals of heights", _USUAL, usual.with_maps(refine_normals=False), False


def measure_curve(scene: RecordedScene) -> QualityCurve:
    """Run time and error of every setting on a painting."""
    chosen = list(settings())
    points = []
    with progress("run time against error", total=len(chosen)) as steps:
        for curve, name, capture, options, default in chosen:
            steps.begin(f"{curve}: {name}")
            points.append(scene.measure(capture, options, curve=curve, name=name, default=default))
            steps.advance()
    return QualityCurve(
        tuple(points),
        scene.description,
        f"{datetime.now(UTC):%Y-%m-%d}",
        f"impasto {version('impasto')}",
        this_machine(),
        {str(quality): stated_options(quality) for quality in Quality},
    )


def _write_curve(curve: QualityCurve, folder: Path) -> None:
    curve.save(folder / CURVE_FILE)
    for name, picture in zip(("heights", "photographs"), curve_pictures(curve), strict=True):
        write_bytes(folder / f"time-and-{name}.png", picture.content)


def curve_records(curve: QualityCurve) -> Iterator[Record]:
    """What beats the defaults, and every setting's time with its errors."""
    usual = curve.quality(Quality.NORMAL)
    front = curve.front
    yield Record(
        name="pipeline.normal_on_front",
        value=float(usual in front),
        unit="",
        bound=1.0,
        sense=Sense.AT_LEAST,
        runs=len(curve.points),
        note="of time, heights and photographs kept out: " + ", ".join(p.label for p in front),
    )
    for what, figure in (("heights", 1), ("reflectance", 2)):
        gains = {
            p.label: np.subtract(usual.costs, p.costs)[[0, figure]] - np.array(ALIKE)[[0, figure]]
            for p in curve.points
        }
        beaten = [label for label, gain in gains.items() if (gain > 0).all()]
        yield Record(
            name=f"pipeline.{what}_beat_normal",
            value=len(beaten),
            unit="",
            bound=0,
            sense=Sense.AT_MOST,
            runs=len(curve.points),
            note="; ".join(beaten) or "nothing is both quicker and more accurate than the defaults",
        )
    for point in curve.points:
        yield Record(
            name=f"pipeline.{point.curve}.{point.name}".replace(" ", "_"),
            value=point.total_s,
            unit="s",
            bound=600.0,
            sense=Sense.AT_MOST,
            note=f"{point.seconds:.1f} s of it processing; heights {1e3 * point.height_mm:.1f} µm "
            f"RMS, photographs kept out {point.heldout_db:.2f} dB, {point.texels} texels"
            + (", on the front" if point in front else ""),
        )
