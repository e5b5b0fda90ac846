"""Parameters, error bars and flags against lobes that are known."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.lobe import LafortuneLobes
from fitting.reflectance.selection import choose_material
from fitting.reflectance.solver import DEFAULT_OPTIONS, TexelFits, fit_texels
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.lafortune_samples import (
    NARROW_MATERIAL,
    make_lobes,
    narrow_highlights,
    observe,
    reached,
    smooth_paint,
)

Floats = NDArray[np.float64]

_PARAMETERS = ("ln k", "ln r", "ln c", *(f"ρ_{part} {c}" for part in "ds" for c in "RGB"))
_KNOWN_HEIGHT = 0.1
_WINDOW = 5


def z_scores(fits: TexelFits, truth: LafortuneLobes) -> Floats:
    """Errors of all nine parameters over the errors predicted, (n, 9)."""
    found = np.hstack([fits.lobes.shape, fits.lobes.diffuse, fits.lobes.specular])
    true = np.hstack([truth.shape, truth.diffuse, truth.specular])
    return np.asarray((found - true) / fits.standard_errors)


def observed(fits: TexelFits) -> NDArray[np.bool_]:
    """Texels whose highlight's height is known to a tenth; beyond, its error is not Gaussian."""
    height = np.maximum(fits.lobes.specular, 1e-9)
    known = (fits.standard_errors[:, 6:] < _KNOWN_HEIGHT * height).all(axis=1)
    return np.asarray(fits.has_highlight & known)


def local_roughness(fits: TexelFits, truth: LafortuneLobes) -> Floats:
    """Deviation of ln k within 5 × 5 texels over the one predicted, of a square of texels.

    What the truth itself changes by is taken out.
    """
    side = round(len(truth.shape) ** 0.5)
    window = (_WINDOW, _WINDOW)
    off = (fits.lobes.shape[:, 0] - truth.shape[:, 0]).reshape(side, side)
    local = np.lib.stride_tricks.sliding_window_view(off, window).std(axis=(2, 3), ddof=1)
    variance = fits.covariance[:, 0, 0].reshape(side, side)
    expected = np.lib.stride_tricks.sliding_window_view(variance, window).mean(axis=(2, 3))
    return np.asarray(local / np.sqrt(expected))


def unobserved_under_given(texels: int, *, seed: int) -> float:
    """Share flagged of texels whose highlight is out of sight, their material being known."""
    truth, samples = narrow_highlights(texels, seed=seed)
    fits = fit_texels(samples.masked(~reached(truth, samples)), [NARROW_MATERIAL])
    return float(fits.flagged(TexelFlag.UNOBSERVED).mean())


def unobserved_under_learned(texels: int, *, seed: int) -> float:
    """The same of every fifth texel, under a material learned from all of them."""
    truth, samples = narrow_highlights(texels, seed=seed)
    hidden = np.arange(texels) % 5 == 0
    partly = samples.masked(~(hidden[:, np.newaxis] & reached(truth, samples)))
    material = choose_material(partly, options=DEFAULT_OPTIONS)
    if material is None:
        return 0.0
    fits = fit_texels(partly, [material])
    return float(fits.flagged(TexelFlag.UNOBSERVED)[hidden].mean())


def bench_lafortune(*, texels: int = 4000) -> Iterator[Record]:
    """Records of error bars, of what no sample shows, and of smoothness."""
    yield _spread(texels)
    given = unobserved_under_given(texels // 2, seed=3)
    learned = unobserved_under_learned(max(texels // 25, 60), seed=3)
    yield Record(
        name="lafortune.unobserved_flagged",
        value=min(given, learned),
        unit="",
        bound=0.95,
        sense=Sense.AT_LEAST,
        runs=texels // 2,
        note=f"of texels whose highlight no sample shows: {given:.3f} under a material that is "
        f"given, {learned:.3f} under one that is learned",
    )
    truth, samples = smooth_paint(seed=6)
    rough = local_roughness(fit_texels(samples), truth)
    yield Record(
        name="lafortune.roughness_over_predicted",
        value=float(rough.max()),
        unit="",
        bound=1.5,
        sense=Sense.AT_MOST,
        runs=rough.size,
        note="deviation of ln k within 5 × 5 texels of smooth paint, the largest; median "
        f"{np.median(rough):.2f}, 99th percentile {np.percentile(rough, 99):.2f}",
    )


def _spread(texels: int) -> Record:
    truth = make_lobes(texels, np.random.default_rng(0))
    fits = fit_texels(observe(truth, 96, 0))
    seen = observed(fits)
    free = [p for p in range(len(_PARAMETERS)) if _PARAMETERS[p] != "ln c"]
    z = z_scores(fits, truth)[seen][:, free]
    spread = z.std(axis=0)
    worst = int(np.argmax(np.abs(spread - 1.0)))
    return Record(
        name="lafortune.z_spread",
        value=float(spread[worst]),
        unit="",
        bound=(0.9, 1.1),
        sense=Sense.WITHIN,
        runs=int(seen.sum()),
        note=f"of {_PARAMETERS[free[worst]]}, the farthest from 1 of {len(free)} parameters "
        f"({spread.min():.3f} to {spread.max():.3f}; mean z {z.mean(axis=0).min():.2f} to "
        f"{z.mean(axis=0).max():.2f}) where ρ_s is known to a tenth, {100 * seen.mean():.0f} % "
        "of texels",
    )
