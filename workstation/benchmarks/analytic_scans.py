"""Scans of a surface given by a formula, at any size of picture, without frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import AxisCoordinate, CorrespondenceMap
from acquisition.patterns import Axis
from calibration.lens import Lens
from calibration.rig_geometry import RigGeometry
from fitting.depth_solver import panel_points

_DISTANCE_MM = 450.0
SIGMA_PX = 0.03
_ROWS_AT_A_TIME = 256


def surface_rig(camera_width: int) -> RigGeometry:
    """Camera and projector with distortion, their fields alike at any number of pixels."""
    height = camera_width * 3 // 4
    focal = 2.3 * camera_width
    distortion = [-0.08, 0.05, 4e-4, -3e-4, 0.01]
    centre = [(camera_width - 1) / 2, (height - 1) / 2]
    camera = Lens(
        "LENSMODEL_OPENCV5",
        np.array([focal, focal, *centre, *distortion]),
        camera_width,
        height,
    )
    projector = Lens(
        "LENSMODEL_OPENCV5",
        np.array([1750.0, 1750, 640, 400, -0.05, 0.03, -5e-4, 2e-4, 0]),
        1280,
        800,
    )
    return RigGeometry(camera, projector, np.array([0.02, 0.33, 0.01, -150.0, 6.0, 25.0]))


def relief(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height in mm towards the camera: ridges and furrows, and a few thick strokes."""
    strokes = np.maximum(0, np.sin(x / 9) * np.sin(y / 7) - 0.6)
    return np.asarray(0.15 * np.sin(x / 2.1) * np.sin(y / 2.7) + 3 * strokes)


def scan_of(rig: RigGeometry, *, seed: int = 0) -> CorrespondenceMap:
    """What decoding would hand on of the relief, with noise of known variance."""
    shape = rig.camera.height, rig.camera.width
    slopes = rig.camera.pixel_slopes(origin=(0, 0), shape=shape)
    panel = np.empty((*shape, 2))
    for first in range(0, shape[0], _ROWS_AT_A_TIME):
        rows = slice(first, first + _ROWS_AT_A_TIME)
        here = slopes[rows].reshape(-1, 2)
        depth = np.full(len(here), _DISTANCE_MM)
        for _ in range(12):
            depth = _DISTANCE_MM - relief(depth * here[:, 0], depth * here[:, 1])
        panel[rows] = panel_points(here, depth, rig).reshape(*slopes[rows].shape[:2], 2)
    random = np.random.default_rng(seed)
    panel += random.normal(0, SIGMA_PX, panel.shape)
    variance = np.full(shape, SIGMA_PX**2, np.float32)
    level = np.full(shape, 100, np.float32)
    axes = {
        axis: AxisCoordinate(np.ascontiguousarray(panel[..., i]), variance, level, 24.0, 1.0)
        for i, axis in enumerate((Axis.COLUMN, Axis.ROW))
    }
    return CorrespondenceMap(axes, level, np.zeros(shape, np.uint16), (0, 0), 1.0)
