from __future__ import annotations

import numpy as np
import pytest
from synthetic_scan import fringe_patterns, make_plan

from acquisition.decoding import DecodingOptions, decode
from acquisition.errors import DecodingError
from acquisition.fringes import Fringe
from acquisition.harmonics import error_orders, series_along_lines, series_of_coarse
from acquisition.patterns import Axis, pattern_profile
from acquisition.sample_noise import SampleNoise

NOISE = SampleNoise(1.0, 0.0, "known")
COMPENSATED = DecodingOptions(noise=NOISE, compensate_harmonics=True)
BARE = DecodingOptions(noise=NOISE)


def surface(width=480, height=200):
    """Coordinates over a gently curved surface, with a step and a bump of relief on it."""
    col, row = np.meshgrid(np.arange(width), np.arange(height))
    truth = 30 + 0.9 * col + 0.08 * row + 1e-4 * (col - 200) ** 2
    truth[60:90, 100:160] += 3.5
    return truth + 2 * np.exp(-((col - 330) ** 2 + (row - 120) ** 2) / 300)


def expose_through_gamma(plan, truth, gamma, *, sigma=1.0, axis=Axis.COLUMN, seed=0):
    """Frames of a projector that answers with a power, seen on a surface of varying reflectance."""
    random = np.random.default_rng(seed)
    albedo = 0.7 + 0.3 * np.sin(np.arange(truth.shape[1]) / 37)
    frames = {}
    for frame in plan.frames:
        level = 10 + 220 * albedo * pattern_profile(frame.pattern, truth) ** gamma
        noisy = level + random.normal(0, sigma, level.shape)
        frames[frame.id] = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    return frames


def plan_of(periods, *, steps, axis=Axis.COLUMN, shape=(200, 480), panel=640.0):
    patterns = []
    for period in periods:
        patterns += fringe_patterns(axis, period=period, steps=steps)
    return make_plan(
        patterns, width=shape[1], height=shape[0], projector=(640, 640), saturation=255
    )


def phase_error(found, truth, axis=Axis.COLUMN):
    decoded = found.axes[axis]
    error = (decoded.coordinate - truth)[found.valid] * 2 * np.pi / decoded.period_px
    return error, np.sqrt(decoded.variance[found.valid]) * 2 * np.pi / decoded.period_px


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.2])
@pytest.mark.parametrize("axis", list(Axis))
def test_three_step_fringes_through_a_gamma_are_straightened(gamma, axis):
    truth = surface() if axis is Axis.COLUMN else surface(200, 480).T * 1.0
    if axis is Axis.ROW:
        truth = surface(480, 200).T.copy()
    plan = plan_of((40.0, 640.0), steps=3, axis=axis, shape=truth.shape)
    frames = expose_through_gamma(plan, truth, gamma)
    found = decode(plan, frames.__getitem__, COMPENSATED)
    error, sigma = phase_error(found, truth, axis)
    noise = np.sqrt(np.mean(sigma**2))
    assert found.valid.mean() > 0.98
    assert np.sqrt(np.mean(error**2)) < 1.15 * noise
    assert np.std(error / sigma) == pytest.approx(1, abs=0.12)
    harmonic = found.axes[axis].harmonics[0]
    assert harmonic.order == 3
    # For a power γ the harmonics of orders 2 and 4 stand to the first as (γ-1)/(γ+2) and
    # (γ-1)(γ-2)(γ-3)/((γ+2)(γ+3)(γ+4)); to first order they err by their difference.
    second = (gamma - 1) / (gamma + 2)
    fourth = second * (gamma - 2) * (gamma - 3) / ((gamma + 3) * (gamma + 4))
    assert harmonic.amplitude_rad == pytest.approx(abs(second - fourth), rel=0.1, abs=2e-3)
    assert harmonic.residual_rad < 0.004
    if gamma == 1:
        assert harmonic.amplitude_rad < 5 * harmonic.sigma_rad + 1e-3


def test_nothing_is_compensated_unless_asked_for():
    truth = surface()
    plan = plan_of((40.0, 160.0, 640.0), steps=3)
    frames = expose_through_gamma(plan, truth, 2.2)
    bare = decode(plan, frames.__getitem__, BARE)
    assert bare.axes[Axis.COLUMN].harmonics == ()
    error, sigma = phase_error(bare, truth)
    assert np.std(error) > 4 * np.median(sigma)
    found = decode(plan, frames.__getitem__, COMPENSATED)
    assert np.std(phase_error(found, truth)[0]) < 0.2 * np.std(error)


