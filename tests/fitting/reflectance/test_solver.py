from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fitting.errors import FittingError
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.lobe import LafortuneLobes, LobeVariant
from fitting.reflectance.materials import Material
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.solver import SolverOptions, fit_texels, highlight_threshold
from workstation.benchmarks.lafortune_samples import (
    KNOWN_MATERIAL,
    NARROW_MATERIAL,
    make_lobes,
    narrow_highlights,
    observe,
    reached,
    smooth_paint,
)
from workstation.benchmarks.lafortune_truth import local_roughness, observed, z_scores
from workstation.benchmarks.paint_samples import capture_directions, directions, paint_samples
from workstation.benchmarks.stressed_texels import Stress, failures, scaled, stressed


def assert_finite(fits):
    for array in (fits.lobes.shape, fits.lobes.diffuse, fits.lobes.specular, fits.covariance):
        assert np.all(np.isfinite(array))
    assert np.all(fits.standard_errors >= 0)
    assert np.all(np.isfinite(fits.cost))


def test_errors_are_as_large_as_predicted():
    truth = make_lobes(4000, np.random.default_rng(0))
    fits = fit_texels(observe(truth, 96, 0))
    seen = observed(fits)
    assert seen.mean() > 0.9
    z = z_scores(fits, truth)[seen][:, [0, 1, *range(3, 9)]]  # ln c is not free
    assert np.all((z.std(axis=0) > 0.9) & (z.std(axis=0) < 1.1))
    assert np.all(np.abs(z.mean(axis=0)) < 0.15)


def test_errors_of_anisotropic_lobes():
    truth = make_lobes(2000, np.random.default_rng(1), ln_c=(0.0, 0.05))
    fits = fit_texels(observe(truth, 96, 1), [Material(variant=LobeVariant.ANISOTROPIC)])
    spread = z_scores(fits, truth)[observed(fits)].std(axis=0)
    assert np.all((spread > 0.9) & (spread < 1.1))


def test_errors_under_a_prior_that_tells_the_truth():
    rng = np.random.default_rng(2)
    shape = rng.multivariate_normal(
        KNOWN_MATERIAL.shape_mean, KNOWN_MATERIAL.shape_covariance, 3000
    )
    shape[:, 2] = 0
    truth = LafortuneLobes(
        shape, rng.uniform(0.05, 0.25, (3000, 3)), rng.normal(0.4, 0.12, (3000, 3)).clip(0.05)
    )
    fits = fit_texels(observe(truth, 24, 2, noise=3.0), [KNOWN_MATERIAL])
    seen = fits.has_highlight & (fits.standard_errors[:, 0] < 0.3)
    assert seen.mean() > 0.5
    spread = z_scores(fits, truth)[seen].std(axis=0)
    for p in (0, 1, 3, 4, 5):
        assert 0.9 < spread[p] < 1.1


def test_highlights_that_no_sample_reaches_are_unobserved():
    truth, samples = narrow_highlights(2000, seed=3)
    fits = fit_texels(samples.masked(~reached(truth, samples)), [NARROW_MATERIAL])
    blind = fits.flagged(TexelFlag.UNOBSERVED)
    assert blind.mean() >= 0.95
    np.testing.assert_allclose(fits.lobes.shape[blind] - NARROW_MATERIAL.shape_mean, 0, atol=1e-12)
    # A skirt of the highlight may still have its say, within the prior.
    assert np.percentile(np.abs(fits.lobes.specular[blind] - 0.4), 98) < 0.12
    # Its own prior's errors are what is said of them.
    assert np.allclose(fits.standard_errors[blind, 0], 0.1, rtol=0.05)
    seen = fit_texels(samples, [NARROW_MATERIAL])
    assert seen.flagged(TexelFlag.UNOBSERVED).mean() < 0.2


def test_matt_texels_are_diffuse_and_seldom_called_glossy():
    samples = paint_samples(None, 5000, 90, seed=4)
    options = SolverOptions(false_alarm_rate=0.01)
    alone = fit_texels(samples, options=options)
    assert alone.has_highlight.mean() <= 0.01
    assert np.all(alone.lobes.specular[~alone.has_highlight] == 0)
    known = fit_texels(samples, [KNOWN_MATERIAL])
    assert known.flagged(TexelFlag.DIFFUSE).mean() > 0.98


def test_threshold_is_that_of_non_negative_amplitudes():
    rng = np.random.default_rng(5)
    fall = (np.maximum(rng.normal(size=(400_000, 3)), 0) ** 2).sum(axis=1)
    for rate in (0.1, 0.01, 0.001):
        assert np.mean(fall > highlight_threshold(rate, 1)) == pytest.approx(rate, rel=0.15)


