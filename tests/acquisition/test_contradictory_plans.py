"""Plans whose frames cannot be what they are taken for, and frames that are not."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from synthetic_scan import expose, fringe_patterns, gray_patterns, make_plan

from acquisition.decoding import decode
from acquisition.errors import DecodingError
from acquisition.patterns import Axis, PhaseShift, pattern_profile


def ramp(width=160, height=60):
    col, row = np.meshgrid(np.arange(width), np.arange(height))
    return 20 + 2.9 * col + 0.11 * row


def plan_of(patterns):
    return make_plan(patterns, width=160, height=60)


def frequencies(steps):
    return fringe_patterns(Axis.COLUMN, period=512.0, steps=steps) + fringe_patterns(
        Axis.COLUMN, period=32.0, steps=steps
    )


@pytest.mark.parametrize("steps", [3, 4, 5, 8])
def test_swapped_steps_are_refused(steps):
    plan = plan_of(frequencies(steps))
    frames = expose(plan, {Axis.COLUMN: ramp()}, sigma=3)
    assert decode(plan, frames.__getitem__).valid.mean() > 0.99
    for one, other in combinations(list(frames), 2):
        swapped = {**frames, one: frames[other], other: frames[one]}
        with pytest.raises(DecodingError) as refused:
            decode(plan, swapped.__getitem__)
        if "not the steps of one fringe" in str(refused.value):
            assert one in str(refused.value) or other in str(refused.value)


@pytest.mark.parametrize("steps", [4, 6])
def test_a_dark_step_is_refused(steps):
    plan = plan_of(frequencies(steps))
    frames = expose(plan, {Axis.COLUMN: ramp()}, sigma=3)
    dark = f"{steps + 1:04d}"
    frames[dark] = np.zeros_like(frames[dark])
    with pytest.raises(DecodingError, match="one is dark"):
        decode(plan, frames.__getitem__)


@pytest.mark.parametrize("steps", [4, 5, 6])
@pytest.mark.parametrize("response", ["gamma", "clipped", "logarithm"])
def test_no_response_of_projector_or_camera_passes_for_swapped_steps(steps, response):
    plan = plan_of(frequencies(steps))
    for first in (0.0, 150.0):
        # Of the coarse fringe a part is seen.
        truth = first + ramp() * 0.6
        random = np.random.default_rng(0)
        frames = {}
        for frame in plan.frames:
            light = pattern_profile(frame.pattern, truth)
            light = {
                "gamma": 100 + 700 * light**3,
                "clipped": np.minimum(100 + 800 * light, 600),
                "logarithm": 150 * np.log1p(30 * light) + 50,
            }[response]
            frames[frame.id] = np.round(light + random.normal(0, 3, light.shape)).astype(np.uint16)
        decode(plan, frames.__getitem__)


def test_crowded_steps_determine_no_phase():
    crowded = [
        PhaseShift(axis=Axis.COLUMN, period_px=512.0, shift_rad=0.02 * step) for step in range(4)
    ]
    plan = plan_of(crowded)
    frames = expose(plan, {Axis.COLUMN: ramp()}, sigma=3)
    with pytest.raises(DecodingError, match=r"do not determine a phase.*spread over the period"):
        decode(plan, frames.__getitem__)


def test_of_steps_spread_unevenly_more_contrast_is_asked():
    near = [
        PhaseShift(axis=Axis.COLUMN, period_px=512.0, shift_rad=np.deg2rad(45.0) * step)
        for step in range(3)
    ]
    kept = []
    for patterns in (near, fringe_patterns(Axis.COLUMN, period=512.0, steps=3)):
        plan = plan_of(patterns)
        for sigma in (20, 4):
            frames = expose(plan, {Axis.COLUMN: ramp()}, sigma=sigma, modulation=120)
            found = decode(plan, frames.__getitem__)
            kept.append(found.valid.mean())
        decoded = found.axes[Axis.COLUMN]
        error = (decoded.coordinate - ramp())[found.valid]
        z = (error - 512 * np.round(error / 512)) / np.sqrt(decoded.variance[found.valid])
        assert np.std(z) == pytest.approx(1, abs=0.1)
    assert kept[0] < 0.1 < 0.98 < min(kept[1:])


def test_gray_cells_wider_than_a_period_are_refused():
    patterns = fringe_patterns(Axis.COLUMN, period=32.0, steps=4)
    plan = plan_of(patterns + gray_patterns(Axis.COLUMN, step=48.0, bits=4))
    frames = expose(plan, {Axis.COLUMN: ramp()}, sigma=3)
    with pytest.raises(DecodingError, match=r"cells of 48 px.*fringes of 32 px"):
        decode(plan, frames.__getitem__)


@pytest.mark.parametrize("origin", [0.0, 2.0])
def test_gray_cells_of_a_whole_period_lose_nothing(origin):
    patterns = fringe_patterns(Axis.COLUMN, period=32.0, steps=4, origin_rad=origin)
    plan = plan_of(patterns + gray_patterns(Axis.COLUMN, step=32.0, bits=4))
    frames = expose(plan, {Axis.COLUMN: ramp()}, sigma=3)
    found = decode(plan, frames.__getitem__)
    assert found.valid.mean() > 0.999
    assert np.nanmax(np.abs(found.axes[Axis.COLUMN].coordinate - ramp())) < 1


@pytest.mark.parametrize("fringe", [True, False])
def test_a_code_that_repeats_on_the_panel_is_refused(fringe):
    patterns = gray_patterns(Axis.COLUMN, step=16.0, bits=4)
    patterns += (
        fringe_patterns(Axis.COLUMN, period=32.0, steps=4)
        if fringe
        else gray_patterns(Axis.COLUMN, step=16.0, bits=4, inverse=True)
    )
    plan = plan_of(patterns)
    frames = expose(plan, {Axis.COLUMN: ramp()}, sigma=3)
    with pytest.raises(DecodingError, match=r"16 cells of 16 px, and the panel has 32"):
        decode(plan, frames.__getitem__)


def test_a_mosaic_with_its_green_saturated_keeps_red_and_blue():
    plan = plan_of(frequencies(4))
    frames = expose(plan, {Axis.COLUMN: ramp()}, sigma=3)
    for frame in frames.values():
        frame[::2, ::2] = frame[1::2, 1::2] = 1023
    found = decode(plan, frames.__getitem__)
    assert found.valid.mean() > 0.499
    decoded = found.axes[Axis.COLUMN]
    z = (decoded.coordinate - ramp())[found.valid] / np.sqrt(decoded.variance[found.valid])
    assert np.std(z) == pytest.approx(1, abs=0.06)
