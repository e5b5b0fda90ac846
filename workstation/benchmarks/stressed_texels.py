"""Texels whose samples say little or lie: what the solver must come through with finite results."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from enum import StrEnum
from itertools import product

import numpy as np
from numpy.typing import NDArray

from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.lobe import LafortuneLobes
from fitting.reflectance.materials import Material
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.solver import SolverOptions, TexelFits, fit_texels
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.lafortune_samples import KNOWN_MATERIAL, make_lobes, observe

Floats = NDArray[np.float64]

_TEXELS = 60
_SAMPLES = 48
_SEED = 11
_BAD_VIEW, _BAD_VARIANCE = 5, 6  # texels without a valid sample, of NaNs
_OUTLIERS = 0.1  # share of samples


class Stress(StrEnum):
    """What samples are put through."""

    ONE_LIGHT = "one light"
    TWO_LIGHTS = "two lights"
    LIGHTS_IN_A_LINE = "lights in a line"
    DARK = "all samples dark"
    NEGATIVE = "all samples below zero"
    ONE_CHANNEL_ZERO = "one channel zero"
    OUTLIERS = "outliers at 10 %"
    HUGE = "one sample of 10³⁰"
    UNDEREXPOSED = "exposure × 10⁻⁶"
    OVEREXPOSED = "exposure × 10⁶"
    BROADEST = "k = 1"
    NARROWEST = "k = 1500"
    DUPLICATED = "every sample twice"
    ONE_SAMPLE_REPEATED = "one sample only, repeated"
    NANS = "NaNs"
    NO_SAMPLES = "no samples"


_SCALES = {Stress.UNDEREXPOSED: 1e-6, Stress.OVEREXPOSED: 1e6}
_EXPONENTS = {Stress.BROADEST: 1.0, Stress.NARROWEST: 1500.0}


def true_lobes(kind: Stress) -> LafortuneLobes:
    """The lobes behind the samples of :func:`stressed`."""
    rng = np.random.default_rng(_SEED)
    if kind not in _EXPONENTS:
        return make_lobes(_TEXELS, rng)
    ln_k = float(np.log(_EXPONENTS[kind]))
    return make_lobes(_TEXELS, rng, ln_k=(ln_k, 0.0), ln_r=(0.0, 0.0), specular=(0.5, 2.0))


def stressed(kind: Stress) -> RadianceSamples:
    """Samples of sixty texels."""
    samples = observe(true_lobes(kind), _SAMPLES, _SEED)
    if kind in _SCALES:
        return scaled(samples, _SCALES[kind])
    arrays = {
        name: getattr(samples, name).copy()
        for name in ("view", "light", "radiance", "variance", "weight")
    }
    if kind in _SPOILING:
        _SPOILING[kind](arrays)
    return RadianceSamples(**arrays)


def scaled(samples: RadianceSamples, scale: float) -> RadianceSamples:
    """The samples of photographs exposed otherwise."""
    variance = samples.variance.astype(np.float64) * scale**2
    return replace(
        samples,
        radiance=(samples.radiance * scale).astype(np.float32),
        variance=variance.astype(np.float32),
    )


_Arrays = dict[str, NDArray[np.float32]]


def _light_in_a_line(arrays: _Arrays) -> None:
    angle = np.linspace(-1, 1, _SAMPLES)
    arrays["light"][:] = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    arrays["view"][:] = [0, 0, 1]


def _add_outliers(arrays: _Arrays) -> None:
    rng = np.random.default_rng(_SEED)
    wrong = rng.random((_TEXELS, _SAMPLES)) < _OUTLIERS
    arrays["radiance"][wrong] = rng.uniform(0, 1, (int(wrong.sum()), 3))


def _add_nans(arrays: _Arrays) -> None:
    arrays["radiance"][:, ::2] = np.nan
    arrays["view"][_BAD_VIEW] = np.inf
    arrays["variance"][_BAD_VARIANCE] = -1


def _set(name: str, *where: slice | int, value: float = 0.0) -> Callable[[_Arrays], None]:
    def change(arrays: _Arrays) -> None:
        arrays[name][where] = value

    return change


def _repeat(number: int) -> Callable[[_Arrays], None]:
    def change(arrays: _Arrays) -> None:
        for array in arrays.values():
            array[:] = array[:, np.arange(_SAMPLES) % number]

    return change


def _negate(arrays: _Arrays) -> None:
    arrays["radiance"][:] = -np.abs(arrays["radiance"])


_SPOILING: dict[Stress, Callable[[_Arrays], None]] = {
    Stress.ONE_LIGHT: _set("weight", slice(None), slice(1, None)),
    Stress.TWO_LIGHTS: _set("weight", slice(None), slice(2, None)),
    Stress.LIGHTS_IN_A_LINE: _light_in_a_line,
    Stress.DARK: _set("radiance", slice(None)),
    Stress.NEGATIVE: _negate,
    Stress.ONE_CHANNEL_ZERO: _set("radiance", slice(None), slice(None), 1),
    Stress.OUTLIERS: _add_outliers,
    Stress.HUGE: _set("radiance", slice(None), 3, value=1e30),
    Stress.DUPLICATED: _repeat(_SAMPLES // 2),
    Stress.ONE_SAMPLE_REPEATED: _repeat(1),
    Stress.NANS: _add_nans,
    Stress.NO_SAMPLES: _set("weight", slice(None)),
}


def failures(kind: Stress) -> list[str]:
    """What is wrong with the fits, with and without a prior, diffuse texels skipped or not."""
    samples = stressed(kind)
    wrong = [f"{kind}: {what}" for what in _unlike(kind, fit_texels(samples))]
    for material, skip in product((Material(), KNOWN_MATERIAL), (True, False)):
        fits = fit_texels(samples, [material], options=SolverOptions(skip_diffuse=skip))
        known = "a known material" if material is KNOWN_MATERIAL else "no material known"
        wrong += [
            f"{kind}, {known}, diffuse {'skipped' if skip else 'fitted'}: {what}"
            for what in _unsound(fits)
        ]
    return wrong


def _unsound(fits: TexelFits) -> Iterator[str]:
    """What no fit may be, whatever the samples."""
    lobes = fits.lobes
    for name, array in (
        ("shape", lobes.shape),
        ("ρ_d", lobes.diffuse),
        ("ρ_s", lobes.specular),
        ("covariance", fits.covariance),
        ("cost", fits.cost),
        ("standard errors", fits.standard_errors),
    ):
        if not np.isfinite(array).all():
            yield f"{name} is not finite"
    if min(lobes.diffuse.min(), lobes.specular.min()) < 0.0:
        yield "reflectance is negative"
    if np.diagonal(fits.covariance, axis1=1, axis2=2).min() < 0.0:
        yield "a variance is negative"


def _unlike(kind: Stress, fits: TexelFits) -> Iterator[str]:
    """What flags and values, under no prior, leave unsaid of this kind of samples."""
    truth = true_lobes(kind)
    if kind in (Stress.DARK, Stress.NEGATIVE):
        if not fits.flagged(TexelFlag.DARK).all():
            yield "dark texels are not flagged"
    elif kind is Stress.NANS:
        none = fits.flagged(TexelFlag.NO_SAMPLES)
        if not (
            fits.flagged(TexelFlag.SAMPLES_DROPPED).all() and none[[_BAD_VIEW, _BAD_VARIANCE]].all()
        ):
            yield "samples dropped are not flagged"
    elif kind is Stress.NO_SAMPLES:
        if not fits.flagged(TexelFlag.NO_SAMPLES).all():
            yield "texels without samples are not flagged"
    elif kind is Stress.ONE_CHANNEL_ZERO:
        if fits.lobes.diffuse[:, 1].any():
            yield "a channel without light has ρ_d"
    elif kind is Stress.OUTLIERS:
        off = np.median(np.abs(fits.lobes.diffuse - truth.diffuse))
        if off > 0.01:
            yield f"ρ_d is off by {off:.3f}"
    elif kind in _SCALES:
        off = np.median(np.abs(fits.lobes.diffuse / _SCALES[kind] / truth.diffuse - 1.0))
        if off > 0.02:
            yield f"ρ_d does not scale with the exposure: off by {100 * off:.1f} %"
    elif kind in _EXPONENTS:
        sure = fits.has_highlight & (fits.standard_errors[:, 0] < 0.1)
        off_k = (fits.lobes.shape[sure, 0] - truth.shape[sure, 0]) / fits.standard_errors[sure, 0]
        if sure.any() and np.median(np.abs(off_k)) > 1.5:
            yield "ln k is off by more than it says"


def bench_stress() -> Record:
    """How many of the kinds the solver comes through."""
    wrong = {kind: failures(kind) for kind in Stress}
    passed = sum(not what for what in wrong.values())
    return Record(
        name="solver.stress_passed",
        value=passed,
        unit="",
        bound=len(Stress),
        sense=Sense.AT_LEAST,
        runs=4 * len(Stress),
        note="; ".join(what for whats in wrong.values() for what in whats)
        or f"{', '.join(Stress)}: finite, flagged, nothing negative, with a prior and without",
    )
