"""Materials found from the data: which texels are of one kind of paint.

A survey of some texels, fitted one by one under no prior, gives each a diffuse colour and, where a
highlight was seen, its width and strength. k-means on these, the number of clusters by Schwarz's
criterion, gives the materials; the solver's own cost under each material's lobe, and the distance
of the colour, decide for all other texels. A cluster keeps a prior of its own only if samples that
were held out are predicted better with it than without. No label, and no truth, is looked at.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FittingError
from fitting.reflectance.lobe import LafortuneLobes
from fitting.reflectance.materials import Material, material_table, shape_bounds
from fitting.reflectance.pooled_kernels import cost_under_materials
from fitting.reflectance.priors import learn_prior, with_varying_lobe
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.selection import choose_material, held_out_errors, predicts_better
from fitting.reflectance.solver import DEFAULT_OPTIONS, SolverOptions, TexelFits, fit_texels

Floats = NDArray[np.float64]

_RESTARTS = 6
_ROUNDS = 60
# A cluster's features scatter at least by this: a twentieth of the spread of all.
_SMALLEST_SCATTER = 0.05
_HUBER_COLOUR = 9.0  # squared distance of colours that counts no further


@dataclass(frozen=True, kw_only=True)
class ClusterOptions:
    """How materials are looked for.

    Attributes
    ----------
    most : int
        Largest number of materials.
    survey : int
        Texels surveyed.
    per_material : int
        Texels that a material's prior is learned from.
    fewest : int
        Surveyed texels without which a cluster is no material of its own.
    seed : int
    """

    most: int = 6
    survey: int = 3000
    per_material: int = 500
    fewest: int = 60
    seed: int = 0


@dataclass(frozen=True)
class Palette:
    """Materials of a painting, and the colours they come in.

    Attributes
    ----------
    materials : tuple of Material
        The first is that of all texels together.
    colour_mean, colour_sd : (c, 3) array
        Of the clusters: cube roots of ρ_d over ``colour_unit``.
    cluster_material : (c,) array of int
        Which material a cluster is of.
    colour_unit : float
        Median ρ_d of the survey, 1/sr.
    """

    materials: tuple[Material, ...]
    colour_mean: Floats
    colour_sd: Floats
    cluster_material: NDArray[np.int64]
    colour_unit: float


def find_materials(
    samples: RadianceSamples,
    *,
    cluster_options: ClusterOptions | None = None,
    options: SolverOptions = DEFAULT_OPTIONS,
) -> Palette:
    """Materials of a painting, from some of its texels.

    Parameters
    ----------
    samples : RadianceSamples
        Texels from all over the painting; a few thousand are enough.
    cluster_options : ClusterOptions, optional
    options : SolverOptions

    Returns
    -------
    Palette

    Raises
    ------
    FittingError
        No texel has a valid sample.
    """
    chosen = cluster_options or ClusterOptions()
    usable = np.flatnonzero(samples.valid.any(axis=1))
    if usable.size == 0:
        raise FittingError(
            f"none of {samples.texels} texels has a valid sample: are all of them occluded, or "
            "the normals turned inwards?"
        )
    rng = np.random.default_rng(chosen.seed)
    survey = samples.take(_drawn(usable, chosen.survey, rng))
    fits = fit_texels(survey, options=options)
    unit = max(float(np.median(fits.lobes.diffuse)), 1e-300)
    features, known = _features(fits, unit)
    few = survey.take(_drawn(np.arange(survey.texels), chosen.per_material, rng))
    everything = choose_material(few, options=options) or Material()
    labels = _cluster(features, known, chosen, rng)
    clusters = range(int(labels.max()) + 1)
    colours = [features[labels == label, :3] for label in clusters]
    palette = Palette(
        (everything,),
        np.array([colour.mean(axis=0) for colour in colours]),
        np.array([np.maximum(colour.std(axis=0), _SMALLEST_SCATTER) for colour in colours]),
        np.zeros(len(clusters), np.int64),
        unit,
    )
    if len(clusters) == 1:
        return palette
    errors = _palette_errors(survey, palette, options)
    for label in sorted(clusters, key=lambda label: -len(colours[label])):
        members = np.flatnonzero(labels == label)
        some = survey.take(_drawn(members, chosen.per_material, rng))
        # Most of the work is in choosing a prior well: one that is like that of all texels tells
        # whether it is worth while.
        plain = learn_prior(some, everything, options=options)
        if plain is None:
            continue
        plain = with_varying_lobe(plain, some, options=options)
        likely = _palette_errors(survey, _with_material(palette, label, plain), options)
        if likely.sum() >= errors.sum():
            continue
        own = choose_material(some, options=options)
        if own is None:
            continue
        larger = _with_material(palette, label, own)
        with_own = _palette_errors(survey, larger, options)
        if predicts_better(with_own, errors):
            palette, errors = larger, with_own
    return palette


def assign_materials(
    samples: RadianceSamples, palette: Palette, *, options: SolverOptions = DEFAULT_OPTIONS
) -> NDArray[np.int32]:
    """Which material of the palette each texel is most likely made of, (n,)."""
    number = len(palette.materials)
    if number == 1:
        return np.zeros(samples.texels, np.int32)
    costs = np.zeros((samples.texels, number))
    cost_under_materials(
        samples.arrays,
        max(material.misfit_floor for material in palette.materials),
        max(material.misfit_relative for material in palette.materials),
        material_table(list(palette.materials)),
        shape_bounds(),
        float(options.huber_limit),
        costs,
    )
    colour = _robust_colour(samples, palette.colour_unit)[:, np.newaxis]
    off = ((colour - palette.colour_mean) / palette.colour_sd) ** 2
    of_cluster = np.minimum(off, _HUBER_COLOUR).sum(axis=2) + costs[:, palette.cluster_material]
    of_cluster += 2.0 * np.log(palette.colour_sd).sum(axis=1)
    return palette.cluster_material[np.argmin(of_cluster, axis=1)].astype(np.int32)


def fit_tile(
    samples: RadianceSamples, palette: Palette, *, options: SolverOptions = DEFAULT_OPTIONS
) -> TexelFits:
    """Fit the texels of a tile, each with the prior of its material.

    Parameters
    ----------
    samples : RadianceSamples
    palette : Palette
        From :func:`find_materials` on texels of the whole painting.
    options : SolverOptions

    Returns
    -------
    TexelFits
    """
    material = assign_materials(samples, palette, options=options)
    return fit_texels(samples, list(palette.materials), material, options=options)


def fit_reflectance(
    samples: RadianceSamples,
    *,
    cluster_options: ClusterOptions | None = None,
    options: SolverOptions = DEFAULT_OPTIONS,
) -> tuple[TexelFits, Palette]:
    """Find the materials of all texels given, and fit every texel.

    Raises
    ------
    FittingError
        No texel has a valid sample.
    """
    palette = find_materials(samples, cluster_options=cluster_options, options=options)
    return fit_tile(samples, palette, options=options), palette


def _palette_errors(survey: RadianceSamples, palette: Palette, options: SolverOptions) -> Floats:
    def fit(seen: RadianceSamples) -> LafortuneLobes:
        return fit_tile(seen, palette, options=options).lobes

    return held_out_errors(survey, fit)


def _with_material(palette: Palette, cluster: int, material: Material) -> Palette:
    assigned = palette.cluster_material.copy()
    assigned[cluster] = len(palette.materials)
    return replace(palette, materials=(*palette.materials, material), cluster_material=assigned)


def _robust_colour(samples: RadianceSamples, unit: float) -> Floats:
    """Cube root of the median reflectance over the samples; highlights are the fewer ones."""
    valid = samples.valid
    cosine = np.where(valid, samples.light[..., 2], 1.0)
    reflectance = np.where(
        valid[..., np.newaxis], samples.radiance / cosine[..., np.newaxis], np.inf
    )
    ordered = np.sort(reflectance, axis=1)
    middle = np.maximum(valid.sum(axis=1) - 1, 0) // 2
    median = ordered[np.arange(samples.texels), middle]
    return np.cbrt(np.where(np.isfinite(median), np.maximum(median, 0.0), 0.0) / unit)


def _features(fits: TexelFits, unit: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Standardised features (n, 5) and which of them are known: colour, ln k, strength."""
    errors = fits.standard_errors
    colour = np.cbrt(np.maximum(fits.lobes.diffuse, 0.0) / unit)
    strength = np.cbrt(np.maximum(fits.lobes.specular.mean(axis=1), 0.0) / unit)
    seen = fits.has_highlight & (errors[:, 0] < 0.5)
    seen &= errors[:, 6:].max(axis=1) < 0.3 * fits.lobes.specular.max(axis=1)
    features = np.column_stack([colour, 0.5 * fits.lobes.shape[:, 0], strength])
    known = np.ones(features.shape, np.bool_)
    known[:, 3:] = seen[:, np.newaxis]
    return np.where(known, features, 0.0), known


