from __future__ import annotations

import cv2
import numpy as np
import pytest

from fitting.reflectance.colour_difference import colour_difference, lab_of_linear_rgb


def test_lab_is_opencv_s():
    rgb = np.random.default_rng(0).random((40, 50, 3)).astype(np.float32)
    expected = cv2.cvtColor(rgb[..., ::-1].copy(), cv2.COLOR_LBGR2LAB)
    assert np.abs(lab_of_linear_rgb(rgb) - expected).max() < 0.6
    assert lab_of_linear_rgb([1.0, 1.0, 1.0]) == pytest.approx([100, 0, 0], abs=1e-9)


def test_greys_differ_by_their_lightness_alone():
    # At L* = 50 a step of lightness counts for itself.
    light, dark = (((lightness + 16) / 116) ** 3 for lightness in (50.5, 49.5))
    assert float(colour_difference([light] * 3, [dark] * 3)) == pytest.approx(1.0, abs=1e-3)
    assert float(colour_difference([0.2, 0.4, 0.1], [0.2, 0.4, 0.1])) == 0.0
