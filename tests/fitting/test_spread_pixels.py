from __future__ import annotations

import numpy as np
import pytest

from fitting.spread_pixels import spread_pixels


@pytest.mark.parametrize("width", [400, 500, 1000, 997])
def test_columns_are_met_evenly_whatever_the_width(width):
    mask = np.ones((1000, width), bool)
    mask[:, :7] = False
    chosen = spread_pixels(mask, 2000)
    assert 2000 <= len(chosen) < 4000
    assert mask.ravel()[chosen].all()
    assert (np.diff(chosen) > 0).all()
    column = chosen % width
    assert len(np.unique(column)) > 0.8 * min(width, len(chosen) / 3)
    met = np.histogram(column, bins=10, range=(7, width))[0]
    assert met.min() > 0.7 * len(chosen) / 10
    np.testing.assert_array_equal(spread_pixels(mask, 2000), chosen)


def test_a_few_pixels_are_all_taken():
    mask = np.random.default_rng(0).random((20, 30)) > 0.5
    np.testing.assert_array_equal(spread_pixels(mask, 200), np.flatnonzero(mask))
    assert len(spread_pixels(np.zeros((3, 3), bool), 5)) == 0
