"""Lobes against measured paint, a measured ball, NLopt, known lobes, and the clock."""

from __future__ import annotations

import math
import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from pathlib import Path

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from fitting.reflectance.clusters import fit_reflectance
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.materials import Material
from fitting.reflectance.nlopt_oracle import TexelProblem, minimise_slsqp, random_starts
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.solver import DEFAULT_OPTIONS, SolverOptions, fit_texels
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.lafortune_truth import bench_lafortune
from workstation.benchmarks.measured_reflectance import (
    LEAST_SQUARES,
    continued,
    descended,
    hemispherical_basis,
    polynomial_basis,
    random_shapes,
    read_ball,
    read_goniometer,
    relative_rms,
)
from workstation.benchmarks.paint_samples import glossy_finishes, paint_samples
from workstation.benchmarks.stressed_texels import bench_stress

Floats = NDArray[np.float64]

SAMPLES = 96
CORES = 2
ORACLE_STARTS = 20
_CLOSE = 1.005
_RANDOM_STARTS = 50
_TIMED_NLOPT = 40
# The figures of one lobe in the measured data's own notes.
_CORNELL_BOUNDS = {"garnet_red": 0.249, "krylon_blue": 0.265}


def bench(
    *,
    oracle_texels: int = 2000,
    timed_texels: int = 20000,
    truth_texels: int = 4000,
    painting_width: int | None = 160,
    pictures: Path | None = None,
) -> list[Record]:
    """Lobes against measured paint, NLopt, known lobes, a simulated painting, and the clock.

    Parameters
    ----------
    oracle_texels : int
        Texels held against NLopt: half of them with a highlight, half without.
    timed_texels : int
        Texels of the timed batch.
    truth_texels : int
        Texels whose lobes are known, that parameters and flags are held against.
    painting_width : int or None
        Pixels of the simulated painting's photographs; None leaves the painting out.
    pictures : Path, optional
        Folder for photographs beside renderings, and for run time against error.
    """
    records = []
    data = os.environ.get("IMPASTO_REAL_DATA")
    if data:
        records += [
            *_cornell(Path(data) / "cornell_paint_brdf"),
            *_ball(Path(data) / "diligent_ball"),
        ]
    ball = Path(data) / "diligent_ball" if data else None
    records += [_oracle(oracle_texels, ball), *_speed(timed_texels)]
    records += [*bench_lafortune(texels=truth_texels), bench_stress()]
    if painting_width is not None:
        from workstation.benchmarks.painted_reflectance import bench_painting

        records += bench_painting(width=painting_width, pictures=pictures)
    return records


def _cornell(folder: Path) -> Iterator[Record]:
    shapes = random_shapes(_RANDOM_STARTS, seed=0)
    for paint, known in _CORNELL_BOUNDS.items():
        samples = read_goniometer(folder / f"{paint}.brdf")
        usual = relative_rms(fit_texels(samples, options=LEAST_SQUARES).lobes, samples)
        errors = [relative_rms(lobe, samples) for lobe in continued(samples, shapes)]
        plain = [relative_rms(lobe, samples) for lobe in descended(samples, shapes)]
        yield Record(
            name=f"cornell.{paint}",
            value=max(usual, *errors),
            unit="",
            bound=1.01 * known,
            sense=Sense.AT_MOST,
            runs=_RANDOM_STARTS,
            note=f"relative RMS; the solver with its own starts {usual:.4f}, worst of random "
            f"(k, r) with continuation in k and no search of starts {max(errors):.4f}",
        )
        yield Record(
            name=f"cornell.{paint}_descents",
            value=float(np.mean(np.array(plain) <= 1.01 * known)),
            unit="",
            bound=0.9,
            sense=Sense.AT_LEAST,
            runs=_RANDOM_STARTS,
            note="share of random (k, r) from which one descent, without continuation or search, "
            f"keeps that bound; worst {max(plain):.3f}",
        )


def _ball(folder: Path) -> Iterator[Record]:
    ball = read_ball(folder)
    fits, palette = fit_reflectance(ball.training)
    lobe = palette.materials[0]
    seen = float(fits.has_highlight.mean())
    note = (
        f"{len(palette.materials)} materials, k near {math.exp(lobe.shape_mean[0]):.0f}, "
        f"highlight seen on {100 * seen:.0f} % of pixels"
    )
    yield _psnr("ball.psnr_db", ball.relight_psnr_db(fits.lobes), 36.4, note)
    yield _psnr("ball.ptm_db", ball.basis_psnr_db(polynomial_basis(ball.light)), 29.8, "baseline")
    yield _psnr(
        "ball.hsh_db", ball.basis_psnr_db(hemispherical_basis(ball.light)), 29.5, "baseline"
    )


def _psnr(name: str, value: float, bound: float, note: str) -> Record:
    return Record(
        name=name, value=value, unit="dB", bound=bound, sense=Sense.AT_LEAST, runs=12, note=note
    )


