from __future__ import annotations

import numpy as np
import pytest

from calibration.srgb import encode_srgb


def test_the_curve_is_that_of_the_standard():
    # Middle grey of 18 % is 118 of 255; the linear part ends at 0.0031308.
    found = encode_srgb(np.array([0.0, 0.001, 0.18, 1.0]))
    np.testing.assert_allclose(found, [0.0, 0.01292, 0.46135613, 1.0], atol=1e-7)


def test_its_two_parts_meet():
    ends = encode_srgb(np.array([0.0031308, np.nextafter(0.0031308, 1.0)]))
    assert ends[1] - ends[0] == pytest.approx(0, abs=1e-7)


def test_what_no_screen_shows_is_cut_off_and_the_type_stays():
    found = encode_srgb(np.array([-1.0, 2.0], np.float32))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, [0.0, 1.0], atol=1e-6)
