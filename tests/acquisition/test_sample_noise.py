"""Noise of a sample from fringes: through a gamma, over a mosaic, in pictures of a few pixels."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_scan import fringe_patterns, make_plan

from acquisition.fringes import find_fringes
from acquisition.patterns import Axis, pattern_profile
from acquisition.sample_noise import QUANTISATION_VARIANCE, estimate_noise

SIGMA = 6.0


def taken(periods, steps, *, slope=2.9, gamma=1.0, shape=(60, 300), gain=1.0, contrast=1.0, seed=0):
    """Fringes with their frames; ``gain`` (rows, cols) is each pixel's share of the light."""
    patterns = [
        step
        for period in periods
        for step in fringe_patterns(Axis.COLUMN, period=period, steps=steps)
    ]
    plan = make_plan(patterns, width=shape[1], height=shape[0])
    row, col = np.indices(shape)
    at = 30 + slope * col + 0.7 * row
    random = np.random.default_rng(seed)
    frames = {}
    for frame in plan.frames:
        level = gain * (200 + 700 * contrast * pattern_profile(frame.pattern, at) ** gamma)
        noisy = level + random.normal(0, SIGMA, shape)
        frames[frame.id] = np.clip(np.round(noisy), 0, 1023).astype(np.uint16)
    return [
        (fringe, np.stack([frames[name] for name in fringe.frame_ids]))
        for fringe in find_fringes(plan)
    ]


def sigma_of(fringes, **options):
    noise = estimate_noise(fringes, **options)
    level = np.median([stack.mean(axis=0) for _, stack in fringes])
    return float(np.sqrt(noise.variance(level))), noise.origin


@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("period", [16.0, 60.0, 500.0])
@pytest.mark.parametrize("steps", [3, 4, 5, 8])
def test_harmonics_of_short_and_long_fringes_are_no_noise(steps, period, gamma):
    """Six pixels to a period, nothing that a harmonic leaves is smooth."""
    found, _ = sigma_of(taken([period], steps, gamma=gamma))
    # Four steps and five leave second harmonics that are large, and the phase they follow is noisy.
    assert 0.93 * SIGMA < found < (1.25 if steps in (4, 5) and gamma > 1 else 1.08) * SIGMA


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_the_means_of_three_step_fringes_agree_but_for_their_noise(gamma):
    found, origin = sigma_of(taken([500.0, 100.0, 20.0], 3, gamma=gamma))
    assert found == pytest.approx(SIGMA, rel=0.07)
    assert "agreement" in origin


@pytest.mark.parametrize("steps", [4, 5, 8, 12])
@pytest.mark.parametrize("period", [120.0, 700.0])
def test_faint_fringes_of_which_a_part_is_seen(steps, period):
    """Noise makes a long fringe look steep, and a part of the period does not tell its orders."""
    fringes = taken([period], steps, slope=0.15, contrast=0.07)
    assert sigma_of(fringes)[0] == pytest.approx(SIGMA, rel=0.12)


def mosaic(shape, red, green, blue):
    gain = np.full(shape, green)
    gain[::2, ::2], gain[1::2, 1::2] = red, blue
    return gain


@pytest.mark.parametrize("steps", [3, 4])
def test_the_colours_of_a_mosaic_are_no_noise(steps):
    fringes = taken([500.0], steps, gain=mosaic((60, 300), 0.3, 1.0, 0.2))
    assert sigma_of(fringes)[0] == pytest.approx(SIGMA, rel=0.08)


@pytest.mark.parametrize("steps", [3, 4])
def test_a_saturated_colour_leaves_the_others_to_tell(steps):
    fringes = taken([500.0, 100.0], steps)
    for _, stack in fringes:
        stack[:, ::2, ::2] = stack[:, 1::2, 1::2] = 1023
    assert sigma_of(fringes, saturation=1023)[0] == pytest.approx(SIGMA, rel=0.08)


@pytest.mark.parametrize("steps", [3, 5])
@pytest.mark.parametrize("shape", [(450, 1), (300, 2)])
def test_pictures_too_narrow_for_neighbours_count_all_that_is_left(steps, shape):
    found, origin = sigma_of(taken([500.0, 100.0], steps, shape=shape))
    assert 0.8 * SIGMA < found < 1.3 * SIGMA
    assert "as they are" in origin


def test_one_level_tells_nothing():
    noise = estimate_noise(taken([500.0], 3, shape=(40, 2)))
    assert noise.read_variance == QUANTISATION_VARIANCE
    assert "too little" in noise.origin
