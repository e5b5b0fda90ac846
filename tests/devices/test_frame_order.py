from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from devices.errors import FrameOrderError
from devices.frame_order import FrameOrder, Light, differ_beyond_noise
from devices.interfaces import ArmPose, Frame, Subject


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


@pytest.mark.parametrize("ratio", [0.25, 0.9, 1.0, 4.0])
def test_the_same_light_is_known_in_another_exposure(scene, ratio):
    fringe = scene * (0.5 + 0.4 * np.cos(np.arange(320) / 5))
    for seed in range(20):
        one = np.minimum(noisy(400 * ratio * scene, 2 * seed) + 8, 700)
        same = np.minimum(noisy(400 * scene, 2 * seed + 1) + 8, 700)
        other = np.minimum(noisy(400 * fringe, 2 * seed + 1) + 8, 700)
        options = {"exposure_ratio": ratio, "saturation_level": 700}
        assert not differ_beyond_noise(one, same, **options)
        assert differ_beyond_noise(one, other, **options)


def test_what_is_saturated_shows_no_difference(scene):
    full = np.full(scene.shape, 1023, "u2")
    assert not differ_beyond_noise(full, full, saturation_level=1023)
    # A flicker does not change what is saturated, and what is not by its share.
    one, other = (noisy(900 * f * scene, n).clip(max=700) for n, f in enumerate((1.0, 0.97)))
    assert (one == 700).mean() > 0.1
    assert not differ_beyond_noise(one, other, saturation_level=700)
    assert differ_beyond_noise(one, full.clip(max=700), saturation_level=700)


def frame(number, image, *, subject="a", exposure=0.1, ended=None):
    ended = 10.0 + number if ended is None else ended
    return Frame(image, number, exposure, exposure, ended, ended, Subject(projection=subject))


def check(order, frame, *, since=0.0, **options):
    light = Light(projection=frame.subject.projection)
    return order.check(frame, light=light, subject_since_s=since, **options)


def test_counts_and_times_must_follow(scene):
    order = FrameOrder()
    check(order, frame(1, noisy(300 * scene, 0)), since=10.5)
    with pytest.raises(FrameOrderError, match="number 3 after 1"):
        check(order, frame(3, noisy(300 * scene, 1)), since=11.0)
    with pytest.raises(FrameOrderError, match="stale: its exposure began 50 ms before"):
        check(order, frame(2, noisy(300 * scene, 1), ended=12.0), since=11.95)
    with pytest.raises(FrameOrderError, match="delivered 900 ms before its exposure began"):
        check(order, frame(2, noisy(300 * scene, 1), ended=13.0), since=11.95, delivered_s=12.0)


@pytest.mark.parametrize("changed", [{"ended": np.nan}, {"exposure": np.inf}, {"exposure": 0.0}])
def test_times_that_are_none_are_refused(scene, changed):
    with pytest.raises(FrameOrderError, match="the camera says that an exposure of"):
        check(FrameOrder(), frame(1, noisy(300 * scene, 0), **changed))


def test_an_earlier_picture_under_a_new_number_is_refused(scene):
    order = FrameOrder()
    image = noisy(300 * scene, 0)
    check(order, frame(1, image))
    check(order, frame(2, noisy(300 * scene, 1), subject="b"))
    with pytest.raises(FrameOrderError, match="frame of c is that of a over again"):
        check(order, frame(3, image.copy(), subject="c"))


def test_pictures_without_noise_may_be_alike():
    order = FrameOrder()
    black = np.zeros((60, 80), "u1")
    black[3, 4] = 200
    for number in range(1, 4):
        check(order, frame(number, black.copy(), subject=f"{number}"))


def test_pictures_are_held_against_those_of_the_light_before(scene):
    order = FrameOrder()
    pattern = scene * (0.5 + 0.4 * np.cos(np.arange(320) / 5))
    other = scene * (0.5 + 0.4 * np.cos(np.arange(320) / 9))
    shots = [
        ("a", 0.1, 300 * scene, False),  # nothing to hold it against
        ("b", 0.1, 300 * pattern, True),
        ("b", 0.4, 1200 * pattern, True),
        ("c", 0.1, 300 * pattern, False),
        ("d", 0.4, 1200 * scene, True),
        ("e", 0.1, 300 * scene, False),  # of another exposure
        ("f", 0.4, 300 * scene, False),  # a stale one of another exposure
        ("g", 0.1, 300 * other, True),
    ]
    for number, (subject, exposure, level, told) in enumerate(shots):
        taken = frame(number, noisy(level, number), subject=subject, exposure=exposure)
        assert check(order, taken) is told, subject


def test_a_light_once_accepted_needs_no_more_proof(scene):
    order = FrameOrder()
    assert not check(order, frame(1, noisy(300 * scene, 0)))
    order.accept_light()
    assert check(order, frame(2, noisy(3 * scene, 1), exposure=0.001))
    assert not check(order, frame(3, noisy(3 * scene, 2), subject="b", exposure=0.001))


def test_darkness_after_darkness_needs_no_proof(scene):
    order = FrameOrder()
    poses = (ArmPose(0.1, 0.2), ArmPose(0.3, 0.2))
    for number, position in enumerate(("left", "left", "right")):
        taken = frame(number, noisy(2 * scene, number), subject=None)
        light = Light(camera_position=position)
        assert order.check(taken, light=light, subject_since_s=0)
    lit = Light(lamp_on=True, lamp_pose=poses[0])
    assert not order.check(frame(3, noisy(2 * scene, 3)), light=lit, subject_since_s=0)
    # A lamp that went out must be seen to have done so.
    assert not order.check(frame(4, noisy(2 * scene, 4)), light=Light(), subject_since_s=0)


@pytest.mark.parametrize("light", [Light(), Light(projection="white")])
def test_a_long_recording_by_a_camera_that_measures_its_exposures_needs_no_more_memory(light):
    order = FrameOrder()
    random = np.random.default_rng(0)
    tracemalloc.start()
    try:
        for number in range(220):
            exposure = 0.1 + 1e-4 * random.random()
            image = random.integers(0, 4000, (200, 500), dtype=np.uint16)
            ended = float(number + 1)
            taken = Frame(image, number, exposure, exposure, ended, 0.0)
            order.check(taken, light=light, subject_since_s=0.0)
            if number == 20:
                before = tracemalloc.get_traced_memory()[0]
        growth = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert growth < 2 * image.nbytes


def test_a_lamp_that_fails_is_known_by_a_measured_exposure_too(scene):
    order = FrameOrder()
    dark, lamp = Light(), Light(lamp_on=True)
    order.check(frame(1, noisy(20 * scene, 1), exposure=0.1), light=dark, subject_since_s=0.0)
    darker = noisy(12 * scene * (0.5 + 0.4 * np.cos(np.arange(320) / 5)), 2)
    taken = frame(2, darker, exposure=0.1002)
    assert not order.check(taken, light=lamp, subject_since_s=0.0)
