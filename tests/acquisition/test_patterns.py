from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from acquisition import patterns
from acquisition.patterns import (
    BLACK,
    PATTERN_ADAPTER,
    WHITE,
    Axis,
    Gray,
    PhaseShift,
    Uniform,
    pattern_image,
    pattern_profile,
)


def test_a_fringe_is_brightest_where_its_phase_is_zero():
    step = PhaseShift(axis=Axis.COLUMN, period_px=40, shift_rad=np.pi / 2, origin_rad=np.pi)
    # 2π x / 40 + 3π/2 is a whole turn at x = 10.
    np.testing.assert_allclose(
        pattern_profile(step, np.array([10.0, 30, 50])), [1, 0, 1], atol=1e-12
    )


def test_gamma_is_a_power_of_the_linear_pattern():
    plain = PhaseShift(axis=Axis.ROW, period_px=17.3, shift_rad=0.4)
    bent = plain.model_copy(update={"gamma": 1.25})
    x = np.linspace(0, 60, 200)
    np.testing.assert_allclose(pattern_profile(bent, x), pattern_profile(plain, x) ** 1.25)


@given(
    bits=st.integers(1, 12),
    step_px=st.floats(0.5, 50),
    offset=st.floats(0, 1, exclude_max=True),
    fraction=st.floats(0.01, 0.99),
)
def test_gray_bits_spell_the_cell_and_neighbours_differ_in_one(bits, step_px, offset, fraction):
    cells = np.arange(2**bits)
    x = (cells - offset + fraction) * step_px
    x = x[x >= 0]
    code = np.array(
        [
            pattern_profile(
                Gray(axis=Axis.COLUMN, bit=b, bits=bits, step_px=step_px, offset=offset), x
            )
            for b in range(bits)
        ],
        dtype=int,
    )
    spelt = np.cumsum(code, axis=0) % 2  # Gray to binary: each bit turns the next one over
    found = (spelt * 2 ** np.arange(bits)[::-1, np.newaxis]).sum(axis=0)
    np.testing.assert_array_equal(found, cells[len(cells) - len(x) :])
    assert (np.abs(np.diff(code, axis=1)).sum(axis=0) == 1).all()


def test_the_inverse_is_the_complement():
    bit = Gray(axis=Axis.COLUMN, bit=1, bits=4, step_px=3)
    x = np.arange(48.0)
    inverse = bit.model_copy(update={"inverse": True})
    np.testing.assert_array_equal(pattern_profile(bit, x) + pattern_profile(inverse, x), 1)


@pytest.mark.parametrize("axis", list(Axis))
def test_pictures_vary_along_their_axis_only(axis):
    pattern = PhaseShift(axis=axis, period_px=13, shift_rad=0.2)
    image = pattern_image(pattern, width=31, height=22)
    assert (image.shape, image.dtype) == ((22, 31), np.uint8)
    along = image if axis is Axis.COLUMN else image.T
    assert (along == along[0]).all()
    expected = np.round(255 * pattern_profile(pattern, np.arange(along.shape[1], dtype=float)))
    np.testing.assert_array_equal(along[0], expected)


@pytest.mark.parametrize("towards", [0.0, 1.0])
@pytest.mark.parametrize("step", range(8))
def test_the_last_bits_of_a_cosine_do_not_change_a_picture(step, towards, monkeypatch):
    fringe = PhaseShift(axis=Axis.COLUMN, period_px=24, shift_rad=2 * np.pi * step / 8)
    picture = pattern_image(fringe, width=96, height=2)
    exact = pattern_profile(fringe, np.arange(96.0))
    assert np.count_nonzero(np.abs(255 * exact - 127.5) < 1e-9) == 8
    off = np.nextafter(np.nextafter(exact, towards), towards)
    monkeypatch.setattr(patterns, "pattern_profile", lambda *_: off)
    np.testing.assert_array_equal(pattern_image(fringe, width=96, height=2), picture)


def test_flat_fields_are_flat():
    for pattern, level in ((WHITE, 255), (BLACK, 0), (Uniform(level=0.5), 128)):
        assert (pattern_image(pattern, width=5, height=4) == level).all()


@pytest.mark.parametrize(
    "pattern",
    [
        PhaseShift(axis=Axis.ROW, period_px=1 / 3, shift_rad=2 * np.pi / 3, gamma=0.75),
        Gray(axis=Axis.COLUMN, bit=2, bits=6, step_px=30, offset=0.5, inverse=True),
        WHITE,
    ],
)
def test_patterns_survive_json_exactly(pattern):
    assert PATTERN_ADAPTER.validate_json(PATTERN_ADAPTER.dump_json(pattern)) == pattern


@pytest.mark.parametrize(
    "content",
    [
        {"kind": "phase_shift", "axis": "column", "period_px": 0, "shift_rad": 0},
        {"kind": "phase_shift", "axis": "column", "period_px": 9, "shift_rad": float("nan")},
        {"kind": "phase_shift", "axis": "column", "period_px": float("inf"), "shift_rad": 0},
        {"kind": "phase_shift", "axis": "diagonal", "period_px": 9, "shift_rad": 0},
        {"kind": "gray", "axis": "row", "bit": 4, "bits": 4, "step_px": 2},
        {"kind": "uniform", "level": 1.5},
        {"kind": "speckle"},
    ],
)
def test_patterns_that_are_none_are_refused(content):
    with pytest.raises(ValidationError):
        PATTERN_ADAPTER.validate_python(content)
