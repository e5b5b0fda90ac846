from __future__ import annotations

import fringe_reference as reference
import numpy as np
import pytest

from acquisition.correspondence import Rejection
from acquisition.fringe_fit import fit_samples, model_fringe
from acquisition.fringe_kernels import advance_fitted, merge_exposures
from acquisition.fringe_models import AxisState, SampleModel, UnwrapStep
from acquisition.fringes import Fringe
from acquisition.patterns import Axis
from acquisition.rejection_kernels import (
    PROVISIONAL,
    UNCERTAIN_ORDER,
    flag_outside,
    mask_rejected,
    settle,
)

EVEN = {n: 2 * np.pi * np.arange(n) / n for n in (3, 4, 5, 8, 12, 17)}
UNEVEN = np.array([0.0, 1.1, 2.9, 4.0, 5.6])


def make_fringe(shifts, *, period=32.0, origin=0.7):
    ids = tuple(f"{k}" for k in range(len(shifts)))
    return Fringe(Axis.COLUMN, period, origin, 1.0, np.asarray(shifts, float), ids)


def make_sample(*, read=4.0, gain=0.05, black=0.0, saturation=65535.0, least=0.0, contrast=3.0):
    return SampleModel(*map(np.float32, (read, gain, black, saturation, least, contrast)))


def made_up_stack(shifts, *, mean, modulation, sigma, pixels=3000, dtype=np.uint8, seed=0):
    random = np.random.default_rng(seed)
    turns = random.uniform(0, 1, pixels)
    level = mean + modulation * np.cos(2 * np.pi * turns + np.asarray(shifts)[:, np.newaxis])
    noisy = np.round(level + random.normal(0, sigma, level.shape))
    return np.clip(noisy, 0, np.iinfo(dtype).max).astype(dtype), turns


def turn_difference(a, b):
    return (np.asarray(a, float) - b + 0.5) % 1 - 0.5


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("black", [0.0, 20.0])
@pytest.mark.parametrize("shifts", [*EVEN.values(), UNEVEN])
def test_fits_agree_with_plain_least_squares(shifts, dtype, black):
    scale = 1 if dtype is np.uint8 else 200
    fringe = make_fringe(shifts)
    stack, _ = made_up_stack(
        shifts, mean=120 * scale, modulation=90 * scale, sigma=3 * scale, dtype=dtype
    )
    read, gain = 4.0 * scale**2, 0.05 * scale
    sample = make_sample(read=read, gain=gain, black=black * scale)
    fitted = fit_samples(fringe, stack, model_fringe(fringe), sample)
    expected = reference.fit(fringe, stack, read=read, gain=gain, black=black * scale)
    assert np.abs(turn_difference(fitted.turns, expected["turns"])).max() < 2e-6
    np.testing.assert_allclose(fitted.variance, expected["variance"], rtol=2e-4)
    np.testing.assert_allclose(fitted.modulation, expected["modulation"], rtol=1e-5)
    np.testing.assert_allclose(fitted.ambient, expected["ambient"], rtol=1e-5)
    noise = len(shifts) * read
    np.testing.assert_allclose(fitted.squares, expected["squares"], atol=2e-3 * noise, rtol=1e-3)
    assert not fitted.flags.any()


@pytest.mark.parametrize(("mean", "modulation", "sigma"), [(120, 100, 0.3), (40_000, 25_000, 120)])
def test_single_precision_adds_less_than_a_thousandth_of_the_noise(mean, modulation, sigma):
    dtype = np.uint8 if mean < 256 else np.uint16
    fringe = make_fringe(EVEN[4], origin=0.0)
    stack, turns = made_up_stack(
        EVEN[4], mean=mean, modulation=modulation, sigma=sigma, dtype=dtype, pixels=50_000
    )
    fitted = fit_samples(fringe, stack, model_fringe(fringe), make_sample())
    exact = reference.fit(fringe, stack, read=4.0, gain=0.05)["turns"]
    noise = np.std(turn_difference(exact, turns))
    rounding = turn_difference(fitted.turns, exact)
    assert np.sqrt(np.mean(rounding**2)) < 1e-3 * noise
    # What it adds to the spread of the result is its square.
    assert np.std(turn_difference(fitted.turns, turns)) == pytest.approx(noise, rel=1e-5)


def test_flags_of_a_fit():
    fringe = make_fringe(EVEN[4])
    good, _ = made_up_stack(EVEN[4], mean=120, modulation=80, sigma=0, pixels=4)
    stack = good.copy()
    stack[:, 1] = [100, 101, 100, 101]  # hardly any fringe
    stack[2, 2] = 255
    stack[:, 3] += np.array([20, 0, 20, 0], np.uint8)  # no cosine has these samples
    model = model_fringe(fringe, squares_limit=15.0)
    fitted = fit_samples(fringe, stack, model, make_sample(saturation=255))
    assert fitted.flags[0] == Rejection.NONE
    assert fitted.flags[1] == Rejection.LOW_MODULATION
    assert fitted.flags[2] & Rejection.SATURATED
    assert fitted.flags[3] == Rejection.MIXED_LIGHT
    tolerant = model_fringe(fringe, squares_limit=15.0, harmonics=0.5)
    assert not fit_samples(fringe, stack, tolerant, make_sample()).flags[3]


