"""What the rig's own uncertainty does to heights.

Errors of the calibration are the same in every pixel's model, so they make no noise but a smooth
error of the whole surface. Each parameter of the rig is moved by its standard error, the scan is
triangulated again at pixels all over the canvas, and the plane is taken out of the change as it is
out of the heights; with the covariance of the parameters that gives the covariance of the heights
to first order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from calibration.lens import invert, transform
from calibration.rig_geometry import RigGeometry
from fitting.canvas import Canvas
from fitting.canvas_shape import quadric_terms, shape_of
from fitting.depth_solver import PanelCorrection, PanelSightings, solve
from fitting.epipolar import align_axes
from fitting.spread_pixels import spread_pixels

_PIXELS = 2000


@dataclass(frozen=True)
class CalibrationUncertainty:
    """Standard errors that the rig's calibration gives the surface.

    Attributes
    ----------
    height_mm : float
        RMS over the canvas of the standard error of height above the canvas plane.
    shape_mm : (float, float, float)
        Standard errors of the bows along X and Y and of the twist; see
        :class:`~fitting.canvas_shape.CanvasShape`.
    """

    height_mm: float
    shape_mm: tuple[float, float, float]


def propagate_calibration(
    correspondence: CorrespondenceMap, rig: RigGeometry, canvas: Canvas
) -> CalibrationUncertainty | None:
    """Carry the covariance of the rig's parameters through to the heights.

    Returns
    -------
    CalibrationUncertainty or None
        None where the rig says nothing of its uncertainty: it is unknown then, not zero.
    """
    if rig.covariance is None:
        return None
    index = spread_pixels(canvas.mask & correspondence.valid, _PIXELS)
    rt_canvas_cam = invert(canvas.rt_cam_canvas)

    def heights(moved: RigGeometry) -> NDArray[np.float64]:
        points = _points(correspondence, index, moved)
        return transform(rt_canvas_cam, points)

    here = heights(rig)
    x, y = _half_sizes(here[:, 0]), _half_sizes(here[:, 1])
    plane = np.stack([np.ones(len(x)), x, y], axis=1)
    sigma = np.sqrt(np.diagonal(rig.covariance))
    jacobian = np.zeros((len(index), len(sigma)))
    for n in np.flatnonzero(sigma):
        step = np.zeros(len(sigma))
        step[n] = sigma[n]
        change = (heights(rig.moved(step)) - heights(rig.moved(-step)))[:, 2] / (2 * sigma[n])
        jacobian[:, n] = change
    there = np.isfinite(jacobian).all(axis=1)
    jacobian, plane = jacobian[there], plane[there]
    jacobian -= plane @ np.linalg.lstsq(plane, jacobian, rcond=None)[0]
    values, vectors = np.linalg.eigh(rig.covariance)
    errors = jacobian @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    quadric = np.linalg.lstsq(quadric_terms(x[there], y[there]), errors, rcond=None)[0]
    shape = np.sqrt((shape_of(quadric.T) ** 2).sum(axis=0))
    return CalibrationUncertainty(
        float(np.sqrt(np.mean((errors**2).sum(axis=1)))),
        (float(shape[0]), float(shape[1]), float(shape[2])),
    )


def _half_sizes(place: NDArray[np.float64]) -> NDArray[np.float64]:
    low, high = float(np.nanmin(place)), float(np.nanmax(place))
    return (place - 0.5 * (low + high)) / max(0.5 * (high - low), 1e-12)


def _points(
    correspondence: CorrespondenceMap, index: NDArray[np.intp], rig: RigGeometry
) -> NDArray[np.float64]:
    """Points of some pixels by a rig, as :func:`~fitting.range_image.triangulate` finds them."""
    row, col = np.unravel_index(index, correspondence.shape)
    pixels = np.stack([col, row], axis=1).astype(np.float64) + correspondence.origin
    rays = rig.camera.unproject(pixels)
    sightings = PanelSightings.of_rays(rays[:, :2], correspondence, index)
    correction = PanelCorrection.none()
    if len(correspondence.axes) == 2:
        correction = align_axes(sightings, rig).correction
    return solve(sightings, rig, correction).depth[:, np.newaxis] * rays
