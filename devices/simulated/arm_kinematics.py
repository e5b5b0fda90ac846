r"""Where the lamp of the simulated light arm truly is, and what it sends where.

The arc hangs on a ring about the canvas normal. With azimuth a and elevation e as the arm reports
them, the lamp is at

.. math:: c + R_x(t_x) R_y(t_y) R_z(a + a_0) R_x(w)\, r\, (\cos e', 0, \sin e'),
   \qquad e' = e + e_0 - s \cos e,

with the ring's centre c, its tilt t, the zero offsets a0 and e0, the arc's lean w about its own
radius, the arc's radius r, and the sag s of its arm under gravity. These are what a calibration of
the arm has to find.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from devices.interfaces import ArmPose


class LampCarrier(Protocol):
    """What carries the lamp: knows where it mechanically is, whether anyone trusts it or not."""

    @property
    def pose(self) -> ArmPose | None:
        """Where the axes stand; None if nothing carries a lamp."""

    @property
    def lamp_on(self) -> bool:
        """Whether the lamp is lit."""


@dataclass(frozen=True, kw_only=True)
class ArmKinematics:
    """Geometry of the arm; angles in radians, lengths in mm.

    Attributes
    ----------
    centre : (float, float, float)
        Centre of ring and arc in the scene frame.
    radius : float
        From the centre to the lamp.
    ring_tilt : (float, float)
        Of the ring's axis, about X and Y.
    arc_lean : float
        Of the arc's plane, about the radius at elevation 0.
    azimuth_zero, elevation_zero : float
        What the true angles are when the arm reports 0.
    sag : float
        By which the arc droops at elevation 0.
    """

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 600.0
    ring_tilt: tuple[float, float] = (0.0, 0.0)
    arc_lean: float = 0.0
    azimuth_zero: float = 0.0
    elevation_zero: float = 0.0
    sag: float = 0.0

    def lamp_position(self, pose: ArmPose) -> NDArray[np.float64]:
        """Where the lamp is, (3,) mm in the scene frame."""
        elevation = pose.elevation + self.elevation_zero - self.sag * np.cos(pose.elevation)
        on_arc = self.radius * np.array([np.cos(elevation), 0.0, np.sin(elevation)])
        turn = _about("z", pose.azimuth + self.azimuth_zero) @ _about("x", self.arc_lean)
        tilt = _about("x", self.ring_tilt[0]) @ _about("y", self.ring_tilt[1])
        return np.asarray(self.centre + tilt @ turn @ on_arc)


@dataclass(frozen=True, kw_only=True)
class Lamp:
    """The lamp; it shines at the arm's centre, but for an error of its mounting.

    Attributes
    ----------
    exponent : float
        Of the cosine from its axis by which it falls off.
    colour : (float, float, float)
        For red, green and blue.
    aim_error : (float, float, float)
        By which its axis misses the arm's centre, mm.
    """

    exponent: float = 6.0
    colour: tuple[float, float, float] = (1.0, 0.93, 0.82)
    aim_error: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def axis(self, position: NDArray[np.float64], arm: ArmKinematics) -> NDArray[np.float64]:
        """Direction in which it shines most from a position, (3,) unit."""
        axis = np.add(arm.centre, self.aim_error) - position
        return np.asarray(axis / np.linalg.norm(axis))


def _about(axis: str, angle: float) -> NDArray[np.float64]:
    """Right-handed rotation about an axis of the frame."""
    c, s = np.cos(angle), np.sin(angle)
    if axis == "x":
        return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    if axis == "y":
        return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
