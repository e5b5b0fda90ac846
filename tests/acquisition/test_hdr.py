from __future__ import annotations

import numpy as np
import pytest

from acquisition.errors import DecodingError
from acquisition.exposure_ratios import (
    estimate_exposures,
    fit_york_line,
    measure_saturation_level,
)
from acquisition.hdr import merge_bracket, variance_bound
from acquisition.sample_noise import SampleNoise

FULL_WELL, BITS, READ_E, BLACK = 10_000.0, 10, 8.0, 8.0
CEILING = 2**BITS - 1
GAIN = CEILING / FULL_WELL
NOISE = SampleNoise((READ_E * GAIN) ** 2 + 1 / 12, GAIN, "calibrated")
KNOWN = {"noise": NOISE, "black_level": BLACK, "saturation_level": CEILING}


def expose(radiance, exposure, random):
    """A linear sensor written down independently of the simulated rig."""
    electrons = random.poisson(np.minimum(radiance * exposure / GAIN, 5 * FULL_WELL))
    numbers = (electrons + random.normal(0, READ_E, radiance.shape)) * GAIN + BLACK
    return np.clip(np.round(numbers), 0, CEILING).astype(np.uint16)


@pytest.mark.parametrize("decade", range(-1, 3))
def test_a_merge_reaches_the_noise_bound_in_every_decade(decade):
    random = np.random.default_rng(decade + 1)
    times = [1.0, 4.0, 16.0]
    rows = np.logspace(decade, min(decade + 1, 2.97), 300)
    radiance = np.broadcast_to(rows[:, np.newaxis], (300, 4000))
    merged = merge_bracket([expose(radiance, t, random) for t in times], times, **KNOWN)
    bound = variance_bound(rows, times, **KNOWN)
    estimate = merged.radiance.astype(np.float64)
    assert (estimate.var(axis=1) / bound).mean() < 1.05
    assert np.median(merged.variance.mean(axis=1) / estimate.var(axis=1)) == pytest.approx(
        1, abs=0.03
    )
    scatter = np.sqrt(np.mean(bound / rows**2) / estimate.size)
    assert abs((estimate.mean(axis=1) / rows - 1).mean()) < 0.002 + 4 * scatter


def test_a_pixel_saturated_throughout_is_said_to_be_unknown():
    frames = [np.full((2, 3), CEILING, np.uint16), np.full((2, 3), CEILING, np.uint16)]
    frames[0][0, 0] = 500
    merged = merge_bracket(frames, [1.0, 4.0], **KNOWN)
    assert merged.samples.tolist() == [[1, 0, 0], [0, 0, 0]]
    assert merged.radiance[0, 0] == pytest.approx(492)
    assert np.isnan(merged.radiance[1, 2])
    assert merged.variance[1, 2] == np.inf
    assert variance_bound(1e6, [1.0, 4.0], **KNOWN) == np.inf


def test_the_order_of_a_bracket_does_not_matter():
    random = np.random.default_rng(0)
    radiance = random.uniform(1, 900, (40, 50))
    times = [1.0, 4.0, 16.0]
    frames = [expose(radiance, t, random) for t in times]
    one = merge_bracket(frames, times, **KNOWN)
    other = merge_bracket(frames[::-1], times[::-1], **KNOWN)
    np.testing.assert_array_equal(one.radiance, other.radiance)


@pytest.mark.parametrize(
    ("frames", "times"),
    [
        ([], []),
        ([np.zeros((2, 2), np.uint16)], [1.0, 2.0]),
        ([np.zeros((2, 2), np.uint16)], [0.0]),
        ([np.zeros((2, 2), np.uint16)], [np.nan]),
        ([np.zeros((2, 2), np.uint16), np.zeros((3, 2), np.uint16)], [1.0, 2.0]),
    ],
)
def test_brackets_that_make_no_sense_are_refused(frames, times):
    with pytest.raises(DecodingError):
        merge_bracket(frames, times, **KNOWN)


