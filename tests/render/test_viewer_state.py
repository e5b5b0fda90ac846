from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from render.errors import RenderError
from render.painter import Light
from render.painting_node import Mode
from render.viewer_state import ViewerState
from render.windows import draw_in_windows

STATE = ViewerState(light=Light(distance_mm=400.0))


def test_modes_follow_each_other_both_ways():
    state, seen = STATE, []
    for _ in Mode:
        state = state.with_mode(1)
        seen.append(state.mode)
    assert set(seen) == set(Mode)
    assert state == STATE
    assert STATE.with_mode(1).with_mode(-1) == STATE


def test_the_light_goes_around_but_neither_under_the_canvas_nor_over_the_top():
    state = STATE
    for _ in range(100):
        state = state.with_light(turn=0.1, rise=0.1, away=1.01)
        assert abs(state.light.azimuth) <= np.pi
    assert state.light.elevation == pytest.approx(np.pi / 2)
    assert state.light.distance_mm == pytest.approx(400 * 1.01**100)
    assert np.cos(state.light.azimuth) == pytest.approx(np.cos(STATE.light.azimuth + 10))
    for _ in range(100):
        state = state.with_light(rise=-0.1)
    assert 0 < state.light.elevation < 0.02


def test_budgets_stay_within_what_can_be_drawn():
    state = STATE
    for _ in range(50):
        state = state.with_budget(2.0)
    assert state.budget_px == 16
    for _ in range(50):
        state = state.with_budget(0.5)
    assert state.budget_px == 1 / 64


def test_the_caption_says_mode_budget_and_light():
    text = STATE.with_budget(2.0).describe()
    for part in (
        "bounded within 0.5 px",
        "azimuth 135°",
        "elevation 32°",
        "400 mm",
        "without shad",
    ):
        assert part in text
    assert "px" not in STATE.with_mode(1).describe()


def test_a_process_that_drew_into_memory_opens_no_window():
    assert "OpenGL" in sys.modules
    with pytest.raises(RenderError, match="one of its own"):
        draw_in_windows()


@pytest.mark.parametrize("wrong", [{"exposure": 0.0}, {"exposure": np.nan}, {"budget_px": -1.0}])
def test_a_window_that_would_show_nothing_is_refused(wrong):
    with pytest.raises(RenderError, match="positive"):
        replace(STATE, **wrong)
