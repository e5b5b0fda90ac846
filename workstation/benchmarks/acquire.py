"""Acquisition: what a merged bracket is worth, what is left out, and how fast a scan is recorded.

Brackets are simulated here, by the Poisson and read-out noise of a plain sensor. A scan of the
simulated oil painting at three megapixels is recorded once; then it is recorded again in a process
of its own, by devices that answer from raw samples at once, without any exposure during which work
could be done. All of that is timed: checks of every frame, compression, digests, flushes, journal.
A metered scan is recorded in the same way for its memory.

What scans may leave out, the torture piece and the projector's response have modules of their own.
"""

from __future__ import annotations

import os
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import SessionError
from acquisition.exposure_ratios import estimate_exposures
from acquisition.hdr import merge_bracket, variance_bound
from acquisition.plan import Metering, Plan
from acquisition.recorded_frames import recording_of
from acquisition.recording import record_plan
from acquisition.sample_noise import SampleNoise
from acquisition.scan import plan_scan, scan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from devices.replay import replay_rig
from devices.rig import Rig
from devices.simulated.settings import PaintingKind, SimulationSettings
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.frames_against_error import (
    compare_plans,
    compare_with_full,
    draw_outcomes,
    skip_records,
)
from workstation.benchmarks.response_capture import CAPTURE, gamma_record
from workstation.benchmarks.torture_decoding import hdr_records

_FULL_WELL_E, _READ_E, _BLACK, _CEILING = 10_000.0, 8.0, 32.0, 4095
_GAIN = _CEILING / _FULL_WELL_E
_NOISE = SampleNoise((_READ_E * _GAIN) ** 2 + 1 / 12, _GAIN, "simulated")
_TIMES_S = (1.0, 4.0, 16.0)
_WRONG_BY = (0.85, 1.15)
_EXPOSURES_S = (1 / 60, 3 / 60, 9 / 60)
_RUNS = 5
_PICTURE = "frames-against-error.png"


def bench(*, pictures: Path | None = None) -> list[Record]:
    """Merging, exposure ratios, response, skipping, and speed and memory of a recording.

    Parameters
    ----------
    pictures : Path, optional
        Folder for the picture of frames against error.
    """
    records = [*_merge_records(), _ratio_record(), *_recording_records(), *hdr_records()]
    outcomes = compare_plans()
    records += skip_records(*compare_with_full(), outcomes)
    if pictures is not None:
        draw_outcomes(outcomes, pictures / _PICTURE)
    data = os.environ.get("IMPASTO_REAL_DATA")
    if data:
        records.append(gamma_record(Path(data) / CAPTURE))
    return records


def _expose(
    radiance: NDArray[np.float64], exposure_s: float, random: np.random.Generator
) -> NDArray[np.uint16]:
    """A frame of a plain linear sensor; radiance in sensor numbers per second."""
    electrons = random.poisson(np.minimum(radiance * exposure_s / _GAIN, 5 * _FULL_WELL_E))
    numbers = (electrons + random.normal(0, _READ_E, radiance.shape)) * _GAIN + _BLACK
    return np.clip(np.round(numbers), 0, _CEILING).astype(np.uint16)


def _merge_records() -> list[Record]:
    ratios, biases = [], []
    # The brightest decade ends where the shortest exposure saturates.
    for low, high in ((0, 1), (1, 2), (2, 3), (3, np.log10(0.9 * _CEILING))):
        random = np.random.default_rng(low)
        rows = np.logspace(low, high, 200)
        radiance = np.broadcast_to(rows[:, np.newaxis], (200, 6000))
        merged = merge_bracket(
            [_expose(radiance, t, random) for t in _TIMES_S],
            list(_TIMES_S),
            noise=_NOISE,
            black_level=_BLACK,
            saturation_level=_CEILING,
        ).radiance.astype(np.float64)
        bound = variance_bound(
            rows, list(_TIMES_S), noise=_NOISE, black_level=_BLACK, saturation_level=_CEILING
        )
        ratios.append(float((merged.var(axis=1) / bound).mean()))
        biases.append(abs(float((merged.mean(axis=1) / rows - 1).mean())))
    decades = ", ".join(f"{ratio:.3f}" for ratio in ratios)
    return [
        Record(
            name="hdr.variance_over_bound",
            value=max(ratios),
            unit="",
            bound=1.05,
            sense=Sense.AT_MOST,
            runs=len(ratios),
            note=f"worst decade of radiance; by decade {decades}",
        ),
        Record(
            name="hdr.bias",
            value=max(biases),
            unit="",
            bound=0.002,
            sense=Sense.AT_MOST,
            runs=len(biases),
            note="largest mean relative error of a decade, of 1.2 million merged pixels each",
        ),
    ]


