"""The projector's response: measured on greys and by fringes, and compensated."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from acquisition.errors import DecodingError, SessionError
from acquisition.fringes import find_fringes
from acquisition.harmonics import series_along_lines
from acquisition.patterns import Axis, Gray, PhaseShift, Uniform, pattern_image
from acquisition.plan import Plan
from acquisition.projector_response import ProjectorResponse, phase_error_of
from acquisition.response_measurement import (
    FringeEvidence,
    measure_response,
    response_of_fringes,
)
from acquisition.scan_plan import plan_greys, plan_structured_light

SIZE = {"camera_size": (60, 50), "projector_size": (640, 400), "saturation_level": 4095}


def power(gamma, points=33):
    light = tuple(float(v) for v in np.linspace(0, 1, points) ** gamma)
    return ProjectorResponse(light=light)


def light_of_panel(image, gamma):
    return (image / 255.0) ** gamma


@pytest.mark.parametrize("gamma", [0.6, 1.0, 2.2])
def test_a_compensated_fringe_is_a_sinusoid_in_light(gamma):
    pattern = PhaseShift(axis=Axis.COLUMN, period_px=40.0, shift_rad=0.7)
    image = pattern_image(pattern, width=640, height=4, response=power(gamma))
    spectrum = np.abs(np.fft.rfft(light_of_panel(image[0], gamma))) / 320
    harmonics = spectrum[16::16]
    assert harmonics[0] == pytest.approx(0.5, abs=0.006)
    # Rounding to 256 levels, which is coarse where the response is steep.
    assert harmonics[1:].max() < 0.004


def test_what_is_black_or_white_only_is_shown_as_it_is():
    for pattern in (
        Gray(axis=Axis.ROW, bit=1, bits=4, step_px=20.0),
        Uniform(level=0.5),
        Uniform(level=1.0),
    ):
        plain = pattern_image(pattern, width=30, height=40)
        assert (pattern_image(pattern, width=30, height=40, response=power(2.2)) == plain).all()


@pytest.mark.parametrize("light", [(0.0, 1.0), (0.0, 0.1, 1.0), (0.0, 0.7, 0.75, 1.0)])
def test_levels_and_light_are_inverse(light):
    response = ProjectorResponse(light=light)
    wanted = np.linspace(0, 1, 101)
    assert response.light_of(response.level_of(wanted)) == pytest.approx(wanted, abs=2e-3)
    assert response.light_of(np.linspace(0, 1, len(light))) == pytest.approx(light)


@pytest.mark.parametrize(
    "light", [(0.0, 0.5, 0.4, 1.0), (0.1, 1.0), (0.0, 0.9), (0.0,), (0.0, float("nan"), 1.0)]
)
def test_a_response_that_is_none_is_refused(light):
    with pytest.raises(ValidationError):
        ProjectorResponse(light=light)


def greys(gamma, plan, *, scene=None, noise=3.0, seed=0):
    random = np.random.default_rng(seed)
    albedo = random.uniform(0.05, 1, (50, 60)) if scene is None else scene
    frames = {}
    for frame in plan.frames:
        shown = round(255 * frame.pattern.level) / 255
        level = 40 + frame.exposure_s * (800 + 50_000 * albedo * shown**gamma)
        numbers = np.round(level + random.normal(0, noise, albedo.shape))
        frames[frame.id] = np.clip(numbers, 0, 4095).astype(np.uint16)
    return frames


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_greys_tell_the_response(gamma):
    # At the longer exposure most of the scene is saturated, and what is not tells enough.
    plan = plan_greys(**SIZE, exposure_s=(0.03, 0.3), greys=17)
    response = measure_response(plan, greys(gamma, plan).__getitem__)
    level = np.linspace(0, 1, 200)
    assert np.abs(response.light_of(level) - level**gamma).max() < 0.002


def test_greys_that_tell_nothing_are_refused():
    plan = plan_greys(**SIZE, exposure_s=(0.03,), greys=9)
    dark = greys(1.0, plan, scene=np.zeros((50, 60)))
    with pytest.raises(DecodingError, match="lit well and not saturated"):
        measure_response(plan, dark.__getitem__)
    frames = greys(1.0, plan)
    order = [f.id for f in plan.frames]
    swapped = frames | {order[4]: frames[order[7]], order[7]: frames[order[4]]}
    with pytest.raises(DecodingError, match="darker than the one before"):
        measure_response(plan, swapped.__getitem__)
    fewer = plan.model_copy(update={"frames": plan.frames[:5]})
    with pytest.raises(DecodingError, match="even steps"):
        measure_response(fewer, frames.__getitem__)
    for count in (2, 300):
        with pytest.raises(SessionError, match="greys tell no response"):
            plan_greys(**SIZE, exposure_s=(0.03,), greys=count)


def test_the_response_stands_in_the_plan():
    plan = plan_structured_light(**SIZE, exposure_s=0.03, response=power(2.2))
    assert Plan.model_validate_json(plan.model_dump_json()) == plan
    plain = plan_structured_light(**SIZE, exposure_s=0.03)
    assert "response" not in plain.model_dump()


def fringe_of(gamma, steps=3):
    plan = plan_structured_light(
        **SIZE, exposure_s=0.03, axes=(Axis.COLUMN,), steps=steps, periods_px=(40.0,)
    )
    frames = [f for f in plan.frames if isinstance(f.pattern, PhaseShift)]
    changed = tuple(
        f.model_copy(update={"pattern": f.pattern.model_copy(update={"gamma": gamma})})
        for f in frames
    )
    return find_fringes(plan.model_copy(update={"frames": changed}))[0]


def errors_of(response, fringe, orders=(3, 6, 9)):
    return phase_error_of(response, shifts_rad=fringe.shifts_rad, gamma=fringe.gamma, orders=orders)


def test_the_phase_error_of_a_response_is_that_of_its_fringes():
    fringe, gamma = fringe_of(0.8), 1.7
    phase = np.linspace(0, 2 * np.pi, 1000)
    shown = (0.5 + 0.5 * np.cos(phase + fringe.shifts_rad[:, np.newaxis])) ** 0.8
    _, c, s = fringe.solution @ shown**gamma
    raw = np.arctan2(s, c)
    error = np.angle(np.exp(1j * (raw - phase)))
    coefficients = errors_of(power(gamma, 200), fringe, orders=(3, 6, 9, 12))
    predicted = sum(
        cosine * np.cos(order * raw) + sine * np.sin(order * raw)
        for order, (cosine, sine) in zip((3, 6, 9, 12), coefficients, strict=True)
    )
    assert np.abs(error).max() > 0.1
    assert predicted == pytest.approx(error, abs=0.004)
    assert errors_of(power(1.0), fringe_of(1.0)) == pytest.approx(0, abs=1e-9)


def test_one_response_explains_fringes_that_were_distorted_differently():
    """Of a projector that is no power law; from the phases alone, without any truth."""
    true = ProjectorResponse(light=(0.0, 0.05, 0.2, 0.5, 0.62, 0.7, 1.0))
    x = np.arange(600)
    evidence = []
    for gamma in (0.75, 1.25):
        fringe = fringe_of(gamma)
        phase = 2 * np.pi * (x / 43.7 + 1e-5 * x**2)
        shown = (0.5 + 0.5 * np.cos(phase + fringe.shifts_rad[:, np.newaxis])) ** gamma
        random = np.random.default_rng(3)
        light = true.light_of(shown)[:, np.newaxis] + random.normal(0, 0.004, (3, 40, 600))
        _, c, s = np.tensordot(fringe.solution, light, axes=1)
        turns = np.mod(np.arctan2(s, c) / (2 * np.pi), 1)
        series = series_along_lines([turns], [np.ones(turns.shape, bool)], (3, 6, 9))
        evidence.append(FringeEvidence(fringe, series))
    found = response_of_fringes(evidence)
    for each in evidence:
        left = errors_of(found, each.fringe) - errors_of(true, each.fringe)
        raw = errors_of(true, each.fringe)
        assert np.hypot.reduce(left.ravel()) < 0.006
        assert np.hypot.reduce(raw.ravel()) > 0.05
    with pytest.raises(DecodingError, match="no fringe"):
        response_of_fringes([])
