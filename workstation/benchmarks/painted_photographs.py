"""Photographs of a part of the simulated oil painting, with poses and lamps as they truly are.

The painting is finer than the texels and of a reflectance that is not fitted (microfacets under
varnish). Each pixel is the mean of four by the simulated camera, since a sensor's pixel gathers the
light of its area, and the simulated one that of its centre. Noise is that of a bracket's merge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from acquisition.light_poses import spread_poses
from calibration.lamp import Lamp
from calibration.lens import Lens, rt_from_matrix
from devices.interfaces import ArmLimits, ArmPose
from devices.simulated.rig import SimulatedRig, build_rig
from devices.simulated.settings import PaintingKind, SimulationSettings
from devices.simulated.shading_kernels import shade
from fitting.digital_copy import DigitalCopy
from fitting.height_field import HeightField
from fitting.neighbour_kernels import triangle_normals
from fitting.reflectance.photographs import Photograph
from fitting.reflectance.ray_kernels import BLOCKED
from fitting.reflectance.terrain import Terrain
from fitting.relief_classification import ReliefOptions, classify_relief

Floats = NDArray[np.float64]

PLACES = ("front", "left", "above")
LIMITS = ArmLimits((0.0, math.radians(350)), (math.radians(15), math.radians(85)))
PITCH_MM = 0.2
# Of radiance, 1 being white paper in full light.
READ_SIGMA = 0.001
PHOTON_GAIN = 2e-5
_WITHIN = 2  # edge, in simulated pixels, of a pixel
_MARGIN_MM = 4.0


@dataclass(frozen=True)
class PaintedScene:
    """A part of the painting before its rig.

    Attributes
    ----------
    rig : SimulatedRig
    width, height : int
        Of the photographs.
    """

    rig: SimulatedRig
    width: int
    height: int

    @classmethod
    def of(cls, *, width: int = 240, seed: int = 0) -> PaintedScene:
        """A scene whose photographs show the middle of the painting at 0.2 mm a pixel."""
        height = width * 3 // 4
        distance = 1170.0  # of the camera at its first place
        settings = SimulationSettings(
            painting=PaintingKind.OIL,
            seed=seed,
            camera_width=_WITHIN * width,
            camera_height=_WITHIN * height,
            focal_px=_WITHIN * distance / PITCH_MM,
        )
        return cls(build_rig(settings), width, height)

    def copy(self, *, height_sigma_mm: float = 0.0, seed: int = 0) -> DigitalCopy:
        """The true relief, mean over each texel, with noise if wanted; without reflectance."""
        cols = int((self.width * PITCH_MM - 2 * _MARGIN_MM) / PITCH_MM)
        rows = int((self.height * PITCH_MM - 2 * _MARGIN_MM) / PITCH_MM)
        x0, y0 = -(cols - 1) / 2 * PITCH_MM, (rows - 1) / 2 * PITCH_MM
        x, y = np.meshgrid(x0 + PITCH_MM * np.arange(cols), y0 - PITCH_MM * np.arange(rows))
        quarter = PITCH_MM / 4
        height = np.mean(
            [
                self.rig.painting.height_at(x + right, y + up)
                for right in (-quarter, quarter)
                for up in (-quarter, quarter)
            ],
            axis=0,
        )
        sigma = max(height_sigma_mm, 1e-3)
        if height_sigma_mm > 0:
            height = height + sigma * np.random.default_rng(seed).standard_normal(height.shape)
        mask = np.ones(height.shape, np.bool_)
        variance = np.full(height.shape, sigma**2, np.float32)
        field = HeightField(
            height.astype(np.float32), mask, variance, PITCH_MM, (x0, y0), np.zeros(6)
        )
        normal, slope = triangle_normals(field.height, mask, variance, PITCH_MM)
        return DigitalCopy(field, normal, classify_relief(field, ReliefOptions()), slope)

    def surroundings(self, copy: DigitalCopy, *, reach_mm: float = 60.0) -> Floats:
        """True points (n, 3) around a copy, a texel apart: they throw shadows on it."""
        heights = copy.height_field
        pitch = heights.pitch_mm
        further = int(reach_mm / pitch)
        rows, cols = heights.shape
        x = heights.origin_mm[0] + pitch * np.arange(-further, cols + further)
        y = heights.origin_mm[1] - pitch * np.arange(-further, rows + further)
        grid = np.stack(np.meshgrid(x, y), axis=-1)
        beyond = np.ones(grid.shape[:2], np.bool_)
        beyond[further:-further, further:-further] = False
        place = grid[beyond]
        return np.column_stack([place, self.rig.painting.height_at(place[:, 0], place[:, 1])])

    def lamp(self, pose: ArmPose) -> Lamp:
        """The lamp as it truly is."""
        scene = self.rig.scene
        position = scene.arm.lamp_position(pose)
        # White paper, 1 / π, has radiance 1 where it faces the lamp at the arm's radius.
        intensity = math.pi * scene.arm.radius**2 * np.array(scene.lamp.colour)
        axis = scene.lamp.axis(position, scene.arm)
        return Lamp(position, axis, intensity, scene.lamp.exponent)

    def photographs(
        self,
        poses: Sequence[ArmPose],
        *,
        places: Sequence[str] = PLACES,
        noise: bool = True,
        seed: int = 0,
    ) -> list[Photograph]:
        """Photographs under each pose of the lamp, from each place."""
        return [
            self._photograph(place, pose, noise, [seed, PLACES.index(place), number])
            for place in places
            for number, pose in enumerate(poses)
        ]

    def _photograph(self, place: str, pose: ArmPose, noise: bool, seed: list[int]) -> Photograph:
        scene = self.rig.scene
        view, lamp = scene.view(place), self.lamp(pose)
        colour = lamp.intensity / (math.pi * scene.arm.radius**2)
        hidden = scene.subject.hides(view.points, lamp.position)
        channels = [
            shade(
                *(view.points, view.normals, view.finish, hidden, view.lens.position),
                *(lamp.position, lamp.axis, lamp.exponent, scene.arm.radius),
                np.tile(np.eye(3)[c] * colour[c], (2, 2, 1)),
                view.lens.width,
            )
            for c in range(3)
        ]
        shape = (self.height, _WITHIN, self.width, _WITHIN, 3)
        image = np.stack(channels, axis=-1).reshape(shape).mean(axis=(1, 3))
        variance = READ_SIGMA**2 + PHOTON_GAIN * image
        if noise:
            random = np.random.default_rng(seed)
            image = image + np.sqrt(variance) * random.standard_normal(image.shape)
        lens = view.lens
        return Photograph(
            name=f"{place}, lamp at {math.degrees(pose.elevation):.0f}° above, "
            f"{math.degrees(pose.azimuth):.0f}° around",
            radiance=image.astype(np.float32),
            variance=variance.astype(np.float32),
            lens=Lens.from_opencv(
                _of_larger_pixels(lens.matrix),
                lens.distortion,
                width=self.width,
                height=self.height,
            ),
            rt_cam_canvas=rt_from_matrix(lens.rotation, lens.translation),
            lamp=lamp,
        )

    def shadow_accuracy(
        self, copy: DigitalCopy, terrain: Terrain, poses: Sequence[ArmPose]
    ) -> tuple[float, float]:
        """Share of texels and lamps told right from the copy, and the share that is in shadow.

        In shadow is what the painting hides from the lamp, or what faces away from it. Texels
        within one of the true edge of a shadow do not count.
        """
        heights = copy.height_field
        x, y = np.meshgrid(heights.texel_x_mm(), heights.texel_y_mm())
        points = np.stack([x, y, heights.height], axis=-1).reshape(-1, 3).astype(np.float64)
        true = points.copy()
        true[:, 2] = self.rig.painting.height_at(x, y).ravel()
        true_normals = self.rig.painting.points_at(true).normals
        flat = copy.normal_xy.reshape(-1, 2)
        normals = np.column_stack([flat, np.sqrt(1 - np.sum(flat**2, axis=1))])
        clearance = np.sqrt(heights.variance).ravel() + 1e-3 * heights.pitch_mm
        horizons = terrain.horizons(points)
        right = counted = dark = 0
        for pose in poses:
            lamp = self.lamp(pose)
            truth = self.rig.scene.subject.hides(true, lamp.position)
            truth |= np.sum(true_normals * lamp.directions(true), axis=1) <= 0
            found = terrain.findings(
                points, lamp.position, clearance_mm=clearance, horizons=horizons
            )
            own = found == BLOCKED
            own |= np.sum(normals * lamp.directions(points), axis=1) <= 0
            shadow = truth.reshape(heights.shape).astype(np.uint8)
            around = np.ones((3, 3), np.uint8)
            inner = (cv2.dilate(shadow, around) == cv2.erode(shadow, around)).ravel()
            right += int(np.sum((truth == own) & inner))
            counted += int(inner.sum())
            dark += int(np.sum(truth & inner))
        return right / counted, dark / counted


def lamp_poses(count: int) -> list[ArmPose]:
    """Poses spread evenly over what the simulated arm reaches."""
    return spread_poses(LIMITS, count)


def low_lamp_poses(count: int) -> list[ArmPose]:
    """Poses all around at 8° to 14° above the canvas, where strokes throw long shadows.

    Lower, the frame does, from beyond what is looked at.
    """
    turn = np.arange(count) * math.pi * (3 - math.sqrt(5)) % LIMITS.azimuth[1]
    return [
        ArmPose(float(azimuth), float(elevation))
        for azimuth, elevation in zip(turn, np.radians(np.linspace(8, 14, count)), strict=True)
    ]


def _of_larger_pixels(matrix: Floats) -> Floats:
    """Camera matrix of pixels that are each several by several of another camera."""
    larger = matrix.copy()
    larger[:2] /= _WITHIN
    larger[:2, 2] += 0.5 / _WITHIN - 0.5
    return larger
