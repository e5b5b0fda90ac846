"""Geometry of a light arm as numbers to be fitted, and where they start.

See :mod:`calibration.light_arm` for the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.lamp import Lamp
from calibration.lens import compose, rotation, rt_from_matrix, transform
from devices.interfaces import ArmPose

# What is known of any arm: standard deviations of the elevation's zero, lean, sag (rad), and of the
# three coordinates of the point that the lamp shines at, as a share of the radius.
_ZERO_SIGMA = np.radians(10.0)
_LEAN_SIGMA = np.radians(5.0)
_SAG_SIGMA = np.radians(3.0)
_AIM_SIGMA = 0.2
_START_ROOT = 1.5


@dataclass(frozen=True)
class ArmParameters:
    """Numbers of the arm's model.

    Attributes
    ----------
    rt_rig_ring : (6,) float64 array
        Pose of the ring in the rig's frame; its z is the axis about which the azimuth turns.
    radius_mm : float
        From the ring's centre to the lamp.
    elevation_zero, lean, sag : float
        Radians.
    aim : (3,) float64 array
        Point of the ring's frame that the lamp shines at, mm.
    intensity : (3,) float64 array
        Of the lamp, as of :class:`~calibration.lamp.Lamp`.
    exponent : float
        Likewise.
    """

    rt_rig_ring: NDArray[np.float64]
    radius_mm: float
    elevation_zero: float
    lean: float
    sag: float
    aim: NDArray[np.float64]
    intensity: NDArray[np.float64]
    exponent: float

    def positions(self, poses: Sequence[ArmPose]) -> NDArray[np.float64]:
        """The lamp's places (poses, 3) in the rig's frame, mm."""
        level = np.array([pose.elevation for pose in poses]) + self.elevation_zero
        azimuth = np.array([pose.azimuth for pose in poses])
        raised = level - self.sag * np.cos(level)
        out, up = np.cos(raised), np.sin(raised)
        aside = -np.sin(self.lean) * up
        c, s = np.cos(azimuth), np.sin(azimuth)
        on_ring = np.stack([c * out - s * aside, s * out + c * aside, np.cos(self.lean) * up], 1)
        turned = on_ring @ rotation(self.rt_rig_ring).T
        return np.asarray(self.rt_rig_ring[3:] + self.radius_mm * turned)

    def axes(self, poses: Sequence[ArmPose]) -> NDArray[np.float64]:
        """Unit vectors (poses, 3) along which the lamp shines brightest."""
        axes = transform(self.rt_rig_ring, self.aim) - self.positions(poses)
        return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))

    def lamp(self, pose: ArmPose) -> Lamp:
        """The lamp at a pose, in the rig's frame."""
        place, axis = self.positions([pose])[0], self.axes([pose])[0]
        return Lamp(place, axis, self.intensity, self.exponent)

    def as_array(self) -> NDArray[np.float64]:
        """The numbers (17,) that are fitted.

        They are a turn of the ring and its shift over the radius, which are those from the pose
        here and so zero, the logarithm of the radius, zero, lean, sag, aim over the radius, the
        logarithms of the intensity, and the root of the exponent.
        """
        return np.concatenate(
            [
                np.zeros(6),
                [np.log(self.radius_mm), self.elevation_zero, self.lean, self.sag],
                self.aim / self.radius_mm,
                np.log(self.intensity),
                [np.sqrt(self.exponent)],
            ]
        )

    def moved(self, step: NDArray[np.float64]) -> ArmParameters:
        """With a step (17,) added to the numbers; the ring turns about its own centre."""
        numbers = self.as_array() + step
        turn = compose(np.r_[numbers[:3], np.zeros(3)], np.r_[self.rt_rig_ring[:3], np.zeros(3)])
        radius = float(np.exp(numbers[6]))
        return ArmParameters(
            rt_rig_ring=np.r_[turn[:3], self.rt_rig_ring[3:] + self.radius_mm * numbers[3:6]],
            radius_mm=radius,
            elevation_zero=float(numbers[7]),
            lean=float(numbers[8]),
            sag=float(numbers[9]),
            aim=numbers[10:13] * radius,
            intensity=np.exp(numbers[13:16]),
            exponent=float(numbers[16] ** 2),
        )

    def prior_residuals(self) -> NDArray[np.float64]:
        """What is known of any arm, over its standard deviation."""
        known = [
            self.elevation_zero / _ZERO_SIGMA,
            self.lean / _LEAN_SIGMA,
            self.sag / _SAG_SIGMA,
        ]
        return np.concatenate([known, self.aim / (_AIM_SIGMA * self.radius_mm)])


