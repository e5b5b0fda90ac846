from __future__ import annotations

import cv2
import numpy as np
import pytest

from fitting.reflectance.colour_difference import delta_e_2000, lab_of_linear_rgb

# Of the test data of Sharma, Wu and Dalal 2005.
PAIRS = [
    ((50, 2.6772, -79.7751), (50, 0, -82.7485), 2.0425),
    ((50, -1.3802, -84.2814), (50, 0, -82.7485), 1.0),
    ((50, 0, 0), (50, -1, 2), 2.3669),
    ((50, 2.49, -0.001), (50, -2.49, 0.0009), 7.1792),
    ((50, 2.49, -0.001), (50, -2.49, 0.0011), 7.2195),
    ((50, -0.001, 2.49), (50, 0.0011, -2.49), 4.7461),
    ((50, 2.5, 0), (73, 25, -18), 27.1492),
    ((50, 2.5, 0), (56, -27, -3), 31.9030),
    ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
    ((22.7233, 20.0904, -46.694), (23.0331, 14.973, -42.5619), 2.0373),
    ((90.8027, -2.0831, 1.4410), (91.1528, -1.6435, 0.0447), 1.4441),
    ((2.0776, 0.0795, -1.135), (0.9033, -0.0636, -0.5514), 0.9082),
]


@pytest.mark.parametrize(("one", "other", "expected"), PAIRS)
def test_differences_are_those_of_the_published_table(one, other, expected):
    assert float(delta_e_2000(one, other)) == pytest.approx(expected, abs=1e-4)
    assert float(delta_e_2000(other, one)) == pytest.approx(expected, abs=1e-4)


def test_lab_is_opencv_s():
    rgb = np.random.default_rng(0).random((40, 50, 3)).astype(np.float32)
    expected = cv2.cvtColor(rgb[..., ::-1].copy(), cv2.COLOR_LBGR2LAB)
    assert np.abs(lab_of_linear_rgb(rgb) - expected).max() < 0.6
    assert lab_of_linear_rgb([1.0, 1.0, 1.0]) == pytest.approx([100, 0, 0], abs=1e-9)
