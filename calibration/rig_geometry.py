"""Geometry of the scanning rig: a camera, a projector, and the pose between them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.lens import Lens, compose, invert

CAMERA_FILE = "camera.cameramodel"
PROJECTOR_FILE = "projector.cameramodel"


@dataclass(frozen=True)
class RigGeometry:
    """Camera and projector of a scan.

    Attributes
    ----------
    camera, projector : Lens
        The two lenses.
    rt_proj_cam : (6,) float64 array
        Takes points from the camera frame to the projector frame (Rodrigues, mm).
    """

    camera: Lens
    projector: Lens
    rt_proj_cam: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.rt_proj_cam.shape != (6,) or not np.isfinite(self.rt_proj_cam).all():
            raise CalibrationError(
                "the pose between camera and projector must be six finite numbers"
            )
        if not np.linalg.norm(self.rt_proj_cam[3:]) > 0:
            raise CalibrationError(
                "camera and projector are at the same place: without a baseline nothing can be "
                "triangulated; check the translation of the calibration"
            )

    def save(self, folder: Path) -> None:
        """Write both camera models; the camera is the reference frame."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        self.camera.save(folder / CAMERA_FILE)
        self.projector.save(folder / PROJECTOR_FILE, rt_this_ref=self.rt_proj_cam)

    @classmethod
    def load(cls, folder: Path) -> RigGeometry:
        """Read what :meth:`save` wrote.

        Raises
        ------
        CalibrationError
            A file is missing or damaged.
        """
        folder = Path(folder)
        for name in (CAMERA_FILE, PROJECTOR_FILE):
            if not (folder / name).is_file():
                raise CalibrationError(
                    f"{folder / name} is missing: the session has no rig calibration, so its "
                    "frames can be decoded but not triangulated; name one with --calibration DIR"
                )
        camera, rt_cam_ref = Lens.load(folder / CAMERA_FILE)
        projector, rt_proj_ref = Lens.load(folder / PROJECTOR_FILE)
        if np.any(rt_cam_ref):
            rt_proj_ref = compose(rt_proj_ref, invert(rt_cam_ref))
        return cls(camera, projector, rt_proj_ref)
