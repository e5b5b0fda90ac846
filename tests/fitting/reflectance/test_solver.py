from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from lafortune_samples import make_lobes, observe

from fitting.errors import FittingError
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.lobe import LafortuneLobes, LobeVariant
from fitting.reflectance.materials import Material
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.solver import SolverOptions, fit_texels, highlight_threshold
from workstation.benchmarks.paint_samples import capture_directions, directions, paint_samples

KNOWN = Material(
    shape_mean=np.array([3.7, -0.03, 0.0]),
    shape_covariance=np.diag([0.4, 0.03, 0.02]) ** 2,
    specular_mean=np.full(3, 0.4),
    specular_sd=np.full(3, 0.12),
)


def z_scores(fits, truth):
    found = np.hstack([fits.lobes.shape, fits.lobes.diffuse, fits.lobes.specular])
    true = np.hstack([truth.shape, truth.diffuse, truth.specular])
    return (found - true) / fits.standard_errors


def assert_finite(fits):
    for array in (fits.lobes.shape, fits.lobes.diffuse, fits.lobes.specular, fits.covariance):
        assert np.all(np.isfinite(array))
    assert np.all(fits.standard_errors >= 0)
    assert np.all(np.isfinite(fits.cost))


def test_errors_are_as_large_as_predicted():
    truth = make_lobes(4000, np.random.default_rng(0))
    fits = fit_texels(observe(truth, 96, 0))
    # Observed: the highlight's height is known to a tenth; beyond, its error is not Gaussian.
    observed = fits.has_highlight & (fits.standard_errors[:, 6:] < 0.1 * fits.lobes.specular).all(
        axis=1
    )
    assert observed.mean() > 0.9
    spread = z_scores(fits, truth)[observed].std(axis=0)
    for p in (0, 1, *range(3, 9)):  # ln c is not free
        assert 0.9 < spread[p] < 1.1
    bias = z_scores(fits, truth)[observed].mean(axis=0)
    assert np.all(np.abs(bias[[0, 1, *range(3, 9)]]) < 0.15)


def test_errors_of_anisotropic_lobes():
    truth = make_lobes(2000, np.random.default_rng(1), ln_c=(0.0, 0.05))
    fits = fit_texels(observe(truth, 96, 1), [Material(variant=LobeVariant.ANISOTROPIC)])
    observed = (fits.standard_errors[:, 6:] < 0.1 * np.maximum(fits.lobes.specular, 1e-9)).all(1)
    spread = z_scores(fits, truth)[observed & fits.has_highlight].std(axis=0)
    assert np.all((spread > 0.9) & (spread < 1.1))


def test_errors_under_a_prior_that_tells_the_truth():
    rng = np.random.default_rng(2)
    shape = rng.multivariate_normal(KNOWN.shape_mean, KNOWN.shape_covariance, 3000)
    shape[:, 2] = 0
    truth = LafortuneLobes(
        shape, rng.uniform(0.05, 0.25, (3000, 3)), rng.normal(0.4, 0.12, (3000, 3)).clip(0.05)
    )
    fits = fit_texels(observe(truth, 24, 2, noise=3.0), [KNOWN])
    seen = fits.has_highlight & (fits.standard_errors[:, 0] < 0.3)
    assert seen.mean() > 0.5
    spread = z_scores(fits, truth)[seen].std(axis=0)
    for p in (0, 1, 3, 4, 5):
        assert 0.9 < spread[p] < 1.1


def test_highlights_that_no_sample_reaches_are_unobserved():
    truth = make_lobes(2000, np.random.default_rng(3), ln_k=(4.5, 0.1))
    samples = observe(truth, 60, 3)
    lobe = LafortuneLobes(truth.shape, np.zeros((2000, 3)), np.ones((2000, 3)))
    reach = lobe.reflectance(samples.view, samples.light)[..., 0]
    # Whatever shows a thousandth of the highlight or more was occluded.
    hidden = samples.masked(reach < 1e-3)
    known = Material(
        shape_mean=np.array([4.5, -0.03, 0.0]),
        shape_covariance=np.diag([0.1, 0.03, 0.02]) ** 2,
        specular_mean=np.full(3, 0.4),
        specular_sd=np.full(3, 0.12),
    )
    fits = fit_texels(hidden, [known])
    assert fits.flagged(TexelFlag.UNOBSERVED).mean() >= 0.95
    blind = fits.flagged(TexelFlag.UNOBSERVED)
    np.testing.assert_allclose(fits.lobes.shape[blind] - known.shape_mean, 0, atol=1e-12)
    # A skirt of the highlight may still have its say, within the prior.
    assert np.percentile(np.abs(fits.lobes.specular[blind] - 0.4), 98) < 0.12
    # Its own prior's errors are what is said of them.
    assert np.allclose(fits.standard_errors[blind, 0], 0.1, rtol=0.05)
    seen = fit_texels(samples, [known])
    assert seen.flagged(TexelFlag.UNOBSERVED).mean() < 0.2


def test_matt_texels_are_diffuse_and_seldom_called_glossy():
    samples = paint_samples(None, 5000, 90, seed=4)
    options = SolverOptions(false_alarm_rate=0.01)
    alone = fit_texels(samples, options=options)
    assert alone.has_highlight.mean() <= 0.01
    assert np.all(alone.lobes.specular[~alone.has_highlight] == 0)
    known = fit_texels(samples, [KNOWN])
    assert known.flagged(TexelFlag.DIFFUSE).mean() > 0.98