def test_smooth_paint_has_a_smooth_exponent():
    truth, samples = smooth_paint(seed=6)
    rough = local_roughness(fit_texels(samples), truth)
    assert np.median(rough) < 1.1
    assert rough.max() < 1.5


def test_outliers_hardly_move_the_lobe():
    truth = make_lobes(1000, np.random.default_rng(7), ln_k=(3.7, 0.1))
    clean = observe(truth, 96, 7)
    rng = np.random.default_rng(8)
    wrong = rng.random((1000, 96, 1)) < 0.1
    spoiled = np.where(wrong, rng.uniform(0, 1, (1000, 96, 1)), clean.radiance)
    samples = RadianceSamples(clean.view, clean.light, spoiled, clean.variance, clean.weight)
    robust = fit_texels(samples)
    plain = fit_texels(samples, options=SolverOptions(huber_limit=np.inf))
    assert_finite(robust)
    off = [np.median(np.abs(f.lobes.diffuse - truth.diffuse)) for f in (robust, plain)]
    assert off[0] < 0.01
    assert off[0] < 0.2 * off[1]
    assert np.median(np.abs(robust.lobes.shape[:, 0] - truth.shape[:, 0])) < 0.2


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_exposure_only_scales_reflectance(scale):
    samples = observe(make_lobes(200, np.random.default_rng(9)), 90, 9)
    one, other = fit_texels(samples), fit_texels(scaled(samples, scale))
    assert_finite(other)
    np.testing.assert_array_equal(one.flags, other.flags)
    np.testing.assert_allclose(one.lobes.shape, other.lobes.shape, atol=0.02)
    np.testing.assert_allclose(one.lobes.diffuse, other.lobes.diffuse / scale, rtol=1e-3)
    np.testing.assert_allclose(
        one.standard_errors[:, 3:6], other.standard_errors[:, 3:6] / scale, rtol=0.02
    )


@pytest.mark.parametrize("k", [1.0, 1500.0])
def test_exponents_at_the_ends_of_the_range(k):
    truth = make_lobes(
        400, np.random.default_rng(10), ln_k=(np.log(k), 0), ln_r=(0, 0), specular=(0.5, 2)
    )
    fits = fit_texels(observe(truth, 96, 10))
    assert_finite(fits)
    sure = fits.has_highlight & (fits.standard_errors[:, 0] < 0.1)
    if k > 1:  # narrow: most texels' samples pass it by
        assert sure.sum() > 3
        z = z_scores(fits, truth)[sure, 0]
        assert np.median(np.abs(z)) < 1.5
    residual = fits.lobes.radiance(*capture_directions(400, 96, np.random.default_rng(10))[:2])
    assert np.all(np.isfinite(residual))


@pytest.mark.parametrize("kind", Stress)
def test_whatever_is_measured_results_are_finite_and_flagged(kind):
    assert failures(kind) == []


def test_stress_is_what_its_name_says():
    assert stressed(Stress.NO_SAMPLES).valid.sum() == 0
    assert stressed(Stress.ONE_LIGHT).valid.sum(axis=1).max() == 1
    assert stressed(Stress.TWO_LIGHTS).valid.sum(axis=1).max() == 2
    repeated = stressed(Stress.DUPLICATED)
    assert np.array_equal(repeated.radiance[:, :24], repeated.radiance[:, 24:])
    wrong = np.isnan(stressed(Stress.NANS).radiance).any(axis=2)
    assert wrong.mean() == 0.5
    plain = observe(make_lobes(60, np.random.default_rng(11)), 48, 11)
    outliers = (stressed(Stress.OUTLIERS).radiance != plain.radiance).any(axis=2)
    assert 0.08 < outliers.mean() < 0.12


def test_lobes_that_come_from_the_prior_say_so():
    truth = make_lobes(400, np.random.default_rng(16))
    faint = fit_texels(observe(truth, 8, 16, noise=20.0), [KNOWN_MATERIAL])
    borrowed = faint.flagged(TexelFlag.LOBE_FROM_PRIOR)
    assert 0.01 < borrowed[faint.has_highlight].mean() < 0.5
    assert faint.standard_errors[borrowed, 0].min() > 0.8 * 0.4
    clear = fit_texels(observe(truth, 96, 16), [KNOWN_MATERIAL])
    assert clear.flagged(TexelFlag.LOBE_FROM_PRIOR).mean() < 0.02


