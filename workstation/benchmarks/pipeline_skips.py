"""What every skip of the pipeline saves, and the error that it adds, on one painting.

Each is switched off, and what comes of it held against what comes of the rest: photographs that
nobody sees, and heights, by how much worse they are for the skip.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from acquisition.plan import Metering
from fitting.copy_files import read_copy, write_copy
from render.painter import Painter
from render.painting_node import Mode
from render.views import NamedView, named_view
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.pipeline_scenes import Capture, RecordedScene
from workstation.copy_writing import write_processed
from workstation.processing import Processed, ProcessingOptions
from workstation.quality import Quality, quality_options
from workstation.stage_cache import StageCache, digest_of_files

_SIZE = (640, 480)
_TURNS = 5
_REPEATS = 3
_LOST_DB, _HEIGHT_RATIO = 0.2, 1.05
# As impasto scan takes them by default, in periods of the projector's frames of 1/60 s.
_METERED = Capture(exposures_s=(1 / 60, 3 / 60, 9 / 60), metering=Metering())
_USUAL = Capture()


@dataclass(frozen=True)
class _Skip:
    """What is left out, and how it is not left out."""

    name: str
    without: tuple[Capture, ProcessingOptions]
    skipping: tuple[Capture, ProcessingOptions]


def skip_records(scene: RecordedScene) -> list[Record]:
    """Records of every skip on a painting."""
    # Before the others: the first process of all reads the compiled kernels, too.
    done = scene.process(_USUAL, quality_options(Quality.DRAFT))
    return [
        *(record for skip in _skips() for record in _measured(scene, skip)),
        _unchanged_stages(scene),
        _bits_below_errors(scene, done),
        _boxes_below_budget(scene, done),
    ]


def _skips() -> list[_Skip]:
    # What most skips save does not depend on how well the lobes are fitted.
    draft, normal = quality_options(Quality.DRAFT), quality_options(Quality.NORMAL)
    sampling = replace(draft.reflectance.sampling, skip_above_horizon=False)
    all_rays = replace(draft, reflectance=replace(draft.reflectance, sampling=sampling))
    solver = replace(normal.reflectance.maps.solver, skip_diffuse=False)
    every_lobe = normal.with_maps(solver=solver)
    usual = (_USUAL, draft)
    return [
        _Skip("rays_above_horizon", (_USUAL, all_rays), usual),
        _Skip("lobes_of_diffuse_texels", (_USUAL, every_lobe), (_USUAL, normal)),
        _Skip("exposures_not_needed", (replace(_USUAL, adaptive=False), draft), usual),
        _Skip(
            "frames_of_scan_not_needed",
            (replace(_METERED, metering=None), draft),
            (_METERED, draft),
        ),
    ]


def _measured(scene: RecordedScene, skip: _Skip) -> Iterator[Record]:
    # By turns, and the quickest of each: a second of the processor is easily lost to other work.
    turns = [
        [
            scene.measure(*given, curve="skips", name=skip.name, default=False)
            for given in (skip.skipping, skip.without)
        ]
        for _ in range(_REPEATS)
    ]
    skipping, without = (
        min(points, key=lambda point: point.seconds) for points in zip(*turns, strict=True)
    )
    frames = without.frames - skipping.frames
    note = (
        f"saves {without.seconds - skipping.seconds:.1f} of {without.seconds:.1f} s of the "
        f"processor and {frames} of {without.frames} frames"
    )
    yield Record(
        name=f"pipeline.skip.{skip.name}.{scene.name}",
        value=without.heldout_db - skipping.heldout_db,
        unit="dB",
        bound=_LOST_DB,
        sense=Sense.AT_MOST,
        note=f"lost of photographs kept out; {note}",
    )
    yield Record(
        name=f"pipeline.skip.{skip.name}.{scene.name}.heights",
        value=skipping.height_mm / without.height_mm,
        unit="",
        bound=_HEIGHT_RATIO,
        sense=Sense.AT_MOST,
        note=f"RMS error of heights over {1e3 * without.height_mm:.1f} µm without the skip; {note}",
    )


def _unchanged_stages(scene: RecordedScene) -> Record:
    """The session processed again with nothing changed, which runs no stage."""
    with TemporaryDirectory() as folder:
        digests, seconds = [], []
        for number in range(2):
            out = Path(folder) / f"copy-{number}"
            done = scene.process(
                _USUAL,
                quality_options(Quality.DRAFT),
                stages=StageCache(Path(folder) / "stages"),
            )
            write_processed(done, out)
            digests.append(digest_of_files(out))
            seconds.append(sum(run.seconds for run in done.stages.runs))
    return Record(
        name=f"pipeline.skip.unchanged_stages.{scene.name}",
        value=len(set(digests)) - 1,
        unit="",
        bound=0,
        sense=Sense.AT_MOST,
        runs=2,
        note=f"copies that differ; saves {seconds[0] - seconds[1]:.1f} of {seconds[0]:.1f} s of "
        "the stages",
    )


def _bits_below_errors(scene: RecordedScene, done: Processed) -> Record:
    """The copy's files without the bits that standard errors leave no meaning."""
    sizes, judged = [], []
    with TemporaryDirectory() as folder:
        for exact in (True, False):
            out = Path(folder) / f"exact-{exact}"
            write_copy(done.copy, out, exact_maps=exact)
            sizes.append(sum(file.stat().st_size for file in out.iterdir()))
            judged.append(scene.judged(done, read_copy(out)))
    return Record(
        name=f"pipeline.skip.bits_below_errors.{scene.name}",
        value=judged[0] - judged[1],
        unit="dB",
        bound=_LOST_DB,
        sense=Sense.AT_MOST,
        note=f"lost of photographs kept out; saves {(sizes[0] - sizes[1]) / 1e6:.2f} of "
        f"{sizes[0] / 1e6:.2f} MB",
    )


def _boxes_below_budget(scene: RecordedScene, done: Processed) -> Record:
    """Drawn within a quarter of a pixel, and exactly."""
    width, height = _SIZE
    copy = done.copy
    view = named_view(copy, NamedView.INSHOT_GRAZING, aspect=width / height)
    pictures, milliseconds = {}, {}
    for mode in (Mode.EXACT, Mode.BOUNDED):
        with Painter() as painter:
            picture = painter.paint(copy, view, mode=mode, width=width, height=height)
            pictures[mode] = picture.encoded().astype(np.float64)
            turns = [
                painter.cost(copy, view, mode=mode, width=width, height=height)[0]
                for _ in range(_TURNS)
            ]
            milliseconds[mode] = 1e3 * float(np.median(turns))
    off = np.mean((pictures[Mode.EXACT] - pictures[Mode.BOUNDED]) ** 2)
    exact, bounded = milliseconds[Mode.EXACT], milliseconds[Mode.BOUNDED]
    return Record(
        name=f"pipeline.skip.search_below_budget.{scene.name}",
        value=float(20 * np.log10(255 / np.sqrt(max(off, 1e-12)))),
        unit="dB",
        bound=40.0,
        sense=Sense.AT_LEAST,
        runs=_TURNS,
        note=f"PSNR of the bounded mode against the exact one, grazing; saves "
        f"{exact - bounded:.1f} of {exact:.1f} ms of the painting's pass",
    )
