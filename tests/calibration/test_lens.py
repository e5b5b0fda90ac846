from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.lens import Lens, compose, invert, rotation, rt_from_matrix, transform


def test_projection_agrees_with_opencv(rig_geometry):
    points = np.random.default_rng(0).uniform([-60, -40, 380], [60, 40, 500], (200, 3))
    fx, fy, cx, cy = rig_geometry.camera.intrinsics[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    distortion = rig_geometry.camera.intrinsics[4:]
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
    np.testing.assert_allclose(rig_geometry.camera.project(points), expected[:, 0], atol=1e-9)


def test_rays_project_back_and_gradients_agree_with_differences(rig_geometry):
    lens = rig_geometry.camera
    pixels = np.random.default_rng(1).uniform([0, 0], [319, 239], (100, 2))
    rays = lens.unproject(pixels)
    assert (rays[:, 2] == 1).all()
    np.testing.assert_allclose(lens.project(rays * 431.0), pixels, atol=1e-6)
    points = rays * 431.0
    _, gradient = lens.project_with_gradient(points)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-3
        numeric = (lens.project(points + step) - lens.project(points - step)) / 2e-3
        np.testing.assert_allclose(gradient[..., axis], numeric, atol=1e-6)


def test_poses_compose_as_their_names_say():
    random = np.random.default_rng(2)
    rt_a_b, rt_b_c = random.normal(size=(2, 6))
    points = random.normal(size=(5, 3))
    np.testing.assert_allclose(
        transform(compose(rt_a_b, rt_b_c), points), transform(rt_a_b, transform(rt_b_c, points))
    )
    np.testing.assert_allclose(transform(invert(rt_a_b), transform(rt_a_b, points)), points)


def test_rotations_agree_with_opencv():
    vector = np.array([0.3, -0.8, 0.5])
    matrix, _ = cv2.Rodrigues(vector)
    np.testing.assert_allclose(rotation(np.append(vector, [0.0, 0, 0])), matrix, atol=1e-12)
    np.testing.assert_allclose(rt_from_matrix(matrix, np.ones(3)), np.append(vector, [1.0, 1, 1]))


def test_the_number_of_coefficients_chooses_the_model():
    matrix = np.array([[900.0, 0, 160], [0, 910, 120], [0, 0, 1]])
    for count, model in ((0, "PINHOLE"), (4, "OPENCV4"), (8, "OPENCV8"), (12, "OPENCV12")):
        lens = Lens.from_opencv(matrix, np.full(count, 0.01), width=320, height=240)
        assert lens.model == f"LENSMODEL_{model}"
        np.testing.assert_array_equal(lens.focal_px, [900, 910])


@pytest.mark.parametrize(
    ("matrix", "distortion", "message"),
    [
        (np.eye(2), np.zeros(5), "3×3"),
        (np.eye(3), np.zeros(6), "6 distortion coefficients"),
        (np.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]), np.zeros(5), "skew"),
        (np.diag([-1.0, 1, 1]), np.zeros(5), "focal"),
        (np.eye(3), np.array([0, 0, np.nan, 0, 0]), "not finite"),
    ],
)
def test_lenses_that_are_none_are_refused(matrix, distortion, message):
    with pytest.raises(CalibrationError, match=message):
        Lens.from_opencv(matrix, distortion, width=10, height=10)