def test_a_flat_picture_has_no_phase_and_no_quiet_nan():
    fringe = make_fringe(EVEN[3])
    stack = np.full((3, 5), 77, np.uint8)
    fitted = fit_samples(fringe, stack, model_fringe(fringe), make_sample(contrast=0.0))
    assert (fitted.flags == Rejection.LOW_MODULATION).all()
    assert not np.isnan(fitted.planes).any()


def test_a_correction_is_subtracted_and_stretches_the_noise():
    fringe = make_fringe(EVEN[3], origin=0.0)
    stack, _ = made_up_stack(EVEN[3], mean=120, modulation=90, sigma=2)
    series = np.array([[3, 0.01, -0.02], [6, 0.0, 0.005]], np.float32)
    bare = fit_samples(fringe, stack, model_fringe(fringe), make_sample())
    fitted = fit_samples(fringe, stack, model_fringe(fringe, correction=series), make_sample())
    angle = 2 * np.pi * bare.turns.astype(float)
    error = 0.01 * np.cos(3 * angle) - 0.02 * np.sin(3 * angle) + 0.005 * np.sin(6 * angle)
    np.testing.assert_allclose(turn_difference(fitted.turns, bare.turns - error), 0, atol=1e-6)
    nearby = angle + 1e-4
    ahead = 0.01 * np.cos(3 * nearby) - 0.02 * np.sin(3 * nearby) + 0.005 * np.sin(6 * nearby)
    stretch = 1 - (ahead - error) * 2 * np.pi / 1e-4
    np.testing.assert_allclose(fitted.variance, bare.variance * stretch**2, rtol=5e-3)


def unwrapped(turns, variance, near, near_variance, step):
    pixels = len(turns)
    planes = np.stack([turns, variance, np.full(pixels, 80.0), np.full(pixels, 120.0), turns * 0])
    state = AxisState(
        near.astype(np.float32),
        near_variance.astype(np.float32),
        np.zeros(pixels, np.float32),
        np.zeros(pixels, np.uint16),
        np.empty(pixels),
        np.empty(pixels, np.float32),
    )
    advance_fitted(planes.astype(np.float32), np.zeros(pixels, np.uint16), step, state)
    return state


def unwrap_step(*, period, **limits):
    step = UnwrapStep(
        period=period,
        first=False,
        centre=0.0,
        half_width=0.0,
        sigmas=6.0,
        mixed_sigmas=1e9,
        certain_sigmas=0.0,
        borne_out_sigmas=0.0,
        reach=1e9,
        systematic=np.inf,
        extent=512.0,
    )._replace(**limits)
    return UnwrapStep(step.period, step.first, *map(np.float32, step[2:]))


def test_orders_agree_with_a_search_over_all():
    random = np.random.default_rng(3)
    turns, near = random.uniform(0, 1, 5000), random.uniform(10, 500, 5000)
    variance, near_variance = random.uniform(1e-6, 1e-4, 5000), random.uniform(0.1, 4, 5000)
    step = unwrap_step(period=17.3, half_width=1.5, sigmas=2.0)
    state = unwrapped(turns, variance, near, near_variance, step)
    spread = np.sqrt(17.3**2 * variance + near_variance)
    expected, wrong = reference.unwrap(turns, near, 17.3, spread, allowed=1.5 + 2 * spread)
    # Two orders are equally near for some; rounding decides.
    decided = np.abs(np.abs(expected - near) - 17.3 / 2) > 1e-3
    np.testing.assert_allclose(state.coordinate[decided], expected[decided], atol=1e-5)
    flagged = state.rejection & Rejection.WRONG_ORDER != 0
    sure = np.abs(np.abs(expected - near) - 1.5 - 2 * spread) > 1e-3
    np.testing.assert_array_equal(flagged[sure & decided], wrong[sure & decided])
    np.testing.assert_allclose(state.variance, 17.3**2 * variance, rtol=1e-5)
    outside = ~((expected >= -0.5) & (expected <= 511.5))
    np.testing.assert_array_equal(
        (state.rejection & Rejection.OUT_OF_RANGE != 0)[decided], outside[decided]
    )


