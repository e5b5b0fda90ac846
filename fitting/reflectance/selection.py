"""Which lobe, which misfit and how strong a prior a material gets: whatever predicts best.

Every candidate is fitted to some of the samples of each texel and judged by the others, so that
nothing is chosen for fitting its own data well. Only the few numbers of a prior are learned from
the samples of all folds together. The error is that of photographs each exposed for what it shows:
relative to the radiance that only a thousandth of a photograph's texels exceed, and clipped there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fitting.reflectance.lobe import LafortuneLobes, LobeVariant
from fitting.reflectance.materials import Material
from fitting.reflectance.misfit import MISFIT_SHAPES, MisfitShape, has_misfit, with_misfit
from fitting.reflectance.priors import (
    learn_prior,
    with_varying_highlight,
    with_varying_lobe,
)
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.solver import SolverOptions, fit_texels

Floats = NDArray[np.float64]

FOLDS = 4
_WHITE_PERCENTILE = 99.9
_DIMMEST = 0.01  # white of a photograph, at least: so much of the brightest one's
# What is more complex must predict better by this many standard errors of the difference: one in
# twenty that do not does so by chance.
_SIGNIFICANT = 1.645
_BATCHES = 20


@dataclass(frozen=True)
class Candidate:
    """A material as one choice among others.

    Attributes
    ----------
    material : Material
    errors : (n, m) array
        Held-out squared errors, see :func:`held_out_errors`.
    """

    material: Material
    errors: Floats

    def beats(self, other: Candidate) -> bool:
        """Whether it predicts better by more than chance would have it."""
        return predicts_better(self.errors, other.errors)


def predicts_better(errors: Floats, other: Floats) -> bool:
    """Whether held-out errors (n, m) are smaller by more than chance would have it.

    Chance is in which texels there are, and in which photographs: other lamps may show otherwise.
    Texels that lie together err alike, so that the scatter is that of batches of consecutive ones.
    """
    gain = other - errors
    batches = np.array_split(gain.sum(axis=1), min(_BATCHES, max(len(gain), 1)))
    by_batch = np.array([batch.sum() for batch in batches])
    return all(_stands_out(parts) for parts in (by_batch, gain.sum(axis=0)))


def _stands_out(parts: Floats) -> bool:
    """Whether the sum is above zero by more than its parts' scatter explains."""
    scatter = np.sqrt(len(parts)) * float(parts.std(ddof=1)) if len(parts) > 1 else 0.0
    return float(parts.sum()) > _SIGNIFICANT * scatter


def held_out_errors(
    samples: RadianceSamples, fit: Callable[[RadianceSamples], LafortuneLobes]
) -> Floats:
    """Squared errors, mean over the channels, of samples that the texel's fit did not see.

    Parameters
    ----------
    samples : RadianceSamples
        Those of each texel are dealt out in turn to :data:`FOLDS` folds.
    fit : callable
        Lobes of all texels from the samples that it is given.

    Returns
    -------
    (n, m) array
        Relative to :func:`white_levels`, where radiance is clipped; zero for what is not valid.
    """
    valid = samples.valid
    white = white_levels(samples)[:, np.newaxis]
    errors = np.zeros(valid.shape)
    fold = np.arange(samples.weight.shape[1]) % FOLDS
    for f in range(FOLDS):
        out = fold == f
        predicted = fit(samples.masked(~out)).radiance(samples.view[:, out], samples.light[:, out])
        off = np.minimum(predicted / white[out], 1.0)
        off -= np.minimum(samples.radiance[:, out] / white[out], 1.0)
        errors[:, out] = np.where(valid[:, out], np.mean(off**2, axis=2), 0.0)
    return errors


def white_levels(samples: RadianceSamples) -> Floats:
    """Radiance of each photograph that all but a thousandth of its valid samples stay below, (m,).

    Photographs that show next to nothing count as a hundredth as bright as the brightest.
    """
    levels = np.zeros(samples.weight.shape[1])
    for photograph, valid in enumerate(samples.valid.T):
        if valid.any():
            seen = samples.radiance[valid, photograph]
            levels[photograph] = np.percentile(seen, _WHITE_PERCENTILE)
    brightest = float(levels.max(initial=0.0))
    return np.maximum(levels, _DIMMEST * brightest if brightest > 0.0 else 1.0)


def choose_material(samples: RadianceSamples, *, options: SolverOptions) -> Material | None:
    """The prior that predicts the texels of a material best.

    Parameters
    ----------
    samples : RadianceSamples
        Of a few hundred texels that are of one material.
    options : SolverOptions

    Returns
    -------
    Material or None
        None where too few texels show a highlight.
    """
    misfits = list(_with_misfits(samples, options))
    least = _least(iter(misfits))
    if least is None:
        return None
    # Of misfits that predict alike the smallest: it leaves the most to be said by the samples.
    best = next(one for one in misfits if not least.beats(one))
    for variant in (LobeVariant.FREE, LobeVariant.ANISOTROPIC):
        other = learn_prior(samples, replace(best.material, variant=variant), options=options)
        if other is not None and (judged := _judge(samples, other, options)).beats(best):
            best = judged
    varying = _judge(samples, with_varying_lobe(best.material, samples, options=options), options)
    freed = with_varying_highlight(best.material, samples, options=options)
    if (judged := _judge(samples, freed, options)).beats(varying):
        varying = judged
    others = [
        best,
        *(_judge(samples, m, options) for m in _tighter(best.material, varying.material)),
    ]
    strongest = _least(iter(others))
    assert strongest is not None  # the list is not empty
    return strongest.material if strongest.beats(varying) else varying.material


def _judge(samples: RadianceSamples, material: Material, options: SolverOptions) -> Candidate:
    def fit(seen: RadianceSamples) -> LafortuneLobes:
        return fit_texels(seen, [material], options=options).lobes

    return Candidate(material, held_out_errors(samples, fit))


def _with_misfits(samples: RadianceSamples, options: SolverOptions) -> Iterator[Candidate]:
    plain = Material(variant=LobeVariant.ANISOTROPIC)
    shapes = MISFIT_SHAPES if has_misfit(samples, plain, options=options) else (MisfitShape(0, 0),)
    for shape in shapes:
        material = with_misfit(samples, Material(variant=LobeVariant.MIRROR), shape)
        learned = learn_prior(samples, material, options=options)
        if learned is not None:
            yield _judge(samples, learned, options)


def _tighter(narrow: Material, varying: Material) -> Iterator[Material]:
    """Priors between the shared lobe for all texels and all that single texels show."""
    assert varying.shape_covariance is not None  # learned materials have both
    assert varying.specular_sd is not None
    for centre in (narrow.shape_mean, varying.shape_mean):
        for shape, strength in ((0.5, 1.0), (0.5, 0.5), (0.25, 0.25)):
            yield replace(
                varying,
                shape_mean=centre,
                shape_covariance=shape**2 * varying.shape_covariance,
                specular_sd=strength * varying.specular_sd,
            )


def _least(candidates: Iterator[Candidate]) -> Candidate | None:
    return min(candidates, key=lambda c: float(c.errors.sum()), default=None)
