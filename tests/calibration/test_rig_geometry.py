from __future__ import annotations

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
