from __future__ import annotations

import numpy as np
import pytest

from devices.errors import FrameOrderError
from devices.frame_order import FrameOrder, differ_beyond_noise
from devices.interfaces import Frame, Subject


def noisy(level, seed):
    random = np.random.default_rng(seed)
    return np.round(random.poisson(level) + random.normal(0, 3, level.shape)).clip(0).astype("u2")


@pytest.fixture(scope="module")
def scene():
    """Reflectance of a scene, (rows, cols), smooth with edges."""
    y, x = np.mgrid[:240, :320]
    return 0.5 + 0.3 * np.sin(x / 17) * np.cos(y / 23) + 0.15 * ((x // 40 + y // 30) % 2)


@pytest.mark.parametrize("flicker", [0.97, 1.0, 1.03])
def test_noise_and_flicker_are_no_change(scene, flicker):
    for seed in range(40):
        assert not differ_beyond_noise(
            noisy(300 * scene, 2 * seed), noisy(300 * flicker * scene, 2 * seed + 1)
        )


@pytest.mark.parametrize("period", [4.0, 5.33, 8.0, 16.0, 60.0, 400.0])
@pytest.mark.parametrize("along", [0, 1])
def test_the_next_phase_step_is_a_change(scene, period, along):
    at = np.mgrid[:240, :320][along]
    for seed in range(5):
        pictures = [
            noisy(300 * scene * (0.5 + 0.3 * np.cos(2 * np.pi * (at / period + k / 12))), seed + k)
            for k in range(2)
        ]
        assert differ_beyond_noise(*pictures)


def test_light_that_reaches_one_pixel_in_a_hundred_is_a_change(scene):
    dark = np.full(scene.shape, 2.0)
    lit = dark.copy()
    lit[100:124, 200:232] += 60
    assert differ_beyond_noise(noisy(lit, 0), noisy(dark, 1))


def frame(number, image, *, subject="a", exposure=0.1, ended=None):
    ended = 10.0 + number if ended is None else ended
    return Frame(image, number, exposure, exposure, ended, ended, Subject(projection=subject))


def test_counts_and_times_must_follow(scene):
    order = FrameOrder()
    order.check(frame(1, noisy(300 * scene, 0)), subject_since_s=10.5)
    with pytest.raises(FrameOrderError, match="number 3 after 1"):
        order.check(frame(3, noisy(300 * scene, 1)), subject_since_s=11.0)
    with pytest.raises(FrameOrderError, match="stale: its exposure began 50 ms before"):
        order.check(frame(2, noisy(300 * scene, 1), ended=12.0), subject_since_s=11.95)


def test_the_same_picture_under_a_new_number_is_refused(scene):
    order = FrameOrder()
    image = noisy(300 * scene, 0)
    order.check(frame(1, image), subject_since_s=0)
    with pytest.raises(FrameOrderError, match="over again"):
        order.check(frame(2, image.copy(), subject="b"), subject_since_s=0)


def test_pictures_are_compared_with_the_last_of_their_own_exposure(scene):
    order = FrameOrder()
    pattern = scene * (0.5 + 0.4 * np.cos(np.arange(320) / 5))
    shots = [
        (1, "a", 0.1, 300 * scene, True),
        (2, "a", 0.4, 1200 * scene, True),
        (3, "b", 0.1, 300 * pattern, True),
        (4, "b", 0.4, 1200 * pattern, True),
        (5, "c", 0.1, 300 * pattern, False),
        (6, "c", 0.4, 1200 * scene, True),
    ]
    for number, subject, exposure, level, changed in shots:
        taken = frame(number, noisy(level, number), subject=subject, exposure=exposure)
        assert order.check(taken, subject_since_s=0) is changed
