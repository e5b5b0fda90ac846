"""The walk of a visitor along a wall: slower before each painting, nearer to it, looking ahead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# From the wall: before a painting by its own size, but no nearer than; and half way to the next.
_NEAR, _NEAREST, _FAR = 1.5, 0.25, 2.5
_BEFORE, _BEYOND = 0.85, 0.75  # where the walk begins and ends, in bays
_BAY = 2.0  # of the wall beyond the outermost paintings
_DWELL = 0.8  # share by which it is slower before a painting
_AHEAD = 0.3  # bays that the eye is ahead by, half way


@dataclass(frozen=True)
class Walk:
    """A walk along paintings, left to right.

    Attributes
    ----------
    middles : (paintings,) array
        Of the paintings along the wall, mm.
    sides : (paintings,) array
        The larger side of each with its frame, mm: small ones are looked at from nearer.
    eye_height : float
        Of their middles and of the camera, mm.
    unit : float
        Of distances: the largest side of any painting, mm.
    """

    middles: NDArray[np.float64]
    sides: NDArray[np.float64]
    eye_height: float
    unit: float

    def pose(self, share: float) -> NDArray[np.float64]:
        """Camera to scene, (4, 4), at a share of the walk from 0 to 1.

        x is along the wall, y up, z from the wall into the room.
        """
        last = len(self.middles) - 1
        bays = -_BEFORE + share * (last + _BEFORE + _BEYOND)
        between = 0.5 * (1 - np.cos(2 * np.pi * bays))  # 0 before a painting, 1 half way
        nearest = self.sides[round(min(max(bays, 0), last))]
        near = max(_NEAR * nearest, _NEAREST * self.unit)
        distance = near + (_FAR * self.unit - near) * between
        eye = np.array([self._along(bays), self.eye_height, distance])
        gaze = float(np.clip(bays + _AHEAD * between, 0, last))
        backward = eye - np.array([self._along(gaze), self.eye_height, 0.0])
        backward /= np.linalg.norm(backward)
        up = np.array([0.0, 1.0, 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross(up, backward), up, backward], axis=1)
        pose[:3, 3] = eye
        return pose

    def _along(self, bays: float) -> float:
        """Place along the wall, mm, of a number of bays, slowed down at whole numbers."""
        slowed = bays - _DWELL * np.sin(2 * np.pi * bays) / (2 * np.pi)
        last = len(self.middles) - 1
        whole = float(np.clip(slowed, 0, last))
        inside = float(np.interp(whole, np.arange(last + 1), self.middles))
        return inside + (slowed - whole) * _BAY * self.unit
