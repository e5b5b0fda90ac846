"""What a simulated light arm is calibrated with: mirror spheres beside a flat white plate."""

from __future__ import annotations

import numpy as np

from devices.simulated.scene_objects import PlacedSurface, PolishedSphere, SceneObject, Wall
from devices.simulated.shading_kernels import reflected
from devices.simulated.surface import Surface

# Of the field's width: the plate's width, and how far the spheres' middles are from its middle.
_PLATE = 0.66
_ASIDE = 0.41
# Of the field's height.
_PLATE_HEIGHT = 0.82
_RAISED = 0.27
_PITCH_MM = 0.5
_WHITE = 0.9
_BEHIND_MM = 60.0


def place_arm_targets(
    width_mm: float, height_mm: float, *, sphere_mm: float
) -> tuple[PlacedSurface, tuple[SceneObject, ...]]:
    """A white plate with a mirror sphere on either side, before a white wall.

    Give both to :meth:`~devices.simulated.scene.SimulatedScene.replace_subject`.

    Parameters
    ----------
    width_mm, height_mm : float
        Of the field that the camera sees.
    sphere_mm : float
        Radius of the spheres.

    Returns
    -------
    plate : PlacedSurface
        In the plane in which paintings hang.
    around : tuple of SceneObject
        Two spheres, one low on the left and one high on the right, and a wall well behind.
    """
    plate_mm = _PLATE * width_mm, _PLATE_HEIGHT * height_mm
    shape = round(plate_mm[1] / _PITCH_MM) + 1, round(plate_mm[0] / _PITCH_MM) + 1
    plate = Surface.uniform(
        np.zeros(shape, np.float32),
        pitch_mm=_PITCH_MM,
        canvas_mm=plate_mm,
        albedo=_WHITE,
        roughness=1.0,
        back_mm=-4.0,
    )
    middle = np.array([_ASIDE * width_mm, _RAISED * height_mm, 0.5 * sphere_mm])
    spheres = tuple(PolishedSphere(middle * [side, side, 1.0], sphere_mm) for side in (-1.0, 1.0))
    return PlacedSurface(plate), (*spheres, Wall(-_BEHIND_MM, albedo=_WHITE))


def white_reflectance() -> float:
    """What the plate reflects towards its normal of light along it, 1 for a perfect white."""
    finish = np.array([_WHITE, _WHITE, _WHITE, 1.0, 0.0, 0.0], np.float32)
    return float(reflected(finish, np.array([0.0, 1.0, 0.0]), 1.0, 1.0, 1.0, 1.0))
