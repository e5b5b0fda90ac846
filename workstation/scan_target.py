"""From the precision that heights are to have to that of a scan's projector coordinates."""

from __future__ import annotations

import numpy as np

from acquisition.patterns import Axis
from calibration.errors import CalibrationError
from calibration.lens import transform
from calibration.rig_geometry import RigGeometry
from fitting.depth_solver import panel_points

# What registering photographs needs of the coordinate that tells little of heights, px.
REGISTRATION_SIGMA_PX = 0.3
# Of the working distance.
_STEP = 1e-4
_AXES = (Axis.COLUMN, Axis.ROW)


def panel_sigma(rig: RigGeometry, height_sigma_mm: float) -> dict[Axis, float]:
    """Standard deviations of the projector's coordinates that heights of some precision take.

    The height is told by whichever coordinate it moves the more; the other one has to be good
    enough for registration alone.

    Parameters
    ----------
    rig : RigGeometry
    height_sigma_mm : float
        Of a pixel's depth, in the middle of the picture where camera and projector look at the
        same point.

    Returns
    -------
    dict of Axis to float
        Pixels of the panel.

    Raises
    ------
    CalibrationError
        Camera and projector look along the same line: nothing tells a height.
    """
    depth = _working_distance(rig)
    middle = np.zeros((2, 2))
    here, there = panel_points(middle, np.array([depth, depth * (1 + _STEP)]), rig)
    per_mm = np.abs(there - here) / (depth * _STEP)
    if not per_mm.max() > 1e-9:
        raise CalibrationError(
            "camera and projector look along the same line, so no precision of the code gives a "
            "height; name the code's own precision with --target-px, or calibrate anew"
        )
    sigma = {axis: height_sigma_mm * float(per_mm[n]) for n, axis in enumerate(_AXES)}
    telling = _AXES[int(np.argmax(per_mm))]
    return {
        axis: value if axis is telling else max(value, REGISTRATION_SIGMA_PX)
        for axis, value in sigma.items()
    }


def _working_distance(rig: RigGeometry) -> float:
    """Depth along the camera's axis at which the middle of the panel comes nearest to it."""
    middle = np.array([[(rig.projector.width - 1) / 2, (rig.projector.height - 1) / 2]])
    depths = np.geomspace(1.0, 1e5, 2001)
    points = depths[:, np.newaxis] * np.array([0.0, 0.0, 1.0])
    lit = transform(rig.rt_proj_cam, points)[:, 2] > 0
    found = panel_points(np.zeros((len(depths), 2)), depths, rig)
    apart = np.where(lit, np.linalg.norm(found - middle, axis=1), np.inf)
    return float(depths[int(np.argmin(apart))])