def test_a_lobe_comes_from_the_prior_only_if_ln_k_itself_is_no_better_known():
    # ln k and ln r go together in this prior: one of them alone, the other being known, varies by
    # half as much as without that knowledge.
    together = np.array([[0.16, 0.0104], [0.0104, 0.0009]])
    covariance = np.diag([1.0, 1.0, 4e-4])
    covariance[:2, :2] = together
    truth = make_lobes(400, np.random.default_rng(16))
    material = dataclasses.replace(KNOWN_MATERIAL, shape_covariance=covariance)
    fits = fit_texels(observe(truth, 8, 16, noise=20.0), [material])
    seen = fits.has_highlight
    variance, alone = fits.covariance[:, 0, 0], np.linalg.inv(together)[0, 0] ** -1
    between = seen & (variance > 0.7 * alone) & (variance < 0.6 * together[0, 0])
    assert between.sum() > 20
    assert not fits.flagged(TexelFlag.LOBE_FROM_PRIOR)[between].any()


def test_exponents_at_the_end_of_their_range_are_flagged():
    truth = make_lobes(200, np.random.default_rng(17), ln_k=(0, 0), ln_r=(0, 0))
    fits = fit_texels(observe(truth, 96, 17))
    at_end = fits.lobes.shape[:, 0] == 0
    assert 0.2 < at_end.mean() < 0.8
    assert fits.flagged(TexelFlag.AT_BOUND)[at_end].all()


def test_highlights_are_not_made_up_where_three_samples_could_mean_anything():
    rng = np.random.default_rng(18)
    light = directions(rng.uniform(0.2, 1.0, (400, 3)), rng.uniform(0, 2 * np.pi, (400, 3)))
    view = np.broadcast_to([0.0, 0.0, 1.0], light.shape)
    radiance = 0.1 * light[..., 2:] * np.ones(3)
    radiance[:, 0] *= 3
    samples = RadianceSamples(
        view, light, radiance, np.full_like(radiance, 1e-6), np.ones((400, 3))
    )
    fits = fit_texels(samples)
    assert_finite(fits)
    assert fits.lobes.specular.max() < 1000 * 0.3 + 1e-3
    made_up = fits.flagged(TexelFlag.NOT_FINITE)
    assert 20 < made_up.sum() < 200
    assert np.all(fits.lobes.specular[made_up] == 0)


def test_without_a_search_the_descent_goes_from_the_material_s_lobe():
    truth = make_lobes(200, np.random.default_rng(19))
    samples = observe(truth, 96, 19)
    options = SolverOptions(search_starts=False, skip_diffuse=False)
    beside = truth.shape + np.array([0.3, 0.02, 0.0])
    near = [Material(shape_mean=shape) for shape in beside]
    found = fit_texels(samples, near, np.arange(200), options=options)
    searched = fit_texels(samples, options=SolverOptions(skip_diffuse=False))
    assert np.mean(found.cost <= 1.001 * searched.cost) > 0.97
    # From a narrow lobe that no sample meets there is nowhere to go, and nothing else is tried.
    far = fit_texels(samples, [Material(shape_mean=np.array([7.0, 0.4, 0.0]))], options=options)
    assert 0.3 < np.mean(far.cost > 1.01 * searched.cost) < 0.7


def test_bad_texels_do_not_touch_their_neighbours():
    samples = observe(make_lobes(200, np.random.default_rng(12)), 60, 12)
    radiance = samples.radiance.copy()
    radiance[::3] = np.nan
    spoiled = RadianceSamples(
        samples.view, samples.light, radiance, samples.variance, samples.weight
    )
    good = np.arange(200) % 3 != 0
    one, other = fit_texels(samples), fit_texels(spoiled)
    np.testing.assert_array_equal(one.lobes.shape[good], other.lobes.shape[good])
    assert other.flagged(TexelFlag.NO_SAMPLES)[~good].all()


def test_a_batch_is_its_texels_one_by_one():
    samples = observe(make_lobes(150, np.random.default_rng(13)), 60, 13)
    whole = fit_texels(samples)
    for texel in (0, 63, 64, 149):
        one = fit_texels(samples.take([texel]))
        np.testing.assert_array_equal(one.lobes.shape[0], whole.lobes.shape[texel])
        np.testing.assert_array_equal(one.covariance[0], whole.covariance[texel])


def test_inputs_that_make_no_sense_are_refused():
    samples = observe(make_lobes(4, np.random.default_rng(14)), 20, 14)
    with pytest.raises(FittingError, match="0 to 0"):
        fit_texels(samples, [Material()], [0, 0, 0, 1])
    with pytest.raises(FittingError, match="misfit_floor of material 0"):
        fit_texels(samples, [Material(misfit_floor=np.nan)])
    with pytest.raises(FittingError, match="no materials"):
        fit_texels(samples, [])
    with pytest.raises(FittingError, match="false alarm"):
        SolverOptions(false_alarm_rate=2.0)
    with pytest.raises(FittingError, match="skip_diffuse"):
        SolverOptions(search_starts=False)


def test_no_texels_are_no_error():
    samples = observe(make_lobes(3, np.random.default_rng(15)), 20, 15).take(np.zeros(3, bool))
    assert fit_texels(samples).lobes.shape.shape == (0, 3)