def test_a_coarse_coordinate_adds_what_it_knows():
    random = np.random.default_rng(4)
    turns, offset = random.uniform(0.1, 0.9, 1000), random.uniform(-2, 2, 1000)
    variance, near_variance = random.uniform(1e-5, 1e-3, 1000), random.uniform(0.1, 4, 1000)
    fine = 20.0 * (3 + turns)
    near = fine + offset
    state = unwrapped(
        turns, variance, near, near_variance, unwrap_step(period=20.0, systematic=0.5)
    )
    own, other = 400 * variance, near_variance + 0.5
    together = (fine / own + near / other) / (1 / own + 1 / other)
    np.testing.assert_allclose(state.coordinate, together, atol=2e-5)
    np.testing.assert_allclose(state.variance, 1 / (1 / own + 1 / other), rtol=1e-4)
    # Where the order is not certain, nothing may pull the coordinate off the fringe.
    unsure = unwrap_step(period=20.0, systematic=0.5, certain_sigmas=10.0, reach=1e-3)
    state = unwrapped(turns, variance, near, near_variance, unsure)
    np.testing.assert_allclose(state.coordinate, fine, atol=1e-5)
    np.testing.assert_allclose(state.variance, own, rtol=1e-5)


def test_the_first_fringe_is_unwrapped_about_the_centre():
    turns = np.array([0.1, 0.5, 0.9])
    step = unwrap_step(period=512.0, first=True, centre=255.5, half_width=256.0)
    nothing = np.full(3, np.nan)
    state = unwrapped(turns, turns * 1e-6, nothing, nothing, step)
    np.testing.assert_allclose(state.coordinate, 512 * turns, rtol=1e-6)
    assert not state.rejection.any()


def test_orders_that_noise_could_change_are_uncertain_or_rejected():
    spread = np.array([1.0, 2.0, 4.0, np.nan])
    near, nothing = np.full(4, 100.0), np.zeros(4)
    step = unwrap_step(
        period=20.0, certain_sigmas=4.0, borne_out_sigmas=2.0, reach=6.0, sigmas=50.0
    )
    state = unwrapped(nothing, nothing, near, spread**2, step)
    assert list(state.rejection) == [
        0,
        UNCERTAIN_ORDER,
        UNCERTAIN_ORDER | Rejection.WRONG_ORDER,
        UNCERTAIN_ORDER | Rejection.WRONG_ORDER,
    ]


def test_a_coarse_fringe_far_off_means_mixed_light():
    near = np.array([101.0, 104.0])
    step = unwrap_step(period=20.0, mixed_sigmas=3.0)
    state = unwrapped(np.zeros(2), np.zeros(2), near, np.ones(2), step)
    assert list(state.rejection) == [0, Rejection.MIXED_LIGHT]


def test_exposures_are_joined_by_inverse_variance():
    fringe = make_fringe(EVEN[4], origin=0.0)
    sample = make_sample(read=2.0, gain=0.1, saturation=255)
    stacks = [
        made_up_stack(EVEN[4], mean=m, modulation=0.8 * m, sigma=1.5, pixels=2000)[0]
        for m in (160, 40)
    ]
    stacks[0][:, :300] = 255
    fits = [fit_samples(fringe, stack, model_fringe(fringe), sample) for stack in stacks]
    plain = [reference.fit(fringe, stack, read=2.0, gain=0.1) for stack in stacks]
    turns, variance = reference.merge(plain, 255)
    merge_exposures(fits[0].planes, fits[0].flags, fits[1].planes, fits[1].flags, np.float32(4))
    used = fits[0].flags == 0
    assert used.mean() > 0.9
    np.testing.assert_allclose(turn_difference(fits[0].turns, turns)[used], 0, atol=2e-4)
    np.testing.assert_allclose(fits[0].variance[used], variance[used], rtol=1e-4)
    # Levels are those of the longer exposure throughout.
    np.testing.assert_allclose(np.median(fits[0].modulation[:300]), 128, rtol=0.03)
    assert fits[0].flags[:300].max() == 0


def test_masking_and_settling():
    rejection = np.array([0, 2, UNCERTAIN_ORDER, UNCERTAIN_ORDER, 16], np.uint16)
    coordinate, variance = np.array([0.0, 1, 2, 3, 600]), np.ones(5, np.float32)
    assert mask_rejected(rejection, coordinate, variance, PROVISIONAL) == (4, 3)
    np.testing.assert_array_equal(coordinate, [0, np.nan, 2, 3, 600])
    np.testing.assert_array_equal(variance, [1, np.inf, 1, 1, 1])
    settle(rejection, np.array([False, False, True, False, False]))
    assert list(rejection) == [0, 2, Rejection.WRONG_ORDER, 0, 0]
    flag_outside(coordinate, 512, rejection)
    assert list(rejection) == [0, 2, Rejection.WRONG_ORDER, 0, Rejection.OUT_OF_RANGE]
    assert mask_rejected(rejection, coordinate, variance, 0) == (2, 0)