def _oracle(texels: int, ball: Path | None) -> Record:
    half = texels // 2
    shining = [_glossy(half, seed=1)]
    if ball is not None:
        training = read_ball(ball).training
        bright = fit_texels(training, options=SolverOptions(starts=1)).has_highlight
        chosen = np.random.default_rng(3).permutation(np.flatnonzero(bright))[: half // 5]
        shining = [_glossy(half - len(chosen), seed=1), training.take(chosen)]
    with_highlight = np.concatenate([cost_over_oracle(samples) for samples in shining])
    without = cost_over_oracle(paint_samples(None, texels - half, SAMPLES - 6, seed=2))
    shares = [float(np.mean(ratio <= _CLOSE)) for ratio in (with_highlight, without)]
    worst = max(with_highlight.max(), without.max())
    return Record(
        name="oracle.share_within",
        value=min(shares),
        unit="",
        bound=0.99,
        sense=Sense.AT_LEAST,
        runs=texels,
        note=(
            f"cost within 0.5 % of the best of {ORACLE_STARTS} NLopt starts: {shares[0]:.4f} with "
            f"a highlight, {shares[1]:.4f} without; worst ratio {worst:.3f}"
        ),
    )


def cost_over_oracle(
    samples: RadianceSamples, *, options: SolverOptions = DEFAULT_OPTIONS
) -> Floats:
    """Cost of the fast solver over the least of NLopt's, per texel; every texel gets a lobe."""
    thorough = SolverOptions(
        starts=options.starts, huber_limit=options.huber_limit, skip_diffuse=False
    )
    fast = fit_texels(samples, options=thorough).cost
    alone = [samples.take([texel]) for texel in range(samples.texels)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=CORES, mp_context=context) as pool:
        limits = repeat(thorough.huber_limit)
        slow = list(pool.map(_least_cost, alone, range(len(alone)), limits, chunksize=16))
    return fast / np.array(slow)


def _least_cost(samples: RadianceSamples, seed: int, huber_limit: float) -> float:
    problem = TexelProblem.of(samples, 0, Material(), huber_limit)
    starts = random_starts(problem, ORACLE_STARTS, seed)
    return min(minimise_slsqp(problem, start)[0] for start in starts)


def _speed(texels: int) -> Iterator[Record]:
    samples = _glossy(texels, seed=4)
    few = samples.take(np.arange(texels // 10))
    fit_texels(few)  # compiled, and in the cache
    times = [_seconds(samples) for _ in range(3)]
    seconds, wall = (min(one) / texels for one in zip(*times, strict=True))
    seconds_few = min(_seconds(few)[0] for _ in range(10)) / few.texels
    rate = CORES / seconds
    nlopt = _nlopt_seconds(samples)
    yield Record(
        name="solver.texels_per_s",
        value=rate,
        unit="1/s",
        bound=40000.0,
        sense=Sense.AT_LEAST,
        runs=3,
        note=f"glossy, {SAMPLES} RGB samples, all starts and error bars; {CORES} over the "
        f"processor time of all threads, {1e6 * seconds:.1f} µs a texel, which is what {CORES} "
        f"cores do that nothing delays; by the clock, {get_num_threads()} threads of this machine "
        f"as it was did {1.0 / wall:.0f}",
    )
    yield Record(
        name="solver.speed_over_nlopt",
        value=rate * nlopt,
        unit="",
        bound=250.0,
        sense=Sense.AT_LEAST,
        runs=_TIMED_NLOPT,
        note=f"the rate above, of {CORES} cores, against one SLSQP descent with analytic gradients "
        f"on one core, {1e3 * nlopt:.2f} ms of processor time; core for core half of it",
    )
    yield Record(
        name="solver.time_growth",
        value=seconds / seconds_few,
        unit="",
        bound=1.25,
        sense=Sense.AT_MOST,
        runs=3,
        note=f"processor time per texel of {texels} texels over that of {few.texels}",
    )


def _glossy(texels: int, *, seed: int) -> RadianceSamples:
    finishes = glossy_finishes(texels, np.random.default_rng(seed))
    return paint_samples(finishes, texels, SAMPLES, seed=seed)


def _seconds(samples: RadianceSamples) -> tuple[float, float]:
    """Of all threads on the processor, and by the clock."""
    before, began = time.process_time(), time.perf_counter()
    fits = fit_texels(samples)
    spent, passed = time.process_time() - before, time.perf_counter() - began
    assert not fits.flagged(TexelFlag.NOT_FINITE).any()
    return spent, passed


def _nlopt_seconds(samples: RadianceSamples) -> float:
    """Median processor time of one texel from one start, everything but the samples included."""
    times = []
    for texel in range(_TIMED_NLOPT):
        before = time.process_time()
        problem = TexelProblem.of(samples, texel, Material(), DEFAULT_OPTIONS.huber_limit)
        minimise_slsqp(problem, problem.start(Material().shape_mean), tolerance=1e-6)
        times.append(time.process_time() - before)
    return float(np.median(times))
