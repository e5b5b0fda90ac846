from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibration.colour_chart import (
    PATCHES_LAB,
    delta_e_2000,
    find_chart,
    fit_colour_matrix,
    lab_of_xyz,
    linear_rgb_of_lab,
    xyz_of_lab,
)
from calibration.errors import CalibrationError

# What a camera makes of linear sRGB.
CAMERA = np.array([[0.62, 0.25, 0.05], [0.18, 0.78, 0.10], [0.03, 0.22, 0.55]])


def chart_picture(noise=0.0, seed=0, angle=6.0):
    """A chart of 24 patches on black, turned a little, as a camera sees it in linear RGB."""
    patch, gap = 44, 8
    height, width = 4 * (patch + gap) + gap, 6 * (patch + gap) + gap
    chart = np.full((height, width, 3), 0.02)
    for number, colour in enumerate(linear_rgb_of_lab(PATCHES_LAB)):
        row, column = divmod(number, 6)
        top, left = gap + row * (patch + gap), gap + column * (patch + gap)
        chart[top : top + patch, left : left + patch] = np.maximum(colour, 0)
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), angle, 1.0)
    turn[:, 2] += 70
    picture = cv2.warpAffine(
        chart, turn, (width + 140, height + 140), flags=cv2.INTER_LINEAR, borderValue=(0.4,) * 3
    )
    seen = picture @ CAMERA.T
    return seen + np.random.default_rng(seed).normal(0, noise, seen.shape)


def test_the_chart_is_found_and_the_camera_undone():
    patches = find_chart(chart_picture(noise=0.003))
    true = np.maximum(linear_rgb_of_lab(PATCHES_LAB), 0) @ CAMERA.T
    np.testing.assert_allclose(patches.rgb, true, atol=0.003)
    assert (patches.sigma < 0.001).all()
    found = fit_colour_matrix(patches.rgb)
    np.testing.assert_allclose(found.matrix @ CAMERA, np.eye(3), atol=0.03)
    assert found.delta_e_after.mean() < 1.0
    assert found.delta_e_before.mean() > 5 * found.delta_e_after.mean()
    assert found.delta_e_held_out.mean() >= found.delta_e_after.mean()


def test_the_matrix_errs_as_much_as_predicted():
    true = linear_rgb_of_lab(PATCHES_LAB)
    inverse = np.linalg.inv(CAMERA)
    # Noise that the weights make alike.
    noise = 0.004 * np.maximum(xyz_of_lab(PATCHES_LAB)[:, 1:2], 0.02) ** (2 / 3)
    white = []
    for seed in range(60):
        random = np.random.default_rng(seed)
        seen = (true + random.normal(0, 1, true.shape) * noise) @ CAMERA.T
        found = fit_colour_matrix(seen)
        white.append((found.matrix - inverse) / found.sigma)
    assert np.sqrt(np.mean(np.square(white))) == pytest.approx(1, abs=0.12)


# Pairs and differences of Sharma, Wu and Dalal 2005, table 1.
@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ((50, 2.6772, -79.7751), (50, 0, -82.7485), 2.0425),
        ((50, -1.3802, -84.2814), (50, 0, -82.7485), 1.0000),
        ((50, 0, 0), (50, -1, 2), 2.3669),
        ((50, 2.49, -0.001), (50, -2.49, 0.0009), 7.1792),
        ((50, 2.5, 0), (73, 25, -18), 27.1492),
        ((50, 2.5, 0), (50, 3.1736, 0.5854), 1.0000),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_colour_differences_are_those_published(one, other, expected):
    assert delta_e_2000(np.array(one), np.array(other)) == pytest.approx(expected, abs=1e-4)
    assert delta_e_2000(np.array(other), np.array(one)) == pytest.approx(expected, abs=1e-4)


def test_lab_and_xyz_are_inverse():
    np.testing.assert_allclose(lab_of_xyz(xyz_of_lab(PATCHES_LAB)), PATCHES_LAB, atol=1e-10)
    np.testing.assert_allclose(linear_rgb_of_lab(np.array([100.0, 0, 0])), np.ones(3), atol=1e-4)


def test_what_is_no_chart_is_refused():
    with pytest.raises(CalibrationError, match="no ColorChecker"):
        find_chart(np.full((200, 300, 3), 0.5))
    with pytest.raises(CalibrationError, match="black"):
        find_chart(np.zeros((200, 300, 3)))
    with pytest.raises(CalibrationError, match="finite linear RGB"):
        find_chart(np.full((200, 300, 3), np.nan))
    with pytest.raises(CalibrationError, match="saturated"):
        find_chart(chart_picture(), saturation=0.5)
    with pytest.raises(CalibrationError, match="24 patches"):
        fit_colour_matrix(np.ones((18, 3)))
    with pytest.raises(CalibrationError, match="all alike"):
        fit_colour_matrix(np.ones((24, 3)))
