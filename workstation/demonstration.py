"""The demo: a simulated painting is scanned, processed, and held against what it truly is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import robust_sigma
from acquisition.scan import plan_scan, scan
from acquisition.session_writer import SessionWriter
from calibration.lens import Lens, compose, invert, rt_from_matrix, transform
from calibration.rig_geometry import RigGeometry
from devices.simulated.optics import SimulatedLens
from devices.simulated.rig import SimulatedRig
from devices.simulated.truth import truth_of
from fitting.digital_copy import DigitalCopy

EXPOSURE_S = 0.045
_ROUNDS = 6


@dataclass(frozen=True)
class HeightError:
    """Errors of a copy's heights against the truth, mm.

    Attributes
    ----------
    observed_rms_mm : float
        RMS of height minus truth.
    predicted_rms_mm : float
        RMS of the standard errors carried along.
    bias_mm : float
        Mean error.
    spread : float
        Standard deviation of error over its own standard error (robust).
    texels : int
    outside_canvas : int
        Texels that lie on the frame or beyond.
    """

    observed_rms_mm: float
    predicted_rms_mm: float
    bias_mm: float
    spread: float
    texels: int
    outside_canvas: int

    @property
    def ratio(self) -> float:
        """Observed over predicted RMS."""
        return self.observed_rms_mm / self.predicted_rms_mm


def record_simulated_scan(
    rig: SimulatedRig, out: Path, *, advance: Callable[[str], None] = lambda frame: None
) -> None:
    """Scan a simulated rig into a session that carries the rig's true calibration."""
    devices = rig.open()
    plan = plan_scan(devices, exposure_s=EXPOSURE_S)
    with TemporaryDirectory() as folder:
        true_geometry(rig).save(Path(folder))
        with SessionWriter.create(out, plan, calibration=Path(folder)) as writer:
            scan(writer, devices, advance=advance)


def true_geometry(rig: SimulatedRig) -> RigGeometry:
    """The calibration of a simulated rig as it truly is."""
    camera, projector = rig.camera_lens, rig.projector_lens
    pose = compose(_pose(projector), invert(_pose(camera)))
    return RigGeometry(_lens(camera), _lens(projector), pose)


def measure_height_error(
    copy: DigitalCopy, rig: SimulatedRig, *, rt_true_canvas: NDArray[np.float64] | None = None
) -> HeightError:
    """Compare every texel of a copy with the painting below it.

    Each texel is taken as the point in space that the copy says it is, and its height above the
    painting's true frame is compared with the true surface there.

    Parameters
    ----------
    copy : DigitalCopy
    rig : SimulatedRig
    rt_true_canvas : (6,) array, optional
        Pose of the canvas in the true frame, as of :func:`align_to_truth`; by default as the copy
        has it, if it was made with the rig's true calibration.
    """
    points = points_in_truth(copy, rig, rt_true_canvas)
    error = points[:, 2] - truth_of(rig.scene).height_at(points[:, 0], points[:, 1])
    sigma = np.sqrt(copy.height_field.variance[copy.height_field.mask].astype(np.float64))
    half = np.array(rig.painting.canvas_mm) / 2
    beyond = (np.abs(points[:, :2]) > half).any(axis=1)
    return HeightError(
        float(np.sqrt(np.mean(error**2))),
        float(np.sqrt(np.mean(sigma**2))),
        float(np.mean(error)),
        robust_sigma(error / sigma),
        len(error),
        int(beyond.sum()),
    )


def points_in_truth(
    copy: DigitalCopy, rig: SimulatedRig, rt_true_canvas: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Measured texels (n, 3) in the painting's true frame, mm; see :func:`measure_height_error`."""
    field = copy.height_field
    if rt_true_canvas is None:
        rt_true_canvas = compose(rt_true_camera(rig), field.rt_cam_canvas)
    x, y = np.meshgrid(field.texel_x_mm(), field.texel_y_mm())
    local = np.stack([x, y, field.height], axis=-1)[field.mask].astype(np.float64)
    return transform(rt_true_canvas, local)


def align_to_truth(copy: DigitalCopy, rig: SimulatedRig) -> NDArray[np.float64]:
    """Pose (6,) of the canvas at which its heights fit the true painting best.

    A calibration leaves the rig's frame free by as much as it is uncertain: the lens's centre and
    the camera's direction can hardly be told apart, and a copy is no worse for being elsewhere.
    """
    truth = truth_of(rig.scene)
    pose = compose(rt_true_camera(rig), copy.height_field.rt_cam_canvas)
    step = 0.5 * copy.height_field.pitch_mm
    for _ in range(_ROUNDS):
        points = points_in_truth(copy, rig, pose)
        x, y, z = points.T
        slope_x = (truth.height_at(x + step, y) - truth.height_at(x - step, y)) / (2 * step)
        slope_y = (truth.height_at(x, y + step) - truth.height_at(x, y - step)) / (2 * step)
        off = z - truth.height_at(x, y)
        # How a small turn and shift of the canvas change what it is off by.
        normal = np.stack([-slope_x, -slope_y, np.ones_like(z)], axis=1)
        lever = np.concatenate([np.cross(points, normal), normal], axis=1)
        # Edges of strokes, which texels cut off, shall not pull.
        apart = off - np.median(off)
        usual = np.abs(apart) < 4 * robust_sigma(apart)
        move = -np.linalg.lstsq(lever[usual], off[usual], rcond=None)[0]
        pose = compose(move, pose)
    return pose


def rt_true_camera(rig: SimulatedRig) -> NDArray[np.float64]:
    """Takes points of the scanning camera's frame to the painting's true one, (6,)."""
    return invert(_pose(rig.camera_lens))


def _pose(lens: SimulatedLens) -> np.ndarray:
    return rt_from_matrix(lens.rotation, lens.translation)


def _lens(lens: SimulatedLens) -> Lens:
    return Lens.from_opencv(lens.matrix, lens.distortion, width=lens.width, height=lens.height)