def _drawn(texels: NDArray[np.int64], number: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """So many of the texels, at most, in the order that they had: neighbours stay together."""
    return np.sort(rng.permutation(texels)[:number])


def _cluster(
    features: Floats, known: NDArray[np.bool_], chosen: ClusterOptions, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Labels (n,) of the clustering with the least of Schwarz's criterion."""
    best_score = np.inf
    best = np.zeros(len(features), np.int64)
    for number in range(1, chosen.most + 1):
        if number * chosen.fewest > len(features) and number > 1:
            break
        for _ in range(_RESTARTS if number > 1 else 1):
            labels = _k_means(features, known, number, rng)
            sizes = np.bincount(labels, minlength=number)
            if number > 1 and sizes.min() < chosen.fewest:
                continue
            score = _schwarz(features, known, labels)
            if score < best_score:
                best_score, best = score, labels
    return best


def _k_means(
    features: Floats, known: NDArray[np.bool_], number: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Labels by Lloyd's iteration from k-means++ centres; unknown features have no say."""
    centres = features[rng.integers(len(features))][np.newaxis]
    for _ in range(number - 1):
        away = _distances(features, known, centres).min(axis=1)
        total = away.sum()
        shares = away / total if total > 0.0 else np.full(len(away), 1.0 / len(away))
        centres = np.vstack([centres, features[rng.choice(len(features), p=shares)]])
    labels = np.zeros(len(features), np.int64)
    for _ in range(_ROUNDS):
        new = np.argmin(_distances(features, known, centres), axis=1)
        for c in range(number):
            mine = known & (new == c)[:, np.newaxis]
            count = mine.sum(axis=0)
            mean = np.where(mine, features, 0.0).sum(axis=0) / np.maximum(count, 1)
            centres[c] = np.where(count > 0, mean, centres[c])
        if np.array_equal(new, labels):
            break
        labels = new
    return labels


def _distances(features: Floats, known: NDArray[np.bool_], centres: Floats) -> Floats:
    off = (features[:, np.newaxis] - centres) ** 2
    return np.where(known[:, np.newaxis], off, 0.0).sum(axis=2)


def _schwarz(features: Floats, known: NDArray[np.bool_], labels: NDArray[np.int64]) -> float:
    """−2 ln likelihood of axis-aligned Gaussians, plus ln n for each of their parameters."""
    score = 0.0
    for label in range(labels.max() + 1):
        mine = labels == label
        score -= 2.0 * mine.sum() * np.log(mine.mean())
        for f in range(features.shape[1]):
            values = features[mine & known[:, f], f]
            if values.size:
                variance = max(float(values.var()), _SMALLEST_SCATTER**2)
                score += values.size * np.log(variance)
                score += float(((values - values.mean()) ** 2).sum()) / variance
        score += (2 * features.shape[1] + 1) * np.log(len(features))
    return float(score)
