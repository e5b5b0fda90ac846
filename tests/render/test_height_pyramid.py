from __future__ import annotations

import numpy as np
import pytest

from render.height_pyramid import GAP, Heading, cone_slopes, min_max_pyramid


def test_every_square_holds_the_heights_of_its_cells():
    height = np.random.default_rng(0).standard_normal((21, 45)).astype(np.float32)
    levels = min_max_pyramid(height)
    assert levels[0].shape == (32, 64, 3)
    assert levels[-1].shape == (1, 1, 3)
    for number, level in enumerate(levels):
        side = 2**number
        for row in range(0, 20 // side):
            for col in range(0, 44 // side):
                part = height[row * side : (row + 1) * side + 1, col * side : (col + 1) * side + 1]
                assert level[row, col, 0] == part.min()
                assert level[row, col, 1] == part.max()


def test_squares_know_what_was_measured_and_whether_anything_is_missing():
    height = np.ones((5, 5), np.float32)
    height[2, 2] = GAP
    height[0, 0] = -3
    first, second, top = min_max_pyramid(height)
    assert (first[1:3, 1:3] == [1, 1, 0]).all()
    assert first[0, 0].tolist() == [-3, 1, 1]
    assert first[0, 3].tolist() == [1, 1, 1]
    assert second[0, 0].tolist() == [-3, 1, 0]
    assert top[0, 0].tolist() == [-3, 1, 0]


def test_what_is_beyond_the_grid_is_missing():
    levels = min_max_pyramid(np.ones((4, 6), np.float32))
    assert levels[0][3, 0].tolist() == [-GAP, GAP, 0]
    assert levels[1][1, 0].tolist() == [1, 1, 0]
    assert levels[1][0, 0].tolist() == [1, 1, 1]


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1)])
def test_single_rows_have_no_cell(shape):
    assert min_max_pyramid(np.ones(shape, np.float32))[-1].tolist() == [[[-GAP, GAP, 0]]]


def test_no_height_stands_in_a_cone():
    random = np.random.default_rng(1)
    height = random.standard_normal((40, 50)).astype(np.float32).cumsum(axis=1)
    slopes = cone_slopes(height, 0.5)
    rows, cols = np.mgrid[0:40, 0:50]
    for row, col in random.integers(0, [40, 50], (60, 2)):
        away = 0.5 * np.hypot(rows - row, cols - col)
        assert (height <= height[row, col] + slopes[row, col] * away + 1e-4).all()
    # Nor are cones needlessly narrow: over a plane they are as wide as its slope, or nearly.
    ramp = np.broadcast_to(0.1 * np.arange(50, dtype=np.float32), (40, 50))
    assert cone_slopes(ramp, 0.5)[20, 25] == pytest.approx(0.2, rel=1.01)


@pytest.mark.parametrize("heading", list(Heading))
def test_no_height_ahead_stands_in_the_cone_of_a_heading(heading):
    random = np.random.default_rng(2)
    height = random.standard_normal((40, 50)).astype(np.float32).cumsum(axis=1)
    slopes = cone_slopes(height, 0.5, heading)
    rows, cols = np.mgrid[0:40, 0:50]
    for row, col in random.integers(0, [40, 50], (60, 2)):
        ahead = heading.value[0] * (rows - row) + heading.value[1] * (cols - col) >= 0
        away = 0.5 * np.hypot(rows - row, cols - col)
        within = height <= height[row, col] + slopes[row, col] * away + 1e-4
        assert within[ahead].all()


def test_a_ridge_behind_a_ray_does_not_hold_it_up():
    ridge = np.zeros((41, 41), np.float32)
    ridge[20, 17] = 1.0
    slopes = {heading: cone_slopes(ridge, 0.5, heading)[20, 20] for heading in Heading}
    assert slopes.pop(Heading.RIGHT) == 0
    assert min(slopes.values()) >= 1.0 / 1.5
