from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fitting.errors import FittingError
from fitting.reflectance.clusters import (
    ClusterOptions,
    assign_materials,
    find_materials,
    fit_reflectance,
    fit_tile,
)
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.lobe import LafortuneLobes, LobeVariant
from fitting.reflectance.materials import Material
from fitting.reflectance.misfit import has_misfit
from fitting.reflectance.priors import gaussian_population
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.selection import (
    choose_material,
    held_out_errors,
    predicts_better,
    white_levels,
)
from fitting.reflectance.solver import DEFAULT_OPTIONS, fit_texels
from workstation.benchmarks.lafortune_samples import (
    make_lobes,
    narrow_highlights,
    observe,
    reached,
)
from workstation.benchmarks.paint_samples import glossy_finishes, paint_samples


def test_population_is_recovered_from_noisy_members():
    rng = np.random.default_rng(0)
    mean, covariance = np.array([3.0, -0.1]), np.array([[0.09, 0.006], [0.006, 0.0016]])
    truth = rng.multivariate_normal(mean, covariance, 1500)
    scale = rng.uniform(0.5, 2.0, 1500)
    errors = scale[:, None, None] ** 2 * np.array([[0.16, 0.0], [0.0, 0.0009]])
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(errors), rng.normal(size=(1500, 2)))
    found_mean, found = gaussian_population(truth + noise, errors, np.array([0.02, 0.005]))
    np.testing.assert_allclose(found_mean, mean, atol=0.03)
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(covariance)), rtol=0.15)


@pytest.mark.parametrize(
    ("ln_r", "ln_c", "variant"),
    [
        (0.0, 0.0, LobeVariant.MIRROR),
        (-0.08, 0.0, LobeVariant.FREE),
        (0.02, 0.15, LobeVariant.ANISOTROPIC),
    ],
)
def test_variant_is_the_one_that_predicts(ln_r, ln_c, variant):
    lobes = make_lobes(
        150, np.random.default_rng(1), ln_k=(3.5, 0.1), ln_r=(ln_r, 0.0), ln_c=(ln_c, 0.0)
    )
    material = choose_material(observe(lobes, 60, 1), options=DEFAULT_OPTIONS)
    assert material is not None
    assert material.variant is variant
    assert material.misfit_floor == 0
    assert material.misfit_relative == 0
    np.testing.assert_allclose(material.shape_mean, [3.5, ln_r, ln_c], atol=0.05)


def test_narrow_lobes_that_differ_in_r_do_not_spoil_what_is_known_of_their_height():
    truth, samples = narrow_highlights(150, seed=3)
    # The highlight of every fifth texel is seen by no sample.
    hidden = np.arange(150) % 5 == 0
    samples = samples.masked(~(hidden[:, np.newaxis] & reached(truth, samples)))
    material = choose_material(samples, options=DEFAULT_OPTIONS)
    assert material is not None
    # Evenly between 0.2 and 0.6.
    np.testing.assert_allclose(material.specular_mean, 0.4, rtol=0.2)
    assert np.all((material.specular_sd > 0.03) & (material.specular_sd < 0.25))
    fits = fit_texels(samples, [material])
    assert fits.flagged(TexelFlag.UNOBSERVED)[hidden].mean() >= 0.95
    seen = fits.has_highlight & ~hidden
    z = (fits.lobes.shape[seen, 0] - truth.shape[seen, 0]) / fits.standard_errors[seen, 0]
    assert z.std() < 1.3


def test_matt_paint_is_no_material_with_a_highlight():
    assert choose_material(paint_samples(None, 150, 60, seed=2), options=DEFAULT_OPTIONS) is None


def test_real_paint_is_not_one_lobe_and_says_so():
    finish = glossy_finishes(150, np.random.default_rng(3))
    glossy = paint_samples(finish, 150, 60, seed=3)
    assert has_misfit(glossy, Material(), options=DEFAULT_OPTIONS)
    exact = observe(make_lobes(150, np.random.default_rng(3)), 60, 3)
    assert not has_misfit(exact, Material(), options=DEFAULT_OPTIONS)


@pytest.mark.parametrize(("off", "remarkable"), [(1.0, False), (1.4, True)])
def test_grey_samples_are_one_channel_when_residuals_are_judged(off, remarkable):
    rng = np.random.default_rng(6)
    lobes = make_lobes(150, rng)
    grey = LafortuneLobes(lobes.shape, np.repeat(lobes.diffuse[:, :1], 3, axis=1), lobes.specular)
    samples = observe(grey, 60, 6)
    noise = samples.radiance - grey.radiance(samples.view, samples.light)
    one = (samples.radiance + (off - 1) * noise)[..., :1]
    tripled = dataclasses.replace(
        samples, radiance=np.repeat(one, 3, axis=2), variance=3 * samples.variance
    )
    assert has_misfit(tripled, Material(), options=DEFAULT_OPTIONS) is remarkable