def _ratio_record(scenes: int = 6) -> Record:
    errors = []
    y, x = np.mgrid[:480, :640]
    smooth = np.exp(2.2 * np.sin(x / 60) * np.cos(y / 45) + 0.8 * np.sin((x + 2 * y) / 17))
    radiance = 240 * smooth * np.where((x // 37 + y // 29) % 2, 1.0, 0.4)
    for seed in range(scenes):
        random = np.random.default_rng(seed)
        wrong = (_WRONG_BY, _WRONG_BY[::-1])[seed % 2]
        true = np.array(_TIMES_S) * [*wrong, 1.0]
        found = estimate_exposures(
            [_expose(radiance, t, random) for t in true],
            list(_TIMES_S),
            noise=_NOISE,
            black_level=_BLACK,
            saturation_level=_CEILING,
        )
        errors.append(float(np.abs(found.exposures_s / true - 1).max()))
    return Record(
        name="hdr.exposure_ratio_error",
        value=max(errors),
        unit="",
        bound=0.005,
        sense=Sense.AT_MOST,
        runs=scenes,
        note="metadata wrong by 15 % either way",
    )


@dataclass(frozen=True)
class _Recorded:
    """What one recording took."""

    frames: int
    seconds: float
    cpu_seconds: float
    peak_mb: float
    file_mb: float


def _recording_records() -> list[Record]:
    with TemporaryDirectory() as folder:
        _in_a_process(_record_oil_scan, Path(folder) / "scan")
        runs = [_in_a_process(_record_again, Path(folder) / "scan") for _ in range(_RUNS)]
        metered = _in_a_process(_record_again, Path(folder) / "scan", Metering())
    best = min(runs, key=lambda run: run.seconds)
    spread = ", ".join(f"{run.frames / run.seconds:.1f}" for run in runs)
    return [
        Record(
            name="record.frames_per_s",
            value=best.frames / best.seconds,
            unit="1/s",
            bound=10.0,
            sense=Sense.AT_LEAST,
            runs=_RUNS,
            note=f"best of {spread}; {1000 * best.cpu_seconds / best.frames:.0f} ms of processor "
            f"and {best.file_mb / best.frames:.1f} MB on disk for each of {best.frames} frames",
        ),
        Record(
            name="record.peak_mb",
            value=max(run.peak_mb for run in runs),
            unit="MB",
            bound=1000.0,
            sense=Sense.AT_MOST,
            runs=_RUNS,
            note="of the whole process that records",
        ),
        Record(
            name="record.metered_peak_mb",
            value=metered.peak_mb,
            unit="MB",
            bound=1000.0,
            sense=Sense.AT_MOST,
            note=f"the same of a metered scan, of {metered.frames} of {best.frames} frames",
        ),
    ]


def _in_a_process(job: Any, *arguments: Any) -> Any:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as processes:
        return processes.submit(job, *arguments).result()


def _record_oil_scan(out: Path) -> None:
    """The scan that is recorded again, both axes at three exposures, and its raw samples."""
    rig = SimulationSettings(painting=PaintingKind.OIL).build().open()
    plan = plan_scan(rig, exposure_s=_EXPOSURES_S)
    with SessionWriter.create(out, plan) as writer:
        scan(writer, rig)
    session = Session.open(out)
    for frame in session.frames:
        np.save(_raw_file(out, frame.id), session.read_frame(frame.id))


def _raw_file(session: Path, frame_id: str) -> Path:
    return session.parent / f"{frame_id}.npy"


def _record_again(source: Path, metering: Metering | None = None) -> _Recorded:
    session = Session.open(source)
    recording = replace(
        recording_of(session), load=lambda frame: np.load(_raw_file(source, frame.id))
    )
    plan = session.plan.model_copy(update={"metering": metering})
    with TemporaryDirectory(dir=source.parent) as folder:
        out = Path(folder) / "again"
        wall, cpu = time.perf_counter(), time.process_time()
        _record(out, plan, replay_rig(recording))
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        again = Session.open(out)
        if metering is None and again.digest != session.digest:
            raise SessionError(f"{out} came out otherwise than {source}: its time means nothing")
        size = sum(file.stat().st_size for file in (out / "frames").iterdir())
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return _Recorded(len(again.recorded), wall, cpu, peak_mb, size / 1e6)


def _record(out: Path, plan: Plan, rig: Rig) -> None:
    with SessionWriter.create(out, plan) as writer:
        record_plan(writer, rig)
