"""Lenses of the simulated rig, through OpenCV's own distortion functions."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SimulatedLens:
    """A lens with its pose, by OpenCV's model.

    Attributes
    ----------
    width, height : int
        Imager in pixels.
    matrix : (3, 3) float64 array
    distortion : (5,) float64 array
        k1, k2, p1, p2, k3.
    rotation : (3, 3) float64 array
    translation : (3,) float64 array
        ``x_lens = rotation x_canvas + translation``, mm.
    """

    width: int
    height: int
    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @classmethod
    def looking_at(
        cls,
        *,
        width: int,
        height: int,
        focal_px: float,
        position: tuple[float, float, float],
        target: tuple[float, float, float],
        distortion: tuple[float, float, float, float, float],
        centre_shift: tuple[float, float] = (0.0, 0.0),
    ) -> SimulatedLens:
        """A lens at ``position`` aimed at ``target`` (canvas frame, mm), upright."""
        forward = np.subtract(target, position).astype(float)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        matrix = np.array(
            [
                [focal_px, 0, (width - 1) / 2 + centre_shift[0]],
                [0, focal_px, (height - 1) / 2 + centre_shift[1]],
                [0, 0, 1.0],
            ]
        )
        return cls(
            width, height, matrix, np.array(distortion), rotation, -rotation @ np.array(position)
        )

    @property
    def position(self) -> NDArray[np.float64]:
        """Optical centre in the canvas frame, (3,) mm."""
        return np.asarray(-self.rotation.T @ self.translation)

    def rays(self) -> NDArray[np.float64]:
        """Viewing direction of every pixel in the canvas frame, (height * width, 3), unit."""
        col, row = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height))
        pixels = np.stack([col, row], axis=-1).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
        flat = cv2.undistortPointsIter(
            pixels, self.matrix, self.distortion, np.eye(3), np.eye(3), criteria
        ).reshape(-1, 2)
        local = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        return np.asarray(local @ self.rotation)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (n, 2) of canvas points (n, 3)."""
        if len(points) == 0:
            return np.empty((0, 2))
        rodrigues = cv2.Rodrigues(self.rotation)[0]
        pixels, _ = cv2.projectPoints(
            points, rodrigues, self.translation, self.matrix, self.distortion
        )
        return np.asarray(pixels.reshape(-1, 2))
