from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import pytest

from devices.errors import DeviceError
from devices.hdmi.latency import Latency, measure_latency
from devices.interfaces import CameraCapabilities, Frame, ProjectorCapabilities

EXPOSURE_S = 0.08


class LateProjector:
    """Its light changes a known time after the flip that it reports, give or take a jitter."""

    def __init__(self, latency_s: float, jitter_s: float = 0.0, seed: int = 0) -> None:
        self.capabilities = ProjectorCapabilities("late", 16, 12, 1 / 60)
        self.lock = threading.Lock()
        self.changes = [(0.0, 0.0)]
        self.blanked = False
        self._latency_s, self._jitter_s = latency_s, jitter_s
        self._random = np.random.default_rng([seed, 1])

    def show(self, projection, *, deadline=None):
        with self.lock:
            shown = time.monotonic()
            delay = self._latency_s + self._random.normal(0.0, self._jitter_s)
            self.changes.append((shown + delay, projection.image.mean() / 255))
        return shown

    def blank(self):
        self.blanked = True

    def close(self):
        pass

    def mean_light(self, begin: float, end: float) -> float:
        with self.lock:
            changes = [*self.changes, (np.inf, 0.0)]
        light = 0.0
        for (since, level), (until, _) in pairwise(changes):
            light += level * max(0.0, min(until, end) - max(since, begin))
        return light / (end - begin)


class Witness:
    """A camera that integrates the projector's light, with noise and a lag of its shutter."""

    def __init__(self, projector, *, lag_s=0.0, noise=2.0, gain=150.0, seed=0) -> None:
        self.capabilities = CameraCapabilities("witness", 24, 16, 255, (1e-4, 10.0))
        self._projector, self._lag_s, self._noise, self._gain = projector, lag_s, noise, gain
        self._random = np.random.default_rng([seed, 2])
        self._sequence = 0
        self._sees = np.zeros((16, 24))
        self._sees[4:12, 6:20] = self._random.uniform(0.7, 1.0, (8, 14))

    def capture(self, exposure_s, *, deadline=None):
        time.sleep(self._lag_s)
        begin = time.monotonic()
        time.sleep(exposure_s)
        light = 10 + self._gain * self._sees * self._projector.mean_light(begin, begin + exposure_s)
        image = light + self._random.normal(0.0, self._noise, light.shape)
        self._sequence += 1
        return Frame(
            np.clip(np.round(image), 0, 255).astype(np.uint8),
            self._sequence,
            exposure_s,
            exposure_s,
            begin + exposure_s,
            time.time(),
        )

    def close(self):
        pass


def measure(seed: int, latency_s: float, jitter_s: float, lag_s: float = 0.0) -> Latency:
    projector = LateProjector(latency_s, jitter_s, seed)
    camera = Witness(projector, lag_s=lag_s, seed=seed)
    return measure_latency(camera, projector, exposure_s=EXPOSURE_S, steps=16, seed=seed)


def test_a_known_latency_is_recovered_within_its_error_bar_over_many_seeds():
    latency_s, jitter_s = 0.013, 0.001
    with ThreadPoolExecutor(24) as many:
        found = list(many.map(lambda seed: measure(seed, latency_s, jitter_s), range(24)))
    pulls = np.array([(each.delay_s - latency_s) / each.standard_error_s for each in found])
    assert abs(pulls.mean()) < 4 / np.sqrt(len(pulls))
    assert 0.5 < np.sqrt(np.mean(pulls**2)) < 1.7
    spread = np.sqrt(np.mean([each.spread_s**2 for each in found]))
    # A mean level of 112 pixels with a noise of 2 in a contrast of 127 adds 0.07 ms.
    assert spread == pytest.approx(np.hypot(jitter_s, 0.07e-3), rel=0.15)
    assert all(each.delay_s < each.safe_s < latency_s + 6 * jitter_s for each in found)


@pytest.mark.parametrize("lag_s", [0.0, 0.07])
def test_the_moment_of_the_change_follows_a_camera_with_a_lag(lag_s):
    found = measure(3, 0.02, 0.0005, lag_s)
    assert found.steps >= 16
    assert abs(found.delay_s - 0.02) < 5 * found.standard_error_s


def test_a_camera_that_does_not_see_the_projector_is_told():
    projector = LateProjector(0.01)
    camera = Witness(projector, gain=0.0)
    with pytest.raises(DeviceError, match="does not see the projector"):
        measure_latency(camera, projector, exposure_s=0.01, steps=4)
    assert projector.blanked


def test_a_saturated_camera_is_told():
    projector = LateProjector(0.01)
    with pytest.raises(DeviceError, match="saturated at 255"):
        measure_latency(Witness(projector, gain=900.0), projector, exposure_s=0.01, steps=4)


def test_changes_that_never_fall_into_an_exposure_are_told():
    projector = LateProjector(0.0)
    camera = Witness(projector)
    show = projector.show
    calls = 0

    def ever_later(projection, *, deadline=None):
        nonlocal calls
        calls += 1
        if calls > 3:
            # No change ever falls into an exposure: the light stays as it is.
            return time.monotonic()
        return show(projection)

    projector.show = ever_later
    with pytest.raises(DeviceError, match="fell into their exposure"):
        measure_latency(camera, projector, exposure_s=0.01, steps=4)


def test_exposures_that_the_camera_cannot_make_and_too_few_steps_are_refused():
    projector = LateProjector(0.0)
    with pytest.raises(DeviceError, match="outside what witness can do"):
        measure_latency(Witness(projector), projector, exposure_s=11.0)
    with pytest.raises(DeviceError, match="4 or more"):
        measure_latency(Witness(projector), projector, exposure_s=0.01, steps=3)


def test_a_latency_reads_in_milliseconds():
    latency = Latency(0.0123, 0.0002, 0.001, 20)
    assert str(latency) == "12.30 ± 0.20 ms (single steps ± 1.00 ms, 20 steps)"
    assert latency.safe_s == pytest.approx(0.0123 + 3 * np.hypot(0.001, 0.0002))
