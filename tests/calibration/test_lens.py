from __future__ import annotations

import cv2
import numpy as np
import pytest

from acquisition.foreign_capture import CalibrationDescription, Direction
from acquisition.plan import Imager
from calibration.errors import CalibrationError
from calibration.lens import Lens, compose, invert, rotation, transform
from calibration.opencv_files import read_matrices, read_rig_geometry, write_matrices
from calibration.rig_geometry import RigGeometry

NAMES = CalibrationDescription(
    file="c.yml",
    camera_matrix="K",
    camera_distortion="D",
    projector_matrix="KP",
    projector_distortion="DP",
    rotation="R",
    translation="T",
)


@pytest.fixture
def matrices(rig_geometry):
    def parts(lens):
        fx, fy, cx, cy = lens.intrinsics[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), lens.intrinsics[4:]

    camera, projector = parts(rig_geometry.camera), parts(rig_geometry.projector)
    pose = rig_geometry.rt_proj_cam
    return {
        "K": camera[0], "D": camera[1], "KP": projector[0], "DP": projector[1],
        "R": rotation(pose), "T": pose[3:].reshape(3, 1),
    }  # fmt: skip


def test_projection_agrees_with_opencv(rig_geometry, matrices):
    points = np.random.default_rng(0).uniform([-60, -40, 380], [60, 40, 500], (200, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrices["K"], matrices["D"])
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


def test_geometry_survives_the_disk(rig_geometry, tmp_path):
    rig_geometry.save(tmp_path)
    loaded = RigGeometry.load(tmp_path)
    np.testing.assert_allclose(loaded.rt_proj_cam, rig_geometry.rt_proj_cam, atol=1e-9)
    for one, other in (
        (loaded.camera, rig_geometry.camera),
        (loaded.projector, rig_geometry.projector),
    ):
        assert (one.model, one.width, one.height) == (other.model, other.width, other.height)
        np.testing.assert_allclose(one.intrinsics, other.intrinsics, atol=1e-9)


@pytest.mark.parametrize("suffix", ["yml", "xml"])
def test_opencv_files_are_read_as_written(matrices, rig_geometry, tmp_path, suffix):
    path = tmp_path / f"c.{suffix}"
    write_matrices(path, matrices)
    for name, matrix in read_matrices(path, list(matrices)).items():
        np.testing.assert_array_equal(matrix.ravel(), np.ravel(matrices[name]))
    sizes = {"camera": Imager(width=320, height=240), "projector": Imager(width=512, height=320)}
    geometry = read_rig_geometry(path, NAMES, **sizes)
    np.testing.assert_allclose(geometry.rt_proj_cam, rig_geometry.rt_proj_cam, atol=1e-9)
    other_way = read_rig_geometry(
        path, NAMES.model_copy(update={"pose": Direction.PROJECTOR_TO_CAMERA}), **sizes
    )
    np.testing.assert_allclose(invert(other_way.rt_proj_cam), rig_geometry.rt_proj_cam, atol=1e-9)


def test_a_matrix_that_is_not_there_is_named_with_those_that_are(matrices, tmp_path):
    del matrices["KP"]
    write_matrices(tmp_path / "c.yml", matrices)
    with pytest.raises(
        CalibrationError, match=r"c\.yml: no matrix 'KP'; the file has K, D, DP, R, T"
    ):
        read_matrices(tmp_path / "c.yml", ["K", "KP"])


@pytest.mark.parametrize(
    "content", ["", "not a calibration", "%YAML:1.0\n---\nK: 3\n", "<?xml version"]
)
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "c.yml").write_text(content)
    with pytest.raises(CalibrationError, match=r"c\.yml"):
        read_matrices(tmp_path / "c.yml", ["K"])


def test_calibrations_that_make_no_sense_are_refused(rig_geometry, tmp_path):
    with pytest.raises(CalibrationError, match="no such"):
        read_matrices(tmp_path / "missing.yml", ["K"])
    with pytest.raises(CalibrationError, match="baseline"):
        RigGeometry(rig_geometry.camera, rig_geometry.projector, np.zeros(6))
    with pytest.raises(CalibrationError, match="no rig calibration"):
        RigGeometry.load(tmp_path)
    with pytest.raises(CalibrationError, match="focal"):
        Lens("LENSMODEL_PINHOLE", np.array([-1.0, 1, 0, 0]), 10, 10)
