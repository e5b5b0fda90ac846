"""Optics of the simulated rig: lenses through OpenCV's own distortion functions, and the panel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Triple = tuple[float, float, float]


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
        ``x_lens = rotation x_scene + translation``, mm.
    vignetting : float
        Light falls off with this power of the cosine from the optical axis; 4 is natural.
    """

    width: int
    height: int
    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    vignetting: float = 4.0

    @classmethod
    def looking_at(
        cls,
        *,
        width: int,
        height: int,
        focal_px: float,
        position: Triple,
        target: Triple,
        distortion: tuple[float, float, float, float, float],
        centre_shift: tuple[float, float] = (0.0, 0.0),
        vignetting: float = 4.0,
    ) -> SimulatedLens:
        """A lens at ``position`` aimed at ``target`` (scene frame, mm), upright."""
        rotation = _upright(position, target)
        matrix = np.array(
            [
                [focal_px, 0, (width - 1) / 2 + centre_shift[0]],
                [0, focal_px, (height - 1) / 2 + centre_shift[1]],
                [0, 0, 1.0],
            ]
        )
        translation = -rotation @ np.array(position)
        return cls(width, height, matrix, np.array(distortion), rotation, translation, vignetting)

    def moved(self, position: Triple, target: Triple) -> SimulatedLens:
        """The same lens at another place, upright."""
        rotation = _upright(position, target)
        return replace(self, rotation=rotation, translation=-rotation @ np.array(position))

    @property
    def position(self) -> NDArray[np.float64]:
        """Optical centre in the scene frame, (3,) mm."""
        return np.asarray(-self.rotation.T @ self.translation)

    @property
    def axis(self) -> NDArray[np.float64]:
        """Optical axis in the scene frame, (3,) unit."""
        return np.asarray(self.rotation[2])

    @property
    def rt_lens_scene(self) -> NDArray[np.float64]:
        """Pose (6,), Rodrigues and mm, that takes points of the scene to the lens's frame."""
        return np.concatenate([cv2.Rodrigues(self.rotation)[0].ravel(), self.translation])

    def rays(self) -> NDArray[np.float64]:
        """Viewing direction of every pixel in the scene frame, (height * width, 3), unit."""
        return np.asarray(self._own_rays() @ self.rotation)

    def transmission(self) -> NDArray[np.float64]:
        """What vignetting leaves of the light of every pixel, (height * width,)."""
        return np.asarray(self._own_rays()[:, 2] ** self.vignetting)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (n, 2) of points (n, 3) of the scene."""
        if len(points) == 0:
            return np.empty((0, 2))
        rodrigues = cv2.Rodrigues(self.rotation)[0]
        pixels, _ = cv2.projectPoints(
            points, rodrigues, self.translation, self.matrix, self.distortion
        )
        return np.asarray(pixels.reshape(-1, 2))

    def _own_rays(self) -> NDArray[np.float64]:
        return _directions(
            self.width, self.height, tuple(self.matrix.ravel()), tuple(self.distortion)
        )


@dataclass(frozen=True, kw_only=True)
class PanelResponse:
    """What becomes of a level on its way from a file to the light of the projector's panel.

    Attributes
    ----------
    gamma : float
        Exponent of the response.
    blur_px : float
        Standard deviation of the optics' blur, in panel pixels.
    black : float
        Light of a dark panel, as a share of full light.
    """

    gamma: float = 1.0
    blur_px: float = 0.6
    black: float = 0.004

    def light(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Light of every panel pixel, 1 for white, of a picture's levels."""
        of_level = ((np.arange(256) / 255) ** self.gamma).astype(np.float32)
        light = of_level[image]
        if self.blur_px > 0:
            # Beyond the panel there is no light that could blur into it.
            dark = cv2.BORDER_CONSTANT
            blurred = cv2.GaussianBlur(light, (0, 0), self.blur_px, borderType=dark)
            light = np.asarray(blurred, np.float32)
        return np.asarray(self.black + (1 - self.black) * light, np.float32)


def _upright(position: Triple, target: Triple) -> NDArray[np.float64]:
    forward = np.subtract(target, position).astype(float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


@lru_cache(maxsize=2)
def _directions(
    width: int, height: int, matrix: tuple[float, ...], distortion: tuple[float, ...]
) -> NDArray[np.float64]:
    """Viewing directions in the lens's own frame, which all its places share."""
    col, row = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    pixels = np.stack([col, row], axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    flat = cv2.undistortPointsIter(
        pixels, np.reshape(matrix, (3, 3)), np.array(distortion), np.eye(3), np.eye(3), criteria
    ).reshape(-1, 2)
    local = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    local.flags.writeable = False
    return local