def scene(random, shape=(480, 640)):
    """Paint with blobs of every brightness, and hard edges."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    smooth = np.exp(2.2 * np.sin(x / 60) * np.cos(y / 45) + 0.8 * np.sin((x + 2 * y) / 17))
    return 60 * smooth * np.where((x // 37 + y // 29) % 2, 1.0, 0.4)


@pytest.mark.parametrize("lies", [(0.85, 1.15), (1.15, 0.85), (0.87, 1.0), (1.0, 1.0)])
def test_exposures_that_the_camera_lies_about_are_recovered(lies):
    nominal = np.array([1.0, 4.0, 16.0])
    true = nominal * [*lies, 1.0]
    pulls = []
    for seed in range(6):
        random = np.random.default_rng(seed)
        frames = [expose(scene(random), t, random) for t in true]
        found = estimate_exposures(frames, nominal, **KNOWN)
        relative = found.exposures_s / true - 1
        assert np.abs(relative).max() < 0.005
        pulls.extend(relative[:2] / found.relative_error[:2])
        assert abs(found.black_level - BLACK) < 5 * found.black_level_error
    assert 0.4 < np.std(pulls) < 1.7


def test_exposures_without_overlap_are_refused():
    random = np.random.default_rng(0)
    radiance = np.full((64, 64), 500.0)
    frames = [expose(radiance, t, random) for t in (0.5, 50.0)]
    with pytest.raises(DecodingError, match="too little in common"):
        estimate_exposures(frames, [0.5, 50.0], **KNOWN)


def test_one_colour_of_a_mosaic_that_is_saturated_leaves_the_others():
    random = np.random.default_rng(0)
    radiance = scene(random)
    # Green, twice in each square of four.
    radiance[0::2, 1::2] *= 1e4
    radiance[1::2, 0::2] *= 1e4
    true = np.array([0.85 * 4, 16.0])
    frames = [expose(radiance, t, random) for t in true]
    assert (frames[0][0::2, 1::2] == CEILING).all()
    found = estimate_exposures(frames, [4.0, 16.0], **KNOWN)
    assert found.exposures_s / true == pytest.approx([1, 1], abs=0.005)


@pytest.mark.parametrize("grey", [0.0, 30.0])
def test_one_grey_tells_no_ratio(grey):
    for seed in range(5):
        random = np.random.default_rng(seed)
        frames = [expose(np.full((160, 240), grey), t, random) for t in (4.0, 16.0)]
        with pytest.raises(DecodingError, match="one grey in common"):
            estimate_exposures(frames, [4.0, 16.0], **KNOWN)


@pytest.mark.parametrize("gain", [0.0, 0.5])
def test_a_sensor_said_to_be_without_noise_makes_no_nan(gain):
    frames = [np.full((2, 2), int(BLACK), np.uint16), np.full((2, 2), int(BLACK) + 8, np.uint16)]
    silent = KNOWN | {"noise": SampleNoise(0.0, gain, "none")}
    merged = merge_bracket(frames, [1.0, 4.0], **silent)
    assert np.isfinite(merged.radiance).all()
    assert (merged.variance > 0).all()


def test_a_york_line_is_not_flattened_by_noise_in_x():
    random = np.random.default_rng(1)
    slopes, errors = [], []
    for _ in range(200):
        x = random.uniform(0, 10, 80)
        line = fit_york_line(
            x + random.normal(0, 1.5, 80),
            3 * x - 2 + random.normal(0, 2.0, 80),
            np.full(80, 1.5**2),
            np.full(80, 2.0**2),
        )
        slopes.append(line.slope)
        errors.append(line.slope_error)
    assert np.mean(slopes) == pytest.approx(3, abs=4 * np.std(slopes) / np.sqrt(200))
    assert np.std(slopes) / np.mean(errors) == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("clip", [CEILING, 990])
def test_the_saturation_level_is_where_samples_pile_up(clip):
    random = np.random.default_rng(0)
    image = expose(scene(random), 12.0, random)
    assert measure_saturation_level([np.minimum(image, clip)]) == clip
    assert measure_saturation_level([expose(scene(random) / 400, 1.0, random)]) is None