def initial_arm(
    poses: Sequence[ArmPose],
    spots: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
    *,
    level: NDArray[np.float64],
    target: NDArray[np.float64],
) -> ArmParameters:
    """An arm without errors that fits reflected rays best.

    Parameters
    ----------
    poses : sequence of ArmPose
    spots : sequence of (points, directions)
        For each sphere, (poses, 3) each; NaN where there is no highlight.
    level : (3,) array
        Usual irradiance of the white target.
    target : (3,) array
        Its middle, mm.

    Raises
    ------
    CalibrationError
        The rays do not tell a radius.
    """
    azimuth = np.array([pose.azimuth for pose in poses])
    elevation = np.array([pose.elevation for pose in poses])
    nominal = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    turn = _turn_between(nominal, spots)
    for _ in range(3):
        centre, radius = _centre_and_radius(nominal @ turn.T, spots)
        lamps = centre + radius * nominal @ turn.T
        # Directions as seen from the centre instead of from each sphere.
        turn = _turn_between(nominal, [(p, _nearest(lamps, p, d) - centre) for p, d in spots])
    distance = float(np.mean(np.linalg.norm(lamps - target, axis=1)))
    return ArmParameters(
        rt_from_matrix(turn, centre),
        radius,
        0.0,
        0.0,
        0.0,
        np.zeros(3),
        level * distance**2 * 1.5,
        _START_ROOT**2,
    )


def _nearest(
    lamps: NDArray[np.float64], points: NDArray[np.float64], directions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points of the rays next to the lamps."""
    along = np.sum((lamps - points) * directions, axis=1, keepdims=True)
    return np.asarray(points + along * directions)


def _turn_between(
    nominal: NDArray[np.float64],
    spots: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
) -> NDArray[np.float64]:
    """Rotation that takes nominal directions to those seen (W. Kabsch, 1976)."""
    product = np.zeros((3, 3))
    for _, directions in spots:
        seen = np.isfinite(directions).all(axis=1)
        unit = directions[seen] / np.linalg.norm(directions[seen], axis=1, keepdims=True)
        product += unit.T @ nominal[seen]
    u, _, vt = np.linalg.svd(product)
    return np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)


def _centre_and_radius(
    directions: NDArray[np.float64],
    spots: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
) -> tuple[NDArray[np.float64], float]:
    """Centre and radius by least squares: lamps lie on the reflected rays."""
    rows, right = [], []
    for points, rays in spots:
        seen = np.isfinite(rays).all(axis=1)
        off = np.eye(3) - rays[seen, :, np.newaxis] * rays[seen, np.newaxis, :]
        rows.append(np.concatenate([off, off @ directions[seen, :, np.newaxis]], axis=2))
        right.append(np.einsum("kij,kj->ki", off, points[seen]))
    matrix, known = np.concatenate(rows).reshape(-1, 4), np.concatenate(right).ravel()
    found, *_ = np.linalg.lstsq(matrix, known, rcond=None)
    if not (np.isfinite(found).all() and found[3] > 0):
        raise CalibrationError(
            "the highlights do not tell where the lamp is: the poses are too alike, the spheres "
            "too close to one another, or their order was mixed up"
        )
    return found[:3], float(found[3])
