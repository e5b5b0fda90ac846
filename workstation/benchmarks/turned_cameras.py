"""A rig whose camera is turned by quarters about its axis, and what it then sees of the same scene.

The rig's frame is its camera's: all of the rig's geometry is stated in turned axes then, every
picture has its rows and columns exchanged or reversed, and the scene is the same.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from calibration.lens import OPENCV_MODELS, Lens, compose, invert
from calibration.rig_geometry import RigGeometry

_Picture = TypeVar("_Picture", bound=NDArray[Any])


def camera_turn(quarters: int) -> NDArray[np.float64]:
    """Pose (6,) that takes points of the camera's frame to that of the turned camera."""
    return np.array([0.0, 0.0, -0.5 * np.pi * quarters, 0.0, 0.0, 0.0])


def turned_lens(lens: Lens, quarters: int) -> Lens:
    """The lens of a camera turned by quarters about its axis.

    Raises
    ------
    ValueError
        A model whose distortion is not that of OpenCV's first five coefficients.
    """
    if lens.model not in OPENCV_MODELS.values() or len(lens.intrinsics) > 9:
        raise ValueError(f"it is not known how {lens.model} looks when it is turned")
    for _ in range(quarters % 4):
        fx, fy, cx, cy, *distortion = lens.intrinsics
        if distortion:
            # Tangential distortion is a vector, p2 along columns and p1 along rows.
            p1, p2 = distortion[2:4]
            distortion[2:4] = [-p2, p1]
        turned = np.array([fy, fx, cy, lens.width - 1 - cx, *distortion])
        lens = Lens(lens.model, turned, width=lens.height, height=lens.width)
    return lens


def turned_rig(rig: RigGeometry, quarters: int) -> RigGeometry:
    """The rig with its camera turned; its covariance is left out."""
    pose = compose(rig.rt_proj_cam, invert(camera_turn(quarters)))
    camera = turned_lens(rig.camera, quarters)
    return replace(rig, camera=camera, rt_proj_cam=pose, covariance=None)


def turned_picture(picture: _Picture, quarters: int) -> _Picture:
    """A picture (rows, cols, ...) as the turned camera takes it."""
    return cast(_Picture, np.ascontiguousarray(np.rot90(picture, quarters)))


def turned_pixels(pixels: NDArray[np.float64], lens: Lens, quarters: int) -> NDArray[np.float64]:
    """Where pixels (..., 2) of a lens's picture are in that of the turned camera."""
    width, height = lens.width, lens.height
    for _ in range(quarters % 4):
        pixels = np.stack([pixels[..., 1], width - 1 - pixels[..., 0]], axis=-1)
        width, height = height, width
    return pixels


def turned_map(correspondence: CorrespondenceMap, quarters: int) -> CorrespondenceMap:
    """What the turned camera decodes; of whole pictures."""
    axes = {
        axis: replace(
            decoded,
            coordinate=turned_picture(decoded.coordinate, quarters),
            variance=turned_picture(decoded.variance, quarters),
            modulation=turned_picture(decoded.modulation, quarters),
        )
        for axis, decoded in correspondence.axes.items()
    }
    return replace(
        correspondence,
        axes=axes,
        ambient=turned_picture(correspondence.ambient, quarters),
        rejection=turned_picture(correspondence.rejection, quarters),
    )
