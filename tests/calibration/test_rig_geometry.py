from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.lens import compose
from calibration.rig_geometry import RigGeometry


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


def test_only_the_pose_between_the_two_counts(rig_geometry, tmp_path):
    rt_cam_ref = np.array([0.1, -0.2, 0.3, 5.0, 6.0, 7.0])
    rig_geometry.camera.save(tmp_path / "camera.cameramodel", rt_this_ref=rt_cam_ref)
    rig_geometry.projector.save(
        tmp_path / "projector.cameramodel",
        rt_this_ref=compose(rig_geometry.rt_proj_cam, rt_cam_ref),
    )
    loaded = RigGeometry.load(tmp_path)
    np.testing.assert_allclose(loaded.rt_proj_cam, rig_geometry.rt_proj_cam, atol=1e-9)


@pytest.mark.parametrize(
    ("pose", "message"),
    [(np.zeros(6), "baseline"), (np.ones(5), "six"), (np.full(6, np.nan), "finite")],
)
def test_poses_that_make_no_sense_are_refused(rig_geometry, pose, message):
    with pytest.raises(CalibrationError, match=message):
        RigGeometry(rig_geometry.camera, rig_geometry.projector, pose)


def test_missing_and_damaged_files_are_named(rig_geometry, tmp_path):
    with pytest.raises(CalibrationError, match=r"camera\.cameramodel is missing.*--calibration"):
        RigGeometry.load(tmp_path)
    rig_geometry.save(tmp_path)
    (tmp_path / "projector.cameramodel").write_text("{ nothing")
    with pytest.raises(CalibrationError, match=r"projector\.cameramodel: not a readable"):
        RigGeometry.load(tmp_path)


def test_a_covariance_goes_with_the_rig(rig_geometry, tmp_path):
    count = len(rig_geometry.parameters)
    root = np.random.default_rng(0).normal(size=(count, count))
    rig = dataclasses.replace(rig_geometry, covariance=root @ root.T)
    rig.save(tmp_path)
    np.testing.assert_array_equal(RigGeometry.load(tmp_path).covariance, rig.covariance)
    rig_geometry.save(tmp_path)
    assert RigGeometry.load(tmp_path).covariance is None
    (tmp_path / "rig_covariance.npy").write_bytes(b"\x93NUMPY nothing")
    with pytest.raises(CalibrationError, match=r"rig_covariance\.npy: not a readable"):
        RigGeometry.load(tmp_path)


def test_moved_rigs_differ_by_the_step_alone(rig_geometry):
    step = np.arange(1.0, len(rig_geometry.parameters) + 1) * 1e-3
    moved = rig_geometry.moved(step)
    np.testing.assert_allclose(moved.parameters - rig_geometry.parameters, step, atol=1e-12)
    assert moved.camera.intrinsics[0] == rig_geometry.camera.intrinsics[0] + 1e-3
    assert moved.rt_proj_cam[-1] == rig_geometry.rt_proj_cam[-1] + step[-1]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: c[1:], "24 × 24 finite"),
        (lambda c: c * np.nan, "finite"),
        (lambda c: c + np.triu(np.ones_like(c)), "not symmetric"),
        (lambda c: -c, "negative"),
        (lambda c: c - 3 * np.eye(len(c))[0] * np.eye(len(c)), "negative"),
    ],
)
def test_covariances_that_are_none_are_refused(rig_geometry, spoil, message):
    covariance = spoil(np.eye(len(rig_geometry.parameters)))
    with pytest.raises(CalibrationError, match=message):
        dataclasses.replace(rig_geometry, covariance=covariance)
