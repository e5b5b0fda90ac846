"""Scans and photographs of a surface given by a formula, as decoding would hand them on.

The truth for tests and benchmarks of registration: rays are marched to the surface, the projector's
coordinates there get Gaussian noise, and some are replaced by wrong ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import AxisCoordinate, CorrespondenceMap
from acquisition.patterns import Axis
from calibration.lens import Lens, invert, rotation, rt_from_matrix, transform
from calibration.rig_geometry import RigGeometry
from workstation.benchmarks.analytic_scans import relief, surface_rig

DISTANCE_MM = 450.0
SIGMA_PX = 0.05
PERIOD_PX = 24.0
RIG = surface_rig(480)
_PANEL = (1280, 800)
_ROUNDS = 25


def looking_from(eye: tuple[float, float, float]) -> NDArray[np.float64]:
    """``rt_cam_rig`` (6,) of a camera at a place (mm) that looks at the middle of the surface."""
    ahead = np.array([0.0, 0.0, DISTANCE_MM]) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    matrix = np.stack([right, np.cross(ahead, right), ahead])
    return rt_from_matrix(matrix, -matrix @ np.array(eye))


VIEWS = {
    "left": looking_from((-180.0, 20.0, 60.0)),
    "right": looking_from((200.0, -30.0, 80.0)),
    "front": looking_from((20.0, 10.0, -20.0)),
}
OTHER_LENS = Lens(
    "LENSMODEL_OPENCV4",
    np.array([1240.0, 1241.5, 248.0, 171.0, -0.15, 0.12, -6e-4, 5e-4]),
    480,
    360,
)


def photograph(
    rt_cam_rig: NDArray[np.float64],
    *,
    seed: int,
    lens: Lens = RIG.camera,
    rig: RigGeometry = RIG,
    sigma_px: float = SIGMA_PX,
    wrong: float = 0.0,
    flat: bool = False,
) -> CorrespondenceMap:
    """What a camera decodes of the projector's code.

    Parameters
    ----------
    rt_cam_rig : (6,) array
        Pose of the camera; zeros for the scan's own.
    seed : int
    lens : Lens
    rig : RigGeometry
    sigma_px : float
        Noise of the projector's coordinates.
    wrong : float
        Share of pixels that are decoded wrongly: half of them by whole periods, over patches, the
        others anywhere on the panel.
    flat : bool
        Whether the surface is a plane.
    """
    shape = lens.height, lens.width
    scene = _Scene(lens, rig, flat)
    panel = _true_panel(scene, tuple(float(number) for number in rt_cam_rig)).copy()
    random = np.random.default_rng([seed, 0x50484F])
    panel += random.normal(0, sigma_px, panel.shape)
    if wrong:
        _spoil(panel, random, wrong)
    outside = ~((panel >= -0.5) & (panel < np.array(_PANEL) - 0.5)).all(axis=-1)
    panel[outside] = np.nan
    level = np.full(shape, 100, np.float32)
    variance = np.where(outside, np.inf, sigma_px**2).astype(np.float32)
    axes = {
        axis: AxisCoordinate(
            np.ascontiguousarray(panel[..., number]), variance, level, PERIOD_PX, 1.0
        )
        for number, axis in enumerate((Axis.COLUMN, Axis.ROW))
    }
    return CorrespondenceMap(axes, level, np.where(outside, 16, 0).astype(np.uint16), (0, 0), 1.0)


def noiseless(
    lens: Lens, rt_cam_rig: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What every pixel truly sees: points (rows, cols, 3) of the rig's frame, and its code.

    The code (rows, cols, 2) is the projector's column and row.
    """
    points = _surface_points(lens, rt_cam_rig, flat=False)
    code = _true_panel(_Scene(lens, RIG, flat=False), tuple(map(float, rt_cam_rig)))
    return points.reshape(lens.height, lens.width, 3), code


@dataclass(frozen=True, eq=False)
class _Scene:
    """What a camera looks at, and through what; the same where the numbers are."""

    lens: Lens
    rig: RigGeometry
    flat: bool

    @property
    def _key(self) -> tuple[object, ...]:
        lens, rig = self.lens, self.rig
        size = lens.model, lens.width, lens.height
        return *size, lens.intrinsics.tobytes(), rig.parameters.tobytes(), self.flat

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Scene) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@lru_cache(maxsize=16)
def _true_panel(scene: _Scene, rt_cam_rig: tuple[float, ...]) -> NDArray[np.float64]:
    """(rows, cols, 2) projector coordinates without noise."""
    points = _surface_points(scene.lens, np.array(rt_cam_rig), scene.flat)
    panel = scene.rig.projector.project(transform(scene.rig.rt_proj_cam, points))
    return panel.reshape(scene.lens.height, scene.lens.width, 2)


def _surface_points(lens: Lens, rt_cam_rig: NDArray[np.float64], flat: bool) -> NDArray[np.float64]:
    """(pixels, 3) points of the surface in the rig's frame."""
    slopes = lens.pixel_slopes(origin=(0, 0), shape=(lens.height, lens.width)).reshape(-1, 2)
    rt_rig_cam = invert(rt_cam_rig)
    rays = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) @ rotation(rt_rig_cam).T
    eye = rt_rig_cam[3:]
    reach = (DISTANCE_MM - eye[2]) / rays[:, 2]
    for _ in range(0 if flat else _ROUNDS):
        at = eye + reach[:, np.newaxis] * rays
        reach = (DISTANCE_MM - relief(at[:, 0], at[:, 1]) - eye[2]) / rays[:, 2]
    return np.asarray(eye + reach[:, np.newaxis] * rays)


def _spoil(panel: NDArray[np.float64], random: np.random.Generator, share: float) -> None:
    """Wrong orders over patches of 8 × 8 pixels, and single wrong pixels, in place."""
    rows, cols = panel.shape[:2]
    patches = random.random((rows // 8 + 1, cols // 8 + 1)) < share / 2
    wrong = np.repeat(np.repeat(patches, 8, axis=0), 8, axis=1)[:rows, :cols]
    panel[wrong] += PERIOD_PX * random.choice([-2, -1, 1, 2], (int(wrong.sum()), 1))
    single = random.random((rows, cols)) < share / 2
    panel[single] = random.uniform([0, 0], _PANEL, (int(single.sum()), 2))