def test_threshold_is_that_of_non_negative_amplitudes():
    rng = np.random.default_rng(5)
    fall = (np.maximum(rng.normal(size=(400_000, 3)), 0) ** 2).sum(axis=1)
    for rate in (0.1, 0.01, 0.001):
        assert np.mean(fall > highlight_threshold(rate, 1)) == pytest.approx(rate, rel=0.15)


def test_smooth_paint_has_a_smooth_exponent():
    rows, cols = 40, 40
    y, x = np.mgrid[:rows, :cols] / 40.0
    shape = np.stack([3.5 + 0.3 * x + 0.2 * y, -0.03 + 0.02 * x, np.zeros_like(x)], 2).reshape(
        -1, 3
    )
    truth = LafortuneLobes(shape, np.full((1600, 3), 0.15), np.full((1600, 3), 0.4))
    fits = fit_texels(observe(truth, 96, 6))
    ln_k = (fits.lobes.shape[:, 0] - shape[:, 0]).reshape(rows, cols)
    windows = np.lib.stride_tricks.sliding_window_view(ln_k, (5, 5))
    local = windows.std(axis=(2, 3), ddof=1)
    sigma = fits.standard_errors[:, 0].reshape(rows, cols)
    expected = np.sqrt(np.lib.stride_tricks.sliding_window_view(sigma**2, (5, 5)).mean(axis=(2, 3)))
    assert np.median(local / expected) < 1.1
    assert np.percentile(local / expected, 99) < 1.5


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
    scaled = RadianceSamples(
        samples.view,
        samples.light,
        samples.radiance * scale,
        samples.variance.astype(np.float64) * scale**2,
        samples.weight,
    )
    one, other = fit_texels(samples), fit_texels(scaled)
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


def spoil(kind):
    rng = np.random.default_rng(11)
    samples = observe(make_lobes(60, rng), 48, 11)
    view, light, radiance = samples.view.copy(), samples.light.copy(), samples.radiance.copy()
    variance, weight = samples.variance.copy(), samples.weight.copy()
    if kind == "one light":
        weight[:, 1:] = 0
    elif kind == "two lights":
        weight[:, 2:] = 0
    elif kind == "lights in a line":
        angle = np.linspace(-1, 1, 48)
        light[:] = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
        view[:] = [0, 0, 1]
    elif kind == "dark":
        radiance[:] = 0
    elif kind == "one channel zero":
        radiance[..., 1] = 0
    elif kind == "duplicated":
        for array in (view, light, radiance, variance, weight):
            array[:, 24:] = array[:, :24]
    elif kind == "one sample repeated":
        for array in (view, light, radiance, variance, weight):
            array[:] = array[:, :1]
    elif kind == "NaN":
        radiance[:, ::2] = np.nan
        view[5] = np.inf
        variance[6] = -1
    elif kind == "negative":
        radiance[:] = -np.abs(radiance)
    elif kind == "huge":
        radiance[:, 3] = 1e30
    elif kind == "no samples":
        weight[:] = 0
    return RadianceSamples(view, light, radiance, variance, weight)


KINDS = [
    "one light",
    "two lights",
    "lights in a line",
    "dark",
    "one channel zero",
    "duplicated",
    "one sample repeated",
    "NaN",
    "negative",
    "huge",
    "no samples",
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("material", [Material(), KNOWN], ids=["alone", "known"])
@pytest.mark.parametrize("skip", [True, False])
def test_whatever_is_measured_results_are_finite(kind, material, skip):
    fits = fit_texels(spoil(kind), [material], options=SolverOptions(skip_diffuse=skip))
    assert_finite(fits)
    assert np.all(fits.lobes.diffuse >= 0)
    assert np.all(fits.lobes.specular >= 0)
    if kind in ("dark", "negative") and material is not KNOWN:
        assert fits.flagged(TexelFlag.DARK).all()
    if kind == "NaN":
        assert fits.flagged(TexelFlag.SAMPLES_DROPPED).all()
        assert fits.flagged(TexelFlag.NO_SAMPLES)[[5, 6]].all()
    if kind == "no samples":
        assert fits.flagged(TexelFlag.NO_SAMPLES).all()
    if kind == "one channel zero":
        assert np.all(fits.lobes.diffuse[:, 1] == 0)


def test_lobes_that_come_from_the_prior_say_so():
    truth = make_lobes(400, np.random.default_rng(16))
    faint = fit_texels(observe(truth, 8, 16, noise=20.0), [KNOWN])
    borrowed = faint.flagged(TexelFlag.LOBE_FROM_PRIOR)
    assert 0.01 < borrowed[faint.has_highlight].mean() < 0.5
    assert faint.standard_errors[borrowed, 0].min() > 0.8 * 0.4
    clear = fit_texels(observe(truth, 96, 16), [KNOWN])
    assert clear.flagged(TexelFlag.LOBE_FROM_PRIOR).mean() < 0.02


def test_a_lobe_comes_from_the_prior_only_if_ln_k_itself_is_no_better_known():
    # ln k and ln r go together in this prior: one of them alone, the other being known, varies by
    # half as much as without that knowledge.
    together = np.array([[0.16, 0.0104], [0.0104, 0.0009]])
    covariance = np.diag([1.0, 1.0, 4e-4])
    covariance[:2, :2] = together
    truth = make_lobes(400, np.random.default_rng(16))
    material = dataclasses.replace(KNOWN, shape_covariance=covariance)
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