@pytest.fixture(scope="module")
def two_paints():
    """Samples of a red gloss and a blue satin paint, and which is which."""
    rng = np.random.default_rng(4)
    kind = rng.integers(0, 2, 600)
    ln_k = np.where(kind == 0, 4.6, 2.7) + 0.1 * rng.normal(size=600)
    shape = np.column_stack([ln_k, np.full(600, -0.02), np.zeros(600)])
    colour = np.array([[0.2, 0.05, 0.04], [0.03, 0.06, 0.2]])[kind]
    diffuse = colour * rng.uniform(0.8, 1.2, (600, 1))
    specular = np.where(kind == 0, 0.8, 0.15)[:, None] * np.ones((1, 3))
    return observe(LafortuneLobes(shape, diffuse, specular), 48, 4, noise=5.0), kind, shape


def test_materials_are_found_without_labels(two_paints):
    samples, kind, shape = two_paints
    options = ClusterOptions(most=2, per_material=100)
    fits, palette = fit_reflectance(samples, cluster_options=options)
    assert len(palette.materials) >= 2
    assigned = fits.material
    purity = max(np.mean(assigned[kind == 0] == m) for m in range(len(palette.materials)))
    assert purity > 0.95
    first = np.bincount(assigned[kind == 0]).argmax()
    second = np.bincount(assigned[kind == 1]).argmax()
    assert first != second
    assert palette.materials[first].shape_mean[0] > palette.materials[second].shape_mean[0] + 1
    alone = fit_texels(samples)
    off = [np.sqrt(np.mean((f.lobes.shape[:, 0] - shape[:, 0]) ** 2)) for f in (fits, alone)]
    assert off[0] < 0.7 * off[1]
    # A tile of the same painting, by the same palette.
    some = np.arange(0, 600, 7)
    tile = fit_tile(samples.take(some), palette)
    np.testing.assert_allclose(tile.lobes.shape, fits.lobes.shape[some])


def test_texels_without_samples_are_some_material(two_paints):
    samples, _, _ = two_paints
    palette = find_materials(
        samples, cluster_options=ClusterOptions(most=1, survey=200, per_material=100)
    )
    assert len(palette.materials) == 1
    nothing = samples.take(np.arange(5)).masked(np.zeros(48, bool))
    assert np.all(assign_materials(nothing, palette) == 0)
    fits = fit_tile(nothing, palette)
    assert np.all(np.isfinite(fits.lobes.specular))


def test_a_painting_without_samples_is_refused():
    one = np.ones((4, 5, 3))
    dark = RadianceSamples(one, one, one, one, 0 * one[..., 0])
    with pytest.raises(FittingError, match="none of 4 texels"):
        find_materials(dark)


def test_what_a_few_photographs_or_a_few_neighbours_say_is_put_down_to_chance():
    rng = np.random.default_rng(0)
    errors = 1.0 + 0.1 * rng.standard_normal((400, 60))
    by_texel, by_photograph = np.zeros((400, 1)), np.zeros((1, 60))
    by_texel[40:60] = by_photograph[:, 7] = 0.5
    assert predicts_better(errors, errors + 0.01 + 0.05 * rng.standard_normal((400, 60)))
    assert not predicts_better(errors, errors + by_texel)
    assert not predicts_better(errors, errors + by_photograph)
    assert predicts_better(errors, errors + by_texel + by_photograph + 0.05)
    assert not predicts_better(errors, errors)


def test_every_photograph_counts_by_its_own_white():
    samples = paint_samples(None, 60, 24, seed=5)
    dim = np.where(np.arange(24) % 2, 0.1, 1.0).astype(np.float32)[:, np.newaxis]
    dimmed = dataclasses.replace(
        samples, radiance=samples.radiance * dim, variance=samples.variance * dim**2
    )
    np.testing.assert_allclose(white_levels(dimmed), dim[:, 0] * white_levels(samples), rtol=1e-5)
    matt = LafortuneLobes(np.zeros((60, 3)), np.full((60, 3), 0.1), np.zeros((60, 3)))
    usual = held_out_errors(samples, lambda seen: matt)
    assert np.all(usual[samples.valid] > 0)
    # Renderings that are off by as much of the white err as much.
    half = held_out_errors(dimmed, lambda seen: matt)[:, ::2]
    np.testing.assert_allclose(half, usual[:, ::2], rtol=1e-4)
    dark = dataclasses.replace(samples, radiance=np.zeros_like(samples.radiance))
    assert np.all(np.isfinite(held_out_errors(dark, lambda seen: matt)))
