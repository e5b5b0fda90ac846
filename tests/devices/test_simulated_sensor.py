from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy import stats

from devices.bayer import BayerPattern
from devices.errors import DeviceError
from devices.simulated.sensor import Light, Sensor

DARK = np.zeros((2, 2), np.float32)


def steady(radiance, pixels):
    """Light that does not come from the panel."""
    nowhere = np.full((pixels, 2), -1e4, np.float32)
    zero = np.zeros(pixels, np.float32)
    return Light(DARK, nowhere, zero, np.full(pixels, radiance, np.float32))


def frame(sensor, electrons, *, pixels=400_000, key=1, pattern=None):
    """Sensor numbers under light that sets free so many electrons on average."""
    pattern = pattern or sensor.fixed_pattern(pixels, seed=0)
    light = steady(electrons / sensor.rate_e_per_s, pixels)
    return sensor.expose(light, pattern, exposure_s=1.0, key=key)


def counting(**options):
    """A sensor whose numbers are the electrons themselves."""
    ideal = {"bits": 16, "gain": 1.0, "black_level": 0.0, "full_well_e": 60_000.0}
    ideal |= {"read_noise_e": 0.0, "prnu": 0.0, "dsnu_e": 0.0, "dark_e_per_s": 0.0}
    return Sensor(**(ideal | options))


@pytest.mark.parametrize("mean", [0.02, 0.7, 4.0, 9.99, 10.0, 10.5, 31.0, 250.0, 4000.0, 40_000.0])
def test_photons_follow_poisson_s_distribution(mean):
    counts = frame(counting(), mean).astype(np.float64)
    n = len(counts)
    # By the standard errors of mean, variance and skewness.
    assert abs(counts.mean() - mean) < 5 * np.sqrt(mean / n)
    variance = counts.var(ddof=1)
    assert abs(variance / mean - 1) < 5 * np.sqrt(2 / n + 1 / (mean * n))
    if mean >= 4:
        skewness = stats.skew(counts)
        assert abs(skewness - 1 / np.sqrt(mean)) < 5 * np.sqrt(6 / n)
    # And bin by bin, against SciPy's probabilities.
    edges = np.unique(stats.poisson.ppf(np.linspace(0.02, 0.98, 25), mean))
    index = np.searchsorted(edges, counts, side="left")
    observed = np.bincount(index, minlength=len(edges) + 1)
    below = stats.poisson.cdf(np.concatenate([edges, [np.inf]]), mean)
    expected = n * np.diff(below, prepend=0.0)
    keep = expected > 5
    assert (
        stats.chisquare(
            observed[keep], expected[keep] * observed[keep].sum() / expected[keep].sum()
        ).pvalue
        > 1e-4
    )


def test_read_noise_is_normal_to_its_tails():
    sensor = counting(read_noise_e=500.0, black_level=20_000.0)
    noise = (frame(sensor, 0.0, pixels=2_000_000).astype(np.float64) - 20_000) / 500
    assert stats.kstest(noise[:200_000] + 1e-3, "norm").pvalue > 1e-4
    for sigma in (2.0, 3.0, 4.0):
        share, expected = np.mean(np.abs(noise) > sigma), 2 * stats.norm.sf(sigma)
        assert abs(share - expected) < 5 * np.sqrt(expected / len(noise)) + 0.003 * expected
    # Neighbours and the same pixel of another frame know nothing of each other.
    other = frame(sensor, 0.0, pixels=2_000_000, key=2).astype(np.float64)
    for one, two in ((noise[1:], noise[:-1]), (noise, other), (noise[800:], noise[:-800])):
        assert abs(np.corrcoef(one, two)[0, 1]) < 5 / np.sqrt(len(one))


def test_the_same_frame_comes_out_of_any_number_of_threads():
    sensor = Sensor()
    before = numba.get_num_threads()
    try:
        frames = []
        for threads in {1, before}:
            numba.set_num_threads(threads)
            frames.append(frame(sensor, 300.0, pixels=50_001))
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(frames[0], frames[-1])


