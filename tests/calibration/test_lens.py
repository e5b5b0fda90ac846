from __future__ import annotations

import cv2
import mrcal
import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.lens import (
    OPENCV_MODELS,
    Lens,
    compose,
    invert,
    rotation,
    rt_from_matrix,
    transform,
)


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


def test_a_small_turn_between_poses_that_stand_head_down_is_small():
    small = np.array([1e-3, -2e-3, 5e-4, 1.0, 2.0, 3.0])
    head_down = np.array([0, 0, np.pi, 0, 0, 0])
    there_and_back = compose(compose(small, head_down), head_down)
    np.testing.assert_allclose(there_and_back, small, atol=1e-12)
    turned = compose(np.array([2.9, 0, 0, 0, 0, 0]), np.array([2.9, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(turned[:3], [5.8 - 2 * np.pi, 0, 0], atol=1e-12)


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


@pytest.mark.parametrize("short_of_half_a_turn", [0.0, 1e-12, 1e-8, 1e-6, 1e-4, 0.3, 3.0, np.pi])
def test_poses_keep_half_turns_and_all_others(short_of_half_a_turn):
    random = np.random.default_rng(5)
    for axis in [*np.eye(3), *random.normal(size=(20, 3))]:
        axis = axis / np.linalg.norm(axis)
        cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        angle = np.pi - short_of_half_a_turn
        matrix = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        pose = rt_from_matrix(matrix, np.array([1.0, 2, 3]))
        np.testing.assert_allclose(rotation(pose), matrix, atol=1e-12)
        there_and_back = compose(invert(pose), pose)
        np.testing.assert_allclose(rotation(there_and_back), np.eye(3), atol=1e-12)
        assert np.linalg.norm(pose[:3]) <= np.pi + 1e-12


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


COEFFICIENTS = (-0.2, 0.1, 1e-3, -2e-3, 0.02, 0.05, -0.03, 0.01, 1e-3, 2e-4, -1e-3, 3e-4)


@pytest.mark.parametrize("count", OPENCV_MODELS)
def test_the_kernels_agree_with_mrcal(count):
    intrinsics = np.array([900.0, 910, 800, 500, *COEFFICIENTS[:count]])
    lens = Lens(OPENCV_MODELS[count], intrinsics, 1600, 1000)
    pixels = np.random.default_rng(3).uniform([0, 0], [1599, 999], (2000, 2))
    rays = mrcal.unproject(pixels, lens.model, intrinsics)
    rays /= rays[:, 2:]
    np.testing.assert_allclose(lens.unproject(pixels), rays, atol=1e-10)
    points = rays * np.linspace(300, 600, len(rays))[:, np.newaxis]
    expected, gradient, _ = mrcal.project(points, lens.model, intrinsics, get_gradients=True)
    found, by_point = lens.project_with_gradient(points)
    np.testing.assert_allclose(found, expected, atol=1e-11)
    np.testing.assert_allclose(by_point, gradient, atol=1e-13 * np.abs(gradient).max() + 1e-13)


SPLINED = "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=8_Ny=6_fov_x_deg=60"


def test_lenses_of_other_families_go_through_mrcal():
    surface = np.random.default_rng(4).normal(0, 1e-3, 96)
    lens = Lens(SPLINED, np.array([900.0, 905, 159, 118, *surface]), 320, 240)
    assert lens.opencv_parameters is None
    pixels = np.random.default_rng(1).uniform([0, 0], [319, 239], (50, 2))
    rays = lens.unproject(pixels)
    np.testing.assert_allclose(lens.project(rays * 431.0), pixels, atol=1e-5)
    slopes = lens.pixel_slopes(origin=(3, 5), shape=(4, 6))
    np.testing.assert_allclose(slopes[2, 1], lens.unproject(np.array([4.0, 7.0]))[:2], atol=1e-8)


def test_rays_of_a_crop_are_those_of_its_pixels_and_are_kept(rig_geometry):
    lens = rig_geometry.camera
    slopes = lens.pixel_slopes(origin=(20, 10), shape=(30, 40))
    pixels = np.stack(np.meshgrid(np.arange(20.0, 60), np.arange(10.0, 40)), axis=-1)
    np.testing.assert_allclose(slopes, lens.unproject(pixels)[..., :2], atol=1e-12)
    assert lens.pixel_slopes(origin=(20, 10), shape=(30, 40)) is slopes
    assert lens.pixel_slopes(origin=(21, 10), shape=(30, 40)) is not slopes
    with pytest.raises(ValueError, match="read-only"):
        slopes[0, 0] = 0


def test_a_pixel_beyond_the_fold_of_the_distortion_has_no_ray():
    # x (1 - r²) never exceeds 0.385, so no direction reaches 0.6.
    intrinsics = np.array([1000.0, 1000, 0, 0, -1, 0, 0, 0])
    lens = Lens("LENSMODEL_OPENCV4", intrinsics, 1000, 10)
    rays = lens.unproject(np.array([[600.0, 0], [300, 0]]))
    assert np.isnan(rays[0, :2]).all()
    assert lens.project(rays[1])[0] == pytest.approx(300)
