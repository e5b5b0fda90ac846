from __future__ import annotations

import time

import numpy as np
import pytest

from devices.aravis.device_clock import DeviceClock, clock_reader, exposure_end_s
from devices.aravis.frame_stream import frames_between
from devices.aravis.gige_vision import subnet_problem


def test_frames_are_dated_to_the_shortest_delay_without_a_reading():
    random = np.random.default_rng(1)
    clock, ours_less_theirs = DeviceClock(), 234.5
    errors = []
    for number in range(200):
        true_s = 1000 + 0.5 * number
        delay = 0.004 + random.exponential(0.01)
        dated = clock.monotonic_s(true_s - ours_less_theirs, arrived_s=true_s + delay)
        errors.append(dated - true_s)
    # Never too early, and late by little more than the shortest delay once some were seen.
    assert min(errors) >= 0.004 - 1e-9
    assert max(errors[20:]) < 0.006


def test_drift_against_our_clock_does_not_add_up():
    clock = DeviceClock()
    for minute in range(120):
        true_s = 60.0 * minute
        # 100 ppm slow: 0.7 s in two hours.
        dated = clock.monotonic_s(1 + true_s * (1 - 1e-4), arrived_s=true_s + 0.005)
        assert abs(dated - true_s) < 0.012


def test_a_reading_of_the_clock_dates_frames_exactly():
    clock = DeviceClock()
    clock.note(5.0, before_s=100.0, after_s=100.002)
    assert clock.monotonic_s(6.0, arrived_s=102.0) == pytest.approx(101.001)
    clock.forget()
    assert clock.monotonic_s(6.0, arrived_s=102.0) == 102.0
    assert clock.monotonic_s(0.0, arrived_s=102.0) is None


class ClockDevice:
    """A camera with the clock of the convention before the present one, at 125 MHz."""

    ticks_per_s = 125_000_000

    def is_feature_available(self, name):
        return name.startswith("Gev")

    def execute_command(self, name):
        assert name == "GevTimestampControlLatch"
        self._latched = int((time.monotonic() - 50.0) * self.ticks_per_s)

    def get_integer_feature_value(self, name):
        if name == "GevTimestampTickFrequency":
            return self.ticks_per_s
        return self._latched


def test_the_camera_s_clock_is_read_at_its_frequency():
    clock = DeviceClock()
    clock_reader(ClockDevice())(clock)
    now = time.monotonic()
    assert clock.monotonic_s(now - 50.0, arrived_s=now) == pytest.approx(now, abs=1e-3)

    class Clockless:
        def is_feature_available(self, name):
            return False

    assert clock_reader(Clockless()) is None


def test_the_end_of_an_exposure_lies_where_it_can():
    times = {"exposure_s": 0.5, "asked_s": 10.0}
    # A stamp at the beginning, one at the end, none, and one before anything was asked for.
    assert exposure_end_s(10.1, arrived_s=10.7, **times) == pytest.approx(10.6)
    assert exposure_end_s(10.6, arrived_s=10.7, **times) == 10.7
    assert exposure_end_s(None, arrived_s=10.7, **times) == 10.7
    assert exposure_end_s(9.0, arrived_s=10.7, **times) == 10.5


@pytest.mark.parametrize(
    ("last", "number", "step"),
    [(7, 8, 1), (7, 7, 0), (7, 10, 3), (8, 7, -1), (65535, 1, 1), (65535, 0, 1), (65534, 2, 3),
     (65535, 65536, 1), (2**40, 2**40 + 1, 1), (2**40, 1, 1 - 2**40)],
)  # fmt: skip
def test_the_count_of_frames_goes_on_across_its_wrap(last, number, step):
    assert frames_between(last, number) == step


# A card at 192.168.1.0/24, and a gateway for everything else.
ROUTES = """Iface Destination Gateway Flags RefCnt Use Metric Mask MTU Window IRTT
eth0 00000000 0101A8C0 0003 0 0 100 00000000 0 0 0
eth0 0001A8C0 00000000 0001 0 0 100 00FFFFFF 0 0 0
"""


def test_an_address_beyond_a_gateway_is_in_another_subnet():
    assert subnet_problem("192.168.1.20", ROUTES) is None
    assert subnet_problem("127.0.0.1", ROUTES) is None
    assert "another subnet" in subnet_problem("169.254.3.4", ROUTES)
    # No route at all is no better than a wrong one.
    assert "another subnet" in subnet_problem("169.254.3.4", ROUTES[:80])
    assert subnet_problem("169.254.3.4", "") is None
