"""What a simulated light arm is calibrated with: mirror spheres beside a flat white plate."""

from __future__ import annotations

import numpy as np

from devices.errors import DeviceError
from devices.simulated.scene_objects import PlacedSurface, PolishedSphere, SceneObject, Wall
from devices.simulated.shading_kernels import reflected
from devices.simulated.surface import Surface

# Of a sphere's radius: from its middle to the field's edge, and to the plate's.
_TO_FIELD = 1.4
_TO_PLATE = 1.25
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

    Raises
    ------
    DeviceError
        The spheres leave no room for the plate.
    """
    aside = 0.5 * width_mm - _TO_FIELD * sphere_mm
    plate_mm = 2 * (aside - _TO_PLATE * sphere_mm), _PLATE_HEIGHT * height_mm
    if not plate_mm[0] > 2 * sphere_mm:
        raise DeviceError(f"spheres of {sphere_mm:g} mm leave no room in {width_mm:g} mm")
    shape = round(plate_mm[1] / _PITCH_MM) + 1, round(plate_mm[0] / _PITCH_MM) + 1
    plate = Surface.uniform(
        np.zeros(shape, np.float32),
        pitch_mm=_PITCH_MM,
        canvas_mm=plate_mm,
        albedo=_WHITE,
        roughness=1.0,
        back_mm=-4.0,
    )
    middle = np.array([aside, _RAISED * height_mm, 0.5 * sphere_mm])
    spheres = tuple(PolishedSphere(middle * [side, side, 1.0], sphere_mm) for side in (-1.0, 1.0))
    return PlacedSurface(plate), (*spheres, Wall(-_BEHIND_MM, albedo=_WHITE))


def white_reflectance() -> float:
    """What the plate reflects towards its normal of light along it, 1 for a perfect white."""
    finish = np.array([_WHITE, _WHITE, _WHITE, 1.0, 0.0, 0.0], np.float32)
    return float(reflected(finish, np.array([0.0, 1.0, 0.0]), 1.0, 1.0, 1.0, 1.0))