def test_eight_steps_have_nothing_to_compensate():
    truth = surface()
    plan = plan_of((40.0, 640.0), steps=8)
    frames = expose_through_gamma(plan, truth, 2.2)
    found = decode(plan, frames.__getitem__, COMPENSATED)
    error, sigma = phase_error(found, truth)
    assert np.std(error / sigma) == pytest.approx(1, abs=0.05)
    assert all(h.amplitude_rad < 2e-3 for h in found.axes[Axis.COLUMN].harmonics)


def test_the_error_of_a_coarse_fringe_shows_against_a_finer_one():
    random = np.random.default_rng(1)
    turns = random.uniform(0.1, 0.7, 4000)  # not all phases are seen
    error = 0.01 + 0.02 * np.cos(3 * 2 * np.pi * turns) + random.normal(0, 0.003, 4000)
    error[:400] += 0.06  # wrong orders of the finer one
    series = series_of_coarse(turns, error, (3, 6))
    assert series.orders == (0, 3, 6)
    np.testing.assert_allclose(series.cosine, [0.01, 0.02, 0], atol=5e-4)
    np.testing.assert_allclose(series.sine, 0, atol=5e-4)
    left = error - series.error(turns)
    assert np.median(np.abs(left[400:])) == pytest.approx(0.6745 * 0.003, rel=0.1)


def test_a_coarse_fringe_is_given_the_error_of_the_finer_one():
    truth = surface()
    # Uncompensated, the coarse fringe errs by more than half a period of the fine one.
    plan = plan_of((40.0, 640.0), steps=3)
    frames = expose_through_gamma(plan, truth, 2.2)
    with pytest.raises(DecodingError, match="wrong order"):
        decode(plan, frames.__getitem__, BARE)
    found = decode(plan, frames.__getitem__, COMPENSATED)
    assert found.valid.mean() > 0.98
    assert np.mean(np.abs(found.axes[Axis.COLUMN].coordinate - truth)[found.valid] > 20) < 1e-4


def test_orders_that_err():
    def fringe(shifts):
        return Fringe(Axis.COLUMN, 32.0, 0.0, 1.0, np.asarray(shifts, float), ("",) * len(shifts))

    assert error_orders(fringe(2 * np.pi * np.arange(3) / 3)) == (3, 6, 9, 12, 15)
    assert error_orders(fringe([2.1, 0.0, -2.1])) == (1, 2, 3, 4)
    assert error_orders(fringe([-2 * np.pi / 3, 0.0, 2 * np.pi / 3])) == (3, 6, 9, 12, 15)
    assert error_orders(fringe(2 * np.pi * np.arange(20) / 20)) == (20,)


def test_a_series_is_recovered_within_its_standard_error():
    random = np.random.default_rng(0)
    found = []
    for _ in range(60):
        true = np.cumsum(np.full((40, 300), 1 / 23.0), axis=1) + random.uniform(0, 1, (40, 1))
        raw = true.copy()
        for _ in range(30):  # raw = true + e(raw)
            raw = true + 0.02 * np.sin(6 * np.pi * raw) - 0.01 * np.cos(6 * np.pi * raw)
        turns = (raw + random.normal(0, 0.004, raw.shape)) % 1
        series = series_along_lines([turns], [np.ones(turns.shape, bool)], (3,))
        found.append([series.cosine[0], series.sine[0], series.sigma[0]])
    cosine, sine, sigma = np.transpose(found)
    assert np.mean(cosine) == pytest.approx(-0.01, abs=2e-4)
    assert np.mean(sine) == pytest.approx(0.02, abs=2e-4)
    assert np.std(cosine) == pytest.approx(np.mean(sigma), rel=0.35)


def test_too_few_periods_tell_nothing():
    slow = np.tile(np.linspace(0.1, 0.7, 400), (8, 1))
    use = np.ones(slow.shape, bool)
    assert series_along_lines([slow], [use], (3,)) is None
    assert series_along_lines([slow[:, :1]], [use[:, :1]], (3,)) is None
    assert series_along_lines([slow], [~use], (3,)) is None
    assert series_of_coarse(slow[0, :10], slow[0, :10], (3,)) is None
