"""Precision of decoded coordinates against theory and against their own predicted variance."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_scan import expose, fringe_patterns, gray_patterns, make_plan

from acquisition.correspondence import Rejection
from acquisition.decoding import DecodingOptions, decode
from acquisition.patterns import BLACK, WHITE, Axis, PhaseShift, pattern_profile
from acquisition.plan import Plan, PlannedFrame

WIDTH, HEIGHT = 320, 240


def ramp():
    col, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return 20 + 1.4 * col + 0.11 * row


def photons(plan, truth, *, mean, modulation, gain, read, seed=0):
    """Frames with Poisson light, read noise and rounding; ``gain`` sensor numbers per electron."""
    random = np.random.default_rng(seed)
    frames = {}
    for frame in plan.frames:
        level = mean + modulation * (2 * pattern_profile(frame.pattern, truth) - 1)
        electrons = random.poisson(level / gain) + random.normal(0, read, level.shape)
        frames[frame.id] = np.clip(np.round(gain * electrons), 0, 4095).astype(np.uint16)
    return frames


def plan_of_fringes(periods, steps, *, saturation=4095):
    patterns = []
    for period in periods:
        patterns += fringe_patterns(Axis.COLUMN, period=period, steps=steps)
    return make_plan(patterns, saturation=saturation)


@pytest.mark.parametrize("steps", [3, 4, 5, 8, 16])
@pytest.mark.parametrize(("modulation", "sigma"), [(300, 4), (60, 4)])
def test_spread_is_that_of_theory_and_of_the_prediction(steps, modulation, sigma):
    plan = plan_of_fringes((32.0, 128.0, 512.0), steps, saturation=1023)
    truth = ramp()
    frames = expose(plan, {Axis.COLUMN: truth}, sigma=sigma, modulation=modulation, seed=steps)
    found = decode(plan, frames.__getitem__)
    error = (found.axes[Axis.COLUMN].coordinate - truth)[found.valid]
    noise = np.sqrt(sigma**2 + 1 / 12)
    theory = np.sqrt(2 / steps) * noise / modulation * 32 / (2 * np.pi)
    assert np.std(error) < 1.05 * theory
    z = error / np.sqrt(found.axes[Axis.COLUMN].variance[found.valid])
    assert np.std(z) == pytest.approx(1, abs=0.05)
    assert abs(np.mean(z)) < 5 / np.sqrt(len(z))
    assert found.valid.mean() > 0.999
    assert np.mean(np.abs(error) > 16) < 1e-4


@pytest.mark.parametrize("steps", [4, 7])
@pytest.mark.parametrize(("mean", "modulation"), [(1800, 1700), (400, 250)])
def test_photon_noise_is_predicted(steps, mean, modulation):
    plan = plan_of_fringes((32.0, 512.0), steps)
    truth = ramp()
    light = 0.4 + 0.6 * np.linspace(0, 1, HEIGHT)[:, np.newaxis]  # so that the gain shows
    frames = photons(
        plan, truth, mean=mean * light, modulation=modulation * light, gain=0.8, read=3
    )
    found = decode(plan, frames.__getitem__)
    decoded = found.axes[Axis.COLUMN]
    error = (decoded.coordinate - truth)[found.valid]
    z = error / np.sqrt(decoded.variance[found.valid])
    assert np.std(z) == pytest.approx(1, abs=0.05)
    # Also in the darkest and the lightest part by themselves.
    for part in (slice(0, 60), slice(180, 240)):
        inside = found.valid[part]
        z = (decoded.coordinate - truth)[part][inside] / np.sqrt(decoded.variance[part][inside])
        assert np.std(z) == pytest.approx(1, abs=0.06)


@pytest.mark.parametrize("steps", [4, 5, 8])
@pytest.mark.parametrize("light", ["read noise", "photon noise"])
def test_clean_light_is_hardly_ever_called_mixed(steps, light):
    plan = plan_of_fringes((32.0, 512.0), steps)
    truth, limit = ramp(), 1e-2
    flagged = 0.0
    for seed in range(3):
        if light == "read noise":
            frames = expose(plan, {Axis.COLUMN: truth}, sigma=6, seed=seed)
        else:
            frames = photons(plan, truth, mean=400, modulation=395, gain=2, read=1, seed=seed)
        found = decode(plan, frames.__getitem__, DecodingOptions(false_alarm=limit))
        flagged += np.mean(found.rejection & Rejection.MIXED_LIGHT != 0) / 3
    assert flagged < limit
    assert flagged > 0.1 * limit  # the limit is near what noise does


def test_harmonics_of_the_projector_are_not_called_mixed_light():
    plan = plan_of_fringes((32.0, 128.0, 512.0), 6)
    truth = ramp()
    random = np.random.default_rng(0)
    frames = {}
    for frame in plan.frames:
        level = 100 + 2000 * pattern_profile(frame.pattern, truth) ** 1.8
        frames[frame.id] = np.round(level + random.normal(0, 8, level.shape)).astype(np.uint16)
    found = decode(plan, frames.__getitem__)
    assert np.mean(found.rejection & Rejection.MIXED_LIGHT != 0) < 1e-4
    assert found.valid.mean() > 0.999


@pytest.mark.parametrize("steps", [3, 8])
def test_a_second_reflection_is_called_mixed_light(steps):
    plan = plan_of_fringes((32.0, 128.0, 512.0), steps)
    truth = ramp()
    frames = expose(plan, {Axis.COLUMN: truth}, sigma=4)
    # A mirror image of another part of the panel, and a highlight that clips a part of the steps
    # below the ceiling.
    other = expose(plan, {Axis.COLUMN: truth + 150.0}, sigma=0, mean=150, modulation=120)
    for frame_id, frame in frames.items():
        frame[100:140, 100:200] += other[frame_id][100:140, 100:200]
        frame[180:200, 100:200] = np.minimum(frame[180:200, 100:200], 520)
    found = decode(plan, frames.__getitem__)
    mixed = found.rejection & Rejection.MIXED_LIGHT != 0
    rejected = found.rejection != 0
    # Where both reflections are far apart in the coarse phases, no fringe hides the other.
    assert rejected[102:138, 102:198].mean() > 0.6
    if steps > 3:
        assert mixed[182:198, 102:198].mean() > 0.95
    outside = np.ones(mixed.shape, bool)
    outside[98:142, 98:202] = outside[178:202, 98:202] = False
    assert rejected[outside].mean() < 2e-3


def bracketed(periods, steps, exposures):
    frames = []
    for period in periods:
        for exposure in exposures:
            for step in range(steps):
                pattern = PhaseShift(
                    axis=Axis.COLUMN, period_px=period, shift_rad=2 * np.pi * step / steps
                )
                frames.append((pattern, exposure))
    plan = make_plan([pattern for pattern, _ in frames], saturation=4095)
    return Plan(
        **plan.model_dump(exclude={"frames"}),
        frames=tuple(
            PlannedFrame(id=f"{n:04d}", pattern=pattern, exposure_s=exposure)
            for n, (pattern, exposure) in enumerate(frames)
        ),
    )


def expose_bracket(plan, truth, radiance, *, gain=0.5, read=4.0, seed=0):
    random = np.random.default_rng(seed)
    frames = {}
    for frame in plan.frames:
        level = radiance * frame.exposure_s * (0.05 + pattern_profile(frame.pattern, truth))
        electrons = random.poisson(level / gain) + random.normal(0, read, level.shape)
        frames[frame.id] = np.clip(np.round(gain * electrons), 0, 4095).astype(np.uint16)
    return frames


def test_exposures_are_combined_at_the_noise_of_the_best():
    exposures = (1.0, 0.25, 0.0625)
    plan = bracketed((32.0, 512.0), 4, exposures)
    truth = ramp()
    radiance = np.exp(np.linspace(np.log(300), np.log(40_000), HEIGHT))[:, np.newaxis]
    radiance = radiance * np.ones((1, WIDTH))
    frames = expose_bracket(plan, truth, radiance)
    found = decode(plan, frames.__getitem__)
    decoded = found.axes[Axis.COLUMN]
    assert found.valid.mean() > 0.995
    error = (decoded.coordinate - truth)[found.valid]
    z = error / np.sqrt(decoded.variance[found.valid])
    assert np.std(z) == pytest.approx(1, abs=0.05)
    # Half way up the picture all exposures below the first saturate nowhere; the longest alone
    # decodes only the dark part, and no better.
    longest = plan.model_copy(
        update={"frames": tuple(f for f in plan.frames if f.exposure_s == 1.0)}
    )
    alone = decode(longest, frames.__getitem__)
    assert 0.3 < alone.valid.mean() < 0.8
    both = alone.valid & found.valid
    ratio = decoded.variance[both] / alone.axes[Axis.COLUMN].variance[both]
    assert np.median(ratio) < 0.9
    assert np.percentile(ratio, 99) < 1.02
    # Levels are in sensor numbers of the longest exposure, beyond its ceiling too.
    expected = radiance / 2
    np.testing.assert_allclose(np.median(found.modulation / expected, axis=1)[20:], 1, atol=0.04)


def test_all_steps_of_a_pixel_come_from_one_exposure():
    plan = bracketed((512.0,), 4, (1.0, 0.25))
    truth = ramp()
    frames = expose_bracket(plan, truth, np.full(truth.shape, 3500.0), seed=3)
    # A single step of the long exposure saturates: none of its steps counts.
    first = plan.frames[0]
    assert first.exposure_s == 1.0
    frames[first.id][100:120] = 4095
    found = decode(plan, frames.__getitem__)
    error = (found.axes[Axis.COLUMN].coordinate - truth)[100:120]
    sigma = np.sqrt(found.axes[Axis.COLUMN].variance)
    assert not found.rejection[100:120].any()
    assert np.std(error / sigma[100:120]) == pytest.approx(1, abs=0.07)
    assert np.median(sigma[100:120]) > 1.8 * np.median(sigma[:90])


def test_gray_orders_are_shared_by_all_exposures():
    fringes = bracketed((32.0,), 4, (1.0, 0.25))
    bits = tuple(
        PlannedFrame(id=f"gray-{n}", pattern=pattern, exposure_s=exposure)
        for n, (pattern, exposure) in enumerate(
            (bit, exposure)
            for bit in gray_patterns(Axis.COLUMN, step=16.0, bits=6)
            for exposure in (1.0, 0.25)
        )
    )
    truth = ramp()
    radiance = np.exp(np.linspace(np.log(600), np.log(12_000), HEIGHT))[:, np.newaxis]
    radiance = radiance * np.ones((1, WIDTH))
    for chosen in (bits, tuple(b for b in bits if b.exposure_s == 1.0)):
        plan = fringes.model_copy(update={"frames": fringes.frames + chosen})
        frames = expose_bracket(plan, truth, radiance)
        found = decode(plan, frames.__getitem__)
        assert found.valid.mean() > 0.995
        assert np.nanmax(np.abs(found.axes[Axis.COLUMN].coordinate - truth)) < 5


@pytest.mark.parametrize("black_level", [0, 512])
@pytest.mark.parametrize("code_exposure", [1.0, 1 / 9])
def test_bits_of_another_exposure_are_held_against_its_own_light(black_level, code_exposure):
    exposures = (1.0, 1 / 3, 1 / 9)
    fringe = bracketed((24.0,), 8, exposures)
    patterns = [(flat, exposure) for flat in (WHITE, BLACK) for exposure in exposures]
    patterns += [(bit, code_exposure) for bit in gray_patterns(Axis.COLUMN, step=12.0, bits=6)]
    extra = tuple(
        PlannedFrame(id=f"x{n:03d}", pattern=pattern, exposure_s=exposure)
        for n, (pattern, exposure) in enumerate(patterns)
    )
    plan = fringe.model_copy(update={"frames": fringe.frames + extra})
    truth = ramp()
    radiance = np.exp(np.linspace(np.log(300), np.log(25_000), HEIGHT))[:, np.newaxis]
    frames = expose_bracket(plan, truth, radiance * np.ones((1, WIDTH)))
    raised = {name: np.minimum(frame + black_level, 4095) for name, frame in frames.items()}
    found = decode(plan, {n: f.astype(np.uint16) for n, f in raised.items()}.__getitem__)
    assert found.valid.mean() > 0.97
    error = (found.axes[Axis.COLUMN].coordinate - truth)[found.valid]
    assert np.abs(error).max() < 6
    # The variance is right in the dark as well, where the black level is most of the level.
    z = error / np.sqrt(found.axes[Axis.COLUMN].variance[found.valid])
    dark = (radiance * np.ones((1, WIDTH)) < 1500)[found.valid]
    assert np.std(z[dark]) == pytest.approx(1, abs=0.06)
    assert np.std(z[~dark]) == pytest.approx(1, abs=0.06)
