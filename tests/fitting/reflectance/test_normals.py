from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fitting.reflectance.clusters import Palette
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.materials import Material
from fitting.reflectance.normals import learned_spread, refine_normals, turned_samples
from fitting.reflectance.samples import local_frames
from fitting.reflectance.solver import fit_texels
from workstation.benchmarks.lafortune_samples import make_lobes, observe

TEXELS = 600
PALETTE = Palette((Material(),), np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1, np.int64), 0.1)


def tilted(spread, seed=0, texels=TEXELS, samples=60):
    """Samples told in the frames of normals that are off by slopes of this spread."""
    rng = np.random.default_rng(seed)
    true = np.column_stack([rng.normal(0, 0.1, (texels, 2)), np.ones(texels)])
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    local = np.column_stack([rng.normal(0, spread, (texels, 2)), np.ones(texels)])
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    off = np.einsum("nij,ni->nj", local_frames(true), local)
    observed = observe(make_lobes(texels, rng), samples, seed)
    return turned_samples(observed, true, off), true, off


def angle(one, other):
    return np.arccos(np.clip(np.sum(one * other, axis=1), -1, 1))


def test_tilted_normals_are_put_right():
    samples, true, off = tilted(0.05)
    refined = off
    for _ in range(3):
        fits = fit_texels(samples)
        result = refine_normals(samples, fits, PALETTE, refined, spread=0.1)
        samples = turned_samples(samples, refined, result.normals)
        refined = result.normals
    before, after = np.median(angle(off, true)), np.median(angle(refined, true))
    assert before > 0.04
    assert after < 0.1 * before


def test_standard_errors_are_those_of_the_samples():
    rng = np.random.default_rng(5)
    lobes = make_lobes(TEXELS, rng)
    normals = np.tile([0.0, 0.0, 1.0], (TEXELS, 1))
    samples = observe(lobes, 60, 5)
    fits = fit_texels(samples)
    result = refine_normals(samples, fits, PALETTE, normals, spread=0.5)
    z = result.tilt / result.tilt_sigma
    # The lobe was fitted with the true normal and is held: what is left is the tilt's own error.
    assert 0.8 < np.std(z) < 1.2


def test_the_spread_of_normals_is_learned():
    for spread in (0.02, 0.08):
        samples, _, off = tilted(spread, seed=1)
        fits = fit_texels(samples)
        wide = refine_normals(samples, fits, PALETTE, off)
        assert learned_spread(wide, np.zeros(TEXELS)) == pytest.approx(spread, rel=0.35)


def test_normals_without_information_stay():
    samples, _, off = tilted(0.05, texels=50)
    blind = samples.masked(np.zeros(samples.weight.shape, bool))
    fits = fit_texels(blind)
    assert fits.flagged(TexelFlag.NO_SAMPLES).all()
    result = refine_normals(blind, fits, PALETTE, off, spread=0.1)
    assert result.normals == pytest.approx(off, abs=1e-12)
    one_light = samples.masked(np.arange(samples.weight.shape[1]) == 0)
    result = refine_normals(one_light, fit_texels(one_light), PALETTE, off, spread=0.05)
    assert np.isfinite(result.normals).all()
    assert np.abs(result.tilt).max() < 0.5


def test_outliers_do_not_turn_normals():
    samples, true, off = tilted(0.03, seed=2)
    wild = samples.radiance.copy()
    hit = np.random.default_rng(0).random(samples.weight.shape) < 0.1
    wild[hit] *= 3.0
    dirty = type(samples)(samples.view, samples.light, wild, samples.variance, samples.weight)
    result = refine_normals(dirty, fit_texels(dirty), PALETTE, off, spread=0.06)
    assert np.median(angle(result.normals, true)) < 0.5 * np.median(angle(off, true))


def test_turning_samples_there_and_back_changes_nothing():
    samples, true, off = tilted(0.05, texels=40)
    again = turned_samples(turned_samples(samples, off, true), true, off)
    assert again.light == pytest.approx(samples.light, abs=1e-6)
    assert np.linalg.norm(again.view, axis=2) == pytest.approx(1.0, abs=1e-6)


def test_lobes_beyond_all_numbers_leave_their_normals_and_their_neighbours_alone():
    samples, _, off = tilted(0.05, texels=8)
    fits = fit_texels(samples)
    usual = refine_normals(samples, fits, PALETTE, off, spread=0.1)
    shape, specular = fits.lobes.shape.copy(), fits.lobes.specular.copy()
    shape[3] = np.log([3000.0, 0.4, 2.5])  # under lamps that are nowhere near
    specular[3] = 1e300
    lobes = dataclasses.replace(fits.lobes, shape=shape, specular=specular)
    wild = dataclasses.replace(fits, lobes=lobes)
    result = refine_normals(samples, wild, PALETTE, off, spread=0.1)
    np.testing.assert_array_equal(result.tilt[3], 0.0)
    np.testing.assert_allclose(result.tilt_sigma[3], 0.1)
    others = [0, 1, 2, 4, 5, 6, 7]
    np.testing.assert_array_equal(result.normals[others], usual.normals[others])
