"""Drift: what has changed since an earlier calibration of the same rig, and whether it is real.

Two calibrations never agree exactly. What counts is how differently they measure: points of the
working volume are seen by the new rig, triangulated by the old one, and what a rigid motion does
not explain (Kabsch 1976) is the change of shape. Where both carry their covariance, the change that
their uncertainties explain is known, and more than that is drift: a lens refocused, a clamp that
gave way, a projector that was not warm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.cross_validation import CalibrationDifference, calibration_difference
from calibration.errors import CalibrationError
from calibration.lens import compose, invert, transform
from calibration.rig_geometry import RigGeometry
from calibration.triangulation import depth_along_rays
from calibration.uncertainty import RigCovariance

_COLUMNS, _ROWS = 9, 7
_DEPTHS = (0.92, 1.0, 1.08)


@dataclass(frozen=True)
class Drift:
    """A calibration against an earlier one.

    Attributes
    ----------
    camera, projector : CalibrationDifference
        In pixels, a rigid motion of each lens removed.
    shape_rms_mm : float
        Change of shape in the working volume: root mean square of what a rigid motion leaves.
    predicted_mm : float
        The change that the covariances of both explain; NaN where neither carries one.
    scale : float
        Relative change of lengths.
    baseline_mm : float
        Change of the distance between camera and projector.
    turn_rad : float
        By which the projector turned about the camera.
    """

    camera: CalibrationDifference
    projector: CalibrationDifference
    shape_rms_mm: float
    predicted_mm: float
    scale: float
    baseline_mm: float
    turn_rad: float

    @property
    def over_predicted(self) -> float:
        """Change of shape over what the uncertainties explain."""
        return self.shape_rms_mm / self.predicted_mm


def compare_with_earlier(rig: RigGeometry, earlier: RigGeometry, *, distance_mm: float) -> Drift:
    """Hold a calibration against an earlier one of the same rig.

    Parameters
    ----------
    rig, earlier : RigGeometry
    distance_mm : float
        Working distance along the camera's axis.

    Raises
    ------
    CalibrationError
        Of another camera or projector, or rigs that do not look at the same place.
    """
    for name in ("camera", "projector"):
        lens, before = getattr(rig, name), getattr(earlier, name)
        if (lens.width, lens.height) != (before.width, before.height):
            raise CalibrationError(
                f"the earlier {name} has {before.width}×{before.height} pixels, this one "
                f"{lens.width}×{lens.height}: no drift of one rig can be told from two"
            )
    points = working_volume(rig, distance_mm=distance_mm)
    moved = _as_seen_before(points, rig, earlier)
    points, moved = (p[np.isfinite(moved).all(axis=1)] for p in (points, moved))
    if len(points) < 12:
        raise CalibrationError(
            "the earlier calibration does not measure where this one does; it is of another rig, "
            "or camera and projector were rearranged"
        )
    left = _without_motion(moved, points)
    turned = compose(rig.rt_proj_cam, invert(earlier.rt_proj_cam))
    lengths = [np.linalg.norm(r.rt_proj_cam[3:]) for r in (rig, earlier)]
    spread = [np.linalg.norm(p - p.mean(axis=0)) for p in (moved, points)]
    return Drift(
        calibration_difference(earlier.camera, rig.camera, distance_mm=distance_mm),
        calibration_difference(earlier.projector, rig.projector, distance_mm=distance_mm),
        float(np.sqrt(np.mean(np.sum(left**2, axis=1)))),
        _predicted((rig, earlier), points),
        float(spread[1] / spread[0] - 1),
        float(lengths[0] - lengths[1]),
        float(np.linalg.norm(turned[:3])),
    )


def working_volume(rig: RigGeometry, *, distance_mm: float) -> NDArray[np.float64]:
    """Points (n, 3) about the working distance that camera and projector both see."""
    lens, panel = rig.camera, rig.projector
    axes = np.linspace(0, lens.width - 1, _COLUMNS), np.linspace(0, lens.height - 1, _ROWS)
    rays = lens.unproject(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2))
    rays = rays / rays[:, 2:]
    points = np.concatenate([rays * distance_mm * share for share in _DEPTHS])
    there = transform(rig.rt_proj_cam, points)
    lit = there[:, 2] > 0
    seen = np.full((len(points), 2), np.nan)
    seen[lit] = panel.project(there[lit])
    with np.errstate(invalid="ignore"):
        inside = (seen > -0.5) & (seen < np.array([panel.width, panel.height]) - 0.5)
    return np.asarray(points[inside.all(axis=1)])


def _as_seen_before(
    points: NDArray[np.float64], rig: RigGeometry, earlier: RigGeometry
) -> NDArray[np.float64]:
    """Where the earlier calibration puts what the rig measures at points."""
    if not len(points):
        return points
    pixels = rig.camera.project(points)
    coordinates = rig.projector.project(transform(rig.rt_proj_cam, points))
    slopes = earlier.camera.unproject(pixels)
    slopes = slopes[:, :2] / slopes[:, 2:]
    start = float(np.median(points[:, 2]))
    depth, _ = depth_along_rays(
        earlier, slopes, coordinates, np.ones_like(coordinates), start_mm=start
    )
    return np.column_stack([slopes * depth[:, np.newaxis], depth])


def _without_motion(moved: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    a, b = moved - moved.mean(axis=0), points - points.mean(axis=0)
    left, _, right = np.linalg.svd(a.T @ b)
    proper = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
    return a @ (left @ proper @ right) - b


def _predicted(rigs: tuple[RigGeometry, ...], points: NDArray[np.float64]) -> float:
    """Root mean square change that the covariances explain, once a rigid motion is removed."""
    total, known = 0.0, False
    motion = _motions(points)
    keep = np.eye(motion.shape[0]) - motion @ np.linalg.pinv(motion)
    for rig in rigs:
        if rig.covariance is None:
            continue
        known = True
        lever = RigCovariance(replace(rig, covariance=None), rig.covariance, 0.0).point_jacobian(
            points
        )
        lever = keep @ lever.reshape(-1, lever.shape[-1])
        total += float(np.einsum("in,nm,im->", lever, rig.covariance, lever))
    return float(np.sqrt(total / len(points))) if known else float("nan")


def _motions(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Displacements (3n, 6) of points by small rotations and translations."""
    offset = points - points.mean(axis=0)
    turns = [np.cross(axis, offset) for axis in np.eye(3)]
    shifts = [np.broadcast_to(axis, offset.shape) for axis in np.eye(3)]
    return np.stack([m.ravel() for m in (*turns, *shifts)], axis=1)