@pytest.mark.parametrize(
    ("bits", "read", "well", "black"),
    [(10, 8.0, 10_000.0, 8.0), (12, 12.0, 10_000.0, 64.0), (14, 3.5, 32_000.0, 200.0)],
)
def test_photon_transfer_gives_gain_read_noise_and_full_well_back(bits, read, well, black):
    """By differences of two frames, which the fixed pattern drops out of."""
    sensor = Sensor(
        **{"bits": bits, "read_noise_e": read, "full_well_e": well, "black_level": black},
        **{"prnu": 0.02, "dark_e_per_s": 0.0},
    )
    pattern = sensor.fixed_pattern(400_000, seed=3)
    levels = [0.0, *np.geomspace(20, 0.8 * well, 12)]
    means, variances = [], []
    for number, electrons in enumerate(levels):
        pair = [
            frame(sensor, electrons, key=100 * number + k, pattern=pattern).astype(np.float64)
            for k in range(2)
        ]
        means.append(np.mean(pair) - black)
        # Quantisation adds a twelfth.
        variances.append(np.var(pair[0] - pair[1]) / 2 - 1 / 12)
    weight = 1 / np.array(variances)
    gain, _ = np.polyfit(means, variances, 1, w=weight)
    assert gain == pytest.approx(sensor.numbers_per_electron, rel=0.02)
    assert np.sqrt(variances[0]) / gain == pytest.approx(read, rel=0.02)
    full = frame(sensor, 3 * well, pattern=pattern).astype(np.float64)
    assert (full.mean() - black) / gain == pytest.approx(well, rel=0.02)
    assert sensor.saturation_level == sensor.ceiling


def test_the_fixed_pattern_is_that_of_the_sensor():
    sensor = Sensor(
        bits=16, full_well_e=60_000.0, prnu=0.02, dsnu_e=6.0, read_noise_e=2.0, black_level=100.0
    )
    pattern = sensor.fixed_pattern(100_000, seed=5)

    def average(electrons):
        shots = (
            frame(sensor, electrons, pixels=100_000, key=k, pattern=pattern) for k in range(40)
        )
        return np.mean(list(shots), axis=0)

    bright, dark = average(3e4), average(0.0)
    signal = (bright - dark) / np.mean(bright - dark)
    assert np.std(signal) == pytest.approx(0.02, rel=0.05)
    assert np.std(dark) / sensor.numbers_per_electron == pytest.approx(6.0, rel=0.05)
    same = sensor.fixed_pattern(100_000, seed=5)
    np.testing.assert_array_equal(same.sensitivity, pattern.sensitivity)
    assert (sensor.fixed_pattern(100_000, seed=6).offset_e != pattern.offset_e).any()


def test_a_well_that_fills_before_the_converter_saturates_below_full_scale():
    sensor = Sensor(bits=12, gain=0.2, full_well_e=10_000.0, black_level=32.0)
    full = frame(sensor, 1e6)
    assert full.mean() == pytest.approx(32 + 2000, abs=1)
    assert sensor.saturation_level < 2032
    assert (full >= sensor.saturation_level).mean() > 0.999
    assert (frame(sensor, 8000.0) < sensor.saturation_level).all()


@pytest.mark.parametrize(("bits", "kind"), [(8, np.uint8), (10, np.uint16), (16, np.uint16)])
def test_samples_have_the_type_of_their_depth_and_stop_at_the_ceiling(bits, kind):
    sensor = Sensor(bits=bits)
    image = frame(sensor, 1e9, pixels=400)
    assert image.dtype == kind
    assert sensor.saturation_level == 2**bits - 1
    assert (image == sensor.saturation_level).all()


def test_a_mosaic_weighs_colours_by_its_pattern():
    mono = Sensor().weights((1.0, 1.0, 1.0))
    assert np.ptp(mono.sum(axis=2)) == 0
    assert mono.sum(axis=2)[0, 0] == pytest.approx(1.0)
    weights = Sensor(bayer=BayerPattern.GBRG).weights((1.0, 0.5, 1.0))
    assert weights[0, 1].argmax() == 2
    assert weights[1, 0].argmax() == 0
    np.testing.assert_array_equal(weights[0, 0], weights[1, 1])
    assert weights[0, 0, 1] == pytest.approx(0.44)


def test_light_of_another_size_is_refused():
    sensor = Sensor()
    with pytest.raises(DeviceError, match="100 pixels meets a sensor of 50"):
        frame(sensor, 1.0, pixels=100, pattern=sensor.fixed_pattern(50, seed=0))


@pytest.mark.parametrize("wrong", [{"bits": 7}, {"bits": 17}, {"black_level": 600.0}])
def test_impossible_sensors_are_refused(wrong):
    with pytest.raises(DeviceError, match=r"simulated sensor|black level"):
        Sensor(**wrong)
