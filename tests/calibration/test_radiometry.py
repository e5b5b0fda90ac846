from __future__ import annotations

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.flat_field import measure_flat_field
from calibration.photon_transfer import FlatPair, measure_photon_transfer

GAIN, READ_E, BLACK, FULL_E, BITS = 0.35, 8.0, 64.0, 9000.0, 12
SHAPE = (120, 160)
EXPOSURES = (0.002, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16)
RATE_E = 80_000.0


def expose(exposure_s, random, *, shape=SHAPE, pattern=0.01, gain=1.0, curve=0.0):
    """Sensor numbers of even light: photons, full well, read noise, gain, quantisation."""
    sensitivity = 1 + pattern * np.random.default_rng(99).standard_normal(shape)
    electrons = random.poisson(RATE_E * exposure_s * sensitivity * gain, shape)
    held = np.minimum(electrons, FULL_E)
    held = held * (1 - curve * held / FULL_E) + random.normal(0, READ_E, shape)
    held = np.where(electrons >= FULL_E, FULL_E, held)
    return np.clip(np.round(BLACK + GAIN * held), 0, 2**BITS - 1).astype(np.uint16)


def frames(seed, **extra):
    random = np.random.default_rng(seed)
    pairs = [FlatPair(t, expose(t, random, **extra), expose(t, random, **extra)) for t in EXPOSURES]
    return pairs, [expose(0.0, random) for _ in range(4)]


def test_a_sensor_is_measured_with_its_errors():
    found = [measure_photon_transfer(*frames(seed)) for seed in range(25)]
    for name, true in (("gain", GAIN), ("read_noise_e", READ_E), ("black_level", BLACK)):
        values = [getattr(one, name) for one in found]
        white = [(value.value - true) / value.sigma for value in values]
        assert np.sqrt(np.mean(np.square(white))) == pytest.approx(1, abs=0.4), name
    assert found[0].saturation_level == pytest.approx(BLACK + GAIN * FULL_E, abs=1)
    assert found[0].full_well_e.value == pytest.approx(FULL_E, rel=0.02)
    assert np.mean([one.excess for one in found]) == pytest.approx(1, abs=0.3)
    rate = found[0].rate
    assert abs(rate.value - GAIN * RATE_E) < 5 * rate.sigma + 1e-3 * GAIN * RATE_E


def test_the_noise_model_is_that_of_decoding():
    noise = measure_photon_transfer(*frames(3)).sample_noise()
    true = GAIN * 1000 + (GAIN * READ_E) ** 2 + 1 / 12
    assert noise.variance(np.array([1000.0]))[0] == pytest.approx(true, rel=0.02)


def test_a_sensor_that_is_not_linear_shows():
    straight = measure_photon_transfer(*frames(4))
    bent = measure_photon_transfer(*frames(4, curve=0.05))
    significant = np.abs(bent.nonlinearity) > 5 * bent.nonlinearity_sigma
    assert significant.any()
    assert np.abs(straight.nonlinearity).max() < 0.01 < np.abs(bent.nonlinearity).max()


def test_without_bright_frames_saturation_is_unknown():
    pairs, darks = frames(5)
    found = measure_photon_transfer(pairs[:5], darks)
    assert found.saturation_level is None
    assert found.full_well_e is None


def test_frames_that_tell_nothing_are_refused():
    pairs, darks = frames(6)
    same = [FlatPair(p.exposure_s, p.first, p.first) for p in pairs]
    even = np.full(SHAPE, 500, np.uint16)
    smooth = [FlatPair(p.exposure_s, even + n, even + n) for n, p in enumerate(pairs)]
    broken = np.full(SHAPE, np.nan)
    for wrong, dark, message in (
        (pairs[:2], darks, "levels or more"),
        (pairs, darks[:1], "two or more"),
        (same, darks, "the same one"),
        (smooth, darks, "does not grow"),
        ([FlatPair(p.exposure_s, p.first[:50], p.second[:50]) for p in pairs], darks, "one size"),
        ([*pairs, FlatPair(1.0, broken, broken)], darks, "not finite"),
        ([*pairs, FlatPair(-1.0, pairs[0].first, pairs[0].second)], darks, "exposure times"),
        (pairs[-1:] * 4, darks, "below saturation"),
    ):
        with pytest.raises(CalibrationError, match=message):
            measure_photon_transfer(wrong, dark)


def vignette(shape=SHAPE, centre=(90.0, 55.0), coefficients=(-0.3, 0.08, -0.02)):
    col, row = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    squared = ((col - centre[0]) ** 2 + (row - centre[1]) ** 2) / (
        0.25 * (shape[0] ** 2 + shape[1] ** 2)
    )
    return 1 + sum(a * squared ** (n + 1) for n, a in enumerate(coefficients))


def test_vignetting_and_pattern_are_found_with_their_errors():
    true = vignette()
    pixels = np.stack(np.meshgrid([0.0, 80, 159], [0.0, 60, 119]), axis=-1)
    expected = true[np.ix_([0, 60, 119], [0, 80, 159])]
    white = []
    for seed in range(20):
        random = np.random.default_rng(seed)
        shots = [expose(0.05, random, gain=true, pattern=0.01) for _ in range(6)]
        field = measure_flat_field(shots, black=BLACK)
        white.append((field.centre - (90.0, 55.0)) / field.centre_sigma)
        np.testing.assert_allclose(field.gain(pixels), expected, atol=0.02)
    # The pattern is the same in all of them: its error is one draw.
    assert np.abs(np.mean(white, axis=0)).max() < 4
    assert field.fixed_pattern == pytest.approx(0.01, abs=5 * field.fixed_pattern_sigma + 3e-4)
    assert (field.gain_sigma(pixels) < 0.02).all()
    even = field.corrected(np.mean(shots, axis=0) - BLACK)
    assert even[:20].mean() == pytest.approx(even[50:70].mean(), rel=0.01)


def test_vignetting_errs_as_much_as_predicted():
    true, white = vignette(), []
    pixels = np.stack(np.meshgrid([5.0, 80, 150], [5.0, 60, 110]), axis=-1)
    expected = true[np.ix_([5, 60, 110], [5, 80, 150])]
    for seed in range(30):
        random = np.random.default_rng(1000 + seed)
        shots = [expose(0.05, random, gain=true, pattern=0.0) for _ in range(4)]
        field = measure_flat_field(shots, black=BLACK)
        white.append(((field.gain(pixels) - expected) / field.gain_sigma(pixels))[0, 0])
        white.append((field.centre - (90.0, 55.0))[0] / field.centre_sigma[0])
    assert np.sqrt(np.mean(np.square(white))) == pytest.approx(1, abs=0.35)


def test_flat_frames_that_tell_nothing_are_refused():
    shot = expose(0.05, np.random.default_rng(0))
    for wrong, message in (
        ([shot], "two or more"),
        ([shot, shot[:50]], "one size"),
        ([shot[:8], shot[:8]], "pixels wide"),
        ([np.zeros(SHAPE)] * 2, "black"),
        ([np.full(SHAPE, np.nan)] * 2, "finite"),
    ):
        with pytest.raises(CalibrationError, match=message):
            measure_flat_field(wrong, black=BLACK)
    field = measure_flat_field([shot, expose(0.05, np.random.default_rng(1))], black=BLACK)
    with pytest.raises(CalibrationError, match="the flat field is of"):
        field.corrected(np.zeros((10, 10)))
