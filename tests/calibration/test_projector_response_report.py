from __future__ import annotations

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.projector_response import report_response

LEVELS = np.linspace(0, 1, 9)
TOP = 1000


def greys(gamma=2.2, *, seed=0, frames=4, flicker=0.002, levels=LEVELS):
    random = np.random.default_rng(seed)
    reflects = np.random.default_rng(1).uniform(0.4, 0.9, (40, 50))
    shown = {}
    for level in levels:
        light = 0.01 + 0.99 * level**gamma
        shown[float(level)] = [
            TOP * reflects * light * (1 + random.normal(0, flicker))
            + random.normal(0, 2, reflects.shape)
            for _ in range(frames)
        ]
    return shown


def test_the_response_and_its_exponent_are_found_with_their_errors():
    white, gammas = [], []
    for seed in range(40):
        report = report_response(greys(seed=seed), saturation_level=TOP)
        inner = slice(1, -1)
        white.append((report.light[inner] - LEVELS[inner] ** 2.2) / report.sigma[inner])
        gammas.append((report.gamma.value - 2.2) / report.gamma.sigma)
    assert np.sqrt(np.mean(np.square(white))) == pytest.approx(1, abs=0.2)
    assert np.sqrt(np.mean(np.square(gammas))) == pytest.approx(1, abs=0.25)
    assert report.deviation < 0.005


def test_harmonics_shrink_with_steps_and_by_compensation():
    report = report_response(greys(), saturation_level=TOP)
    few, many = report.harmonics(steps=3)[0], report.harmonics(steps=8)[0]
    assert few.value > 0.1
    assert many.value < 0.01
    left = report.harmonics(steps=3, compensated=True)[0]
    assert left.value < 0.05 * few.value
    assert 0 < few.sigma < 0.01


def test_a_linear_projector_has_no_harmonics():
    report = report_response(greys(1.0), saturation_level=TOP)
    assert report.gamma.value == pytest.approx(1.0, abs=5 * report.gamma.sigma)
    assert report.harmonics(steps=4)[0].value < 0.01


def test_greys_that_tell_nothing_are_refused():
    good = greys()
    falling = {level: good[float(LEVELS[-1 - n])] for n, level in enumerate(good)}
    few = {level: frames for n, (level, frames) in enumerate(good.items()) if n % 4 == 0}
    broken = dict(good) | {0.5: [np.full((40, 50), np.nan)] * 2}
    single = dict(good) | {0.5: good[0.5][:1]}
    for wrong, message in (
        (few, "evenly from 0 to 1"),
        (single, "two frames"),
        (broken, "not finite"),
        (falling, "lit and not saturated"),
        (dict(good) | {0.25: good[0.75]}, "does not rise"),
    ):
        with pytest.raises(CalibrationError, match=message):
            report_response(wrong, saturation_level=TOP)
    with pytest.raises(CalibrationError, match="3 or more"):
        report_response(good, saturation_level=TOP).harmonics(steps=2)
