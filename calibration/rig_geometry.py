"""Geometry of the scanning rig: a camera, a projector, and the pose between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.lens import Lens, compose, invert

CAMERA_FILE = "camera.cameramodel"
PROJECTOR_FILE = "projector.cameramodel"
COVARIANCE_FILE = "rig_covariance.npy"


@dataclass(frozen=True)
class RigGeometry:
    """Camera and projector of a scan.

    Attributes
    ----------
    camera, projector : Lens
        The two lenses.
    rt_proj_cam : (6,) float64 array
        Takes points from the camera frame to the projector frame (Rodrigues, mm).
    covariance : (n, n) float64 array or None
        Covariance of all the parameters in this order: the camera's intrinsics, the projector's,
        ``rt_proj_cam``. None where the calibration did not say.

    Raises
    ------
    CalibrationError
        No baseline, a pose that is not finite, or a covariance that is none.
    """

    camera: Lens
    projector: Lens
    rt_proj_cam: NDArray[np.float64]
    covariance: NDArray[np.float64] | None = None

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

        if self.covariance is not None:
            _check_covariance(self.covariance, len(self.parameters))

    @property
    def parameters(self) -> NDArray[np.float64]:
        """All the parameters (n,), in the order of the covariance."""
        return np.concatenate([self.camera.intrinsics, self.projector.intrinsics, self.rt_proj_cam])

    def moved(self, step: NDArray[np.float64]) -> RigGeometry:
        """The rig with a step (n,) added to its parameters; for derivatives."""
        ends = np.cumsum([len(self.camera.intrinsics), len(self.projector.intrinsics)])
        camera, projector, pose = np.split(self.parameters + step, ends)
        return replace(
            self,
            camera=replace(self.camera, intrinsics=camera),
            projector=replace(self.projector, intrinsics=projector),
            rt_proj_cam=pose,
        )

    def save(self, folder: Path) -> None:
        """Write both camera models, the camera as the reference frame, and the covariance."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        self.camera.save(folder / CAMERA_FILE)
        self.projector.save(folder / PROJECTOR_FILE, rt_this_ref=self.rt_proj_cam)
        (folder / COVARIANCE_FILE).unlink(missing_ok=True)
        if self.covariance is not None:
            np.save(folder / COVARIANCE_FILE, self.covariance)

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
        return cls(camera, projector, rt_proj_ref, _read_covariance(folder / COVARIANCE_FILE))


def _read_covariance(path: Path) -> NDArray[np.float64] | None:
    if not path.is_file():
        return None
    try:
        return np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
    except (OSError, ValueError, EOFError) as error:
        raise CalibrationError(f"{path}: not a readable covariance ({error})") from error


def _check_covariance(covariance: NDArray[np.float64], count: int) -> None:
    if covariance.shape != (count, count) or not np.isfinite(covariance).all():
        raise CalibrationError(
            f"the covariance of a rig of {count} parameters is {count} × {count} finite numbers, "
            f"not {covariance.shape}"
        )
    # Parameters have different units: only their correlations can be compared.
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    scale = np.where(sigma > 0, sigma, 1.0)
    correlation = covariance / np.outer(scale, scale)
    if np.abs(correlation - correlation.T).max() > 1e-6:
        raise CalibrationError("the covariance of the rig is not symmetric")
    if np.linalg.eigvalsh(correlation).min() < -1e-6 * count:
        raise CalibrationError("the covariance of the rig has negative variances")
