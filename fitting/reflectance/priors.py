"""Priors learned from the texels of one material (empirical Bayes).

The lobes of single texels scatter by their own errors and by how much the material varies. Taking
the former, which the solver predicts, out of the scatter leaves the latter: expectation
maximisation for a Gaussian population seen through Gaussian errors that differ from texel to texel.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import MEDIAN_TO_SIGMA, robust_sigma
from fitting.reflectance.materials import Material
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.shared_lobe import PooledProblem, fit_pooled
from fitting.reflectance.solver import SolverOptions, fit_texels

Floats = NDArray[np.float64]

_WEAK_SD = np.array([1.2, 0.3, 0.3])
_SMALLEST_SD = np.array([0.05, 0.01, 0.02])
_SMALLEST_SPECULAR_SD = 0.05  # of the mean
_KNOWN_HEIGHT = 0.3  # relative error of ρ_s up to which it counts as known
_ITERATIONS = 30
_FEWEST_TEXELS = 12


def gaussian_population(
    estimates: Floats, covariances: Floats, smallest_sd: Floats
) -> tuple[Floats, Floats]:
    """Mean and covariance of a population from noisy estimates of its members.

    Parameters
    ----------
    estimates : (n, p) array
    covariances : (n, p, p) array
        Error of each estimate.
    smallest_sd : (p,) array
        Floor of the population's standard deviations.

    Returns
    -------
    mean : (p,) array
    covariance : (p, p) array
    """
    p = estimates.shape[1]
    floor = np.diag(smallest_sd**2)
    mean = np.median(estimates, axis=0)
    spread = robust_sigma(estimates - mean, axis=0)
    covariance = np.diag(np.maximum(spread, smallest_sd) ** 2)
    for _ in range(_ITERATIONS):
        gain = covariance @ np.linalg.inv(covariance + covariances)
        off = estimates - mean
        # A few texels of another material must not widen the population.
        distance = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance + covariances), off)
        weight = np.where(distance < 9.0 + 3.0 * p, 1.0, 0.0)
        if weight.sum() < p + 1:
            break
        posterior = mean + np.einsum("nij,nj->ni", gain, off)
        left: Floats = covariance - gain @ covariance
        mean = np.average(posterior, axis=0, weights=weight)
        off = posterior - mean
        outer = np.einsum("ni,nj->nij", off, off) + left
        covariance = np.average(outer, axis=0, weights=weight)
        covariance = 0.5 * (covariance + covariance.T)
        values, vectors = np.linalg.eigh(covariance - floor)
        covariance = floor + (vectors * np.maximum(values, 0.0)) @ vectors.T
    return mean, covariance


def learn_prior(
    samples: RadianceSamples, material: Material, *, options: SolverOptions
) -> Material | None:
    """The lobe that a material's texels share, how it varies, and how bright their highlights are.

    Parameters
    ----------
    samples : RadianceSamples
        Of a few hundred texels.
    material : Material
        Its variant and misfit are kept.
    options : SolverOptions

    Returns
    -------
    Material or None
        None where too few texels show a highlight. The mean is the lobe that fits all texels
        together: single texels that saw only the skirt of a highlight say little of its peak.
    """
    problem = PooledProblem(
        samples,
        material.variant,
        misfit_floor=material.misfit_floor,
        misfit_relative=material.misfit_relative,
        huber_limit=options.huber_limit,
    )
    shape = fit_pooled(problem).shape
    narrow = replace(material, shape_mean=shape, shape_covariance=np.diag((2 * _SMALLEST_SD) ** 2))
    return with_specular_prior(narrow, samples, options=options)


def with_varying_lobe(
    material: Material, samples: RadianceSamples, *, options: SolverOptions
) -> Material:
    """The material with the mean and covariance of shape that its single texels show.

    Unchanged where too few texels show a highlight.
    """
    free = int(material.variant)
    weak = replace(material, shape_covariance=np.diag(_WEAK_SD**2))
    fits = fit_texels(samples, [weak], options=options)
    seen = fits.has_highlight
    if seen.sum() < _FEWEST_TEXELS:
        return material
    precision = weak.shape_precision[:free, :free]
    posterior = fits.covariance[seen][:, :free, :free]
    # What the weak prior added to each texel's information is taken out again.
    information = np.linalg.inv(posterior) - precision
    values, vectors = np.linalg.eigh(0.5 * (information + np.swapaxes(information, 1, 2)))
    values = np.maximum(values, 1e-3 / _WEAK_SD[:free] ** 2)
    errors = np.einsum("nij,nj,nkj->nik", vectors, 1.0 / values, vectors)
    off = fits.lobes.shape[seen, :free] - material.shape_mean[:free]
    alone = np.einsum("nij,njk,nk->ni", errors, np.linalg.inv(errors) + precision, off)
    mean, covariance = gaussian_population(
        material.shape_mean[:free] + alone, errors, _SMALLEST_SD[:free]
    )
    shape_mean = material.shape_mean.copy()
    shape_mean[:free] = mean
    whole = np.diag(_SMALLEST_SD**2)
    whole[:free, :free] = covariance
    return replace(material, shape_mean=shape_mean, shape_covariance=whole)


def with_varying_highlight(
    material: Material, samples: RadianceSamples, *, options: SolverOptions
) -> Material:
    """The material with what its texels show of shape and of ρ_s, both varying at once.

    Where the texels of a narrow lobe differ in r, ρ_s under the lobe that they share is off by the
    k-th power of that. Unchanged where too few texels show a highlight whose height is known.
    """
    varying = with_varying_lobe(replace(material, specular_sd=None), samples, options=options)
    fits = fit_texels(samples, [varying], options=options)
    values = fits.lobes.specular
    known = fits.has_highlight
    known &= fits.standard_errors[:, 6:].max(axis=1) < _KNOWN_HEIGHT * values.max(axis=1)
    if known.sum() < _FEWEST_TEXELS:
        return material
    mean = np.median(values[known], axis=0)
    spread = robust_sigma(values[known] - mean, axis=0)
    smallest = _SMALLEST_SPECULAR_SD * max(float(mean.max()), 1e-300)
    return replace(varying, specular_mean=mean, specular_sd=np.maximum(spread, smallest))


def with_specular_prior(
    material: Material, samples: RadianceSamples, *, options: SolverOptions
) -> Material | None:
    """The material with the mean and spread of ρ_s that its texels show under its own lobe.

    None where too few texels show a highlight.
    """
    held = replace(material, shape_covariance=np.diag((0.1 * _SMALLEST_SD) ** 2), specular_sd=None)
    fits = fit_texels(samples, [held], options=options)
    seen = fits.has_highlight
    if seen.sum() < _FEWEST_TEXELS:
        return None
    values = fits.lobes.specular[seen]
    # Texels that the highlight hardly reached say little of its height, however much they ask for.
    certainty = 1.0 / np.maximum(fits.standard_errors[seen, 6:].max(axis=1), 1e-300) ** 2
    mean = _weighted_median(values, certainty)
    spread = MEDIAN_TO_SIGMA * _weighted_median(np.abs(values - mean), certainty)
    own = np.sqrt(_weighted_median(fits.standard_errors[seen, 6:] ** 2, certainty))
    smallest = _SMALLEST_SPECULAR_SD * max(float(mean.max()), 1e-300)
    variation = np.sqrt(np.maximum(spread**2 - own**2, 0.0))
    return replace(material, specular_mean=mean, specular_sd=np.maximum(variation, smallest))


def _weighted_median(values: Floats, weight: Floats) -> Floats:
    """Median of each column (n, c) under weights (n,)."""
    order = np.argsort(values, axis=0)
    total = np.cumsum(weight[order], axis=0)
    middle = np.argmax(total >= 0.5 * total[-1], axis=0)
    columns = np.arange(values.shape[1])
    return values[order[middle, columns], columns]
