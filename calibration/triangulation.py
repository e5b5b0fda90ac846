"""Points on a camera's rays from projector coordinates: the depth that explains both coordinates.

The camera's pixel is exact and the projector's coordinates carry the noise, so a point has one
unknown, its depth z along the ray, found by Gauss-Newton.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from acquisition.patterns import Axis
from calibration.errors import CalibrationError
from calibration.lens import invert, rotation, transform
from calibration.rig_geometry import RigGeometry

_ROUNDS = 8
_CONVERGED = 1e-10


def depth_along_rays(
    rig: RigGeometry,
    slopes: NDArray[np.float64],
    coordinates: NDArray[np.float64],
    variance: NDArray[np.float64],
    *,
    start_mm: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depths at which rays of the camera meet projector coordinates.

    Parameters
    ----------
    rig : RigGeometry
    slopes : (n, 2) array
        x/z and y/z of the rays.
    coordinates, variance : (n, 2) arrays
        Projector column and row with their variances; infinite where one is not known.
    start_mm : float
        First guess of the depth.

    Returns
    -------
    depth, depth_variance : (n,) float64 arrays
        mm and mm²; NaN where the ray meets nothing.
    """
    rays = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
    turned = rays @ rotation(rig.rt_proj_cam).T
    weight = 1 / np.asarray(variance, np.float64)
    seen = np.where(weight > 0, coordinates, 0.0)
    depth = np.full(len(slopes), float(start_mm))
    information = np.full(len(slopes), np.nan)
    for _ in range(_ROUNDS):
        points = depth[:, np.newaxis] * turned + rig.rt_proj_cam[3:]
        points[~(points[:, 2] > 0)] = np.nan
        pixels, gradient = rig.projector.project_with_gradient(points)
        slope = np.einsum("nij,nj->ni", gradient, turned)
        information = np.sum(weight * slope**2, axis=1)
        step = np.sum(weight * slope * (seen - pixels), axis=1) / information
        depth = depth + step
        if not (np.abs(step) > _CONVERGED * np.abs(depth)).any():
            break
    depth = np.where(depth > 0, depth, np.nan)
    return depth, np.where(np.isfinite(depth), 1 / information, np.nan)


def usual_depth(
    rig: RigGeometry, pixels: NDArray[np.float64], coordinates: NDArray[np.float64]
) -> float:
    """Median depth at which the rays of camera and projector pass one another, mm.

    Parameters
    ----------
    rig : RigGeometry
    pixels, coordinates : (n, 2) arrays
        Of the camera, and what it sees of the projector there.

    Raises
    ------
    CalibrationError
        The rays meet behind camera and projector, or nowhere.
    """
    seen = rig.camera.unproject(pixels)
    lit = rig.projector.unproject(coordinates) @ rotation(rig.rt_proj_cam)
    baseline = transform(invert(rig.rt_proj_cam), np.zeros(3))
    # The common perpendicular of both rays.
    across = np.cross(seen, lit)
    depth = np.sum(np.cross(baseline, lit) * across, axis=1) / np.sum(across**2, axis=1)
    depth = depth[np.isfinite(depth)]
    if not len(depth) or not np.median(depth) > 0:
        raise CalibrationError(
            "rays of the scan's camera and projector do not meet before them: the rig's "
            "calibration does not belong to this scan"
        )
    return float(np.median(depth))


def reconstruct_points(
    correspondence: CorrespondenceMap, rig: RigGeometry, *, start_mm: float | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Every decoded pixel as a point in the camera frame.

    Parameters
    ----------
    correspondence : CorrespondenceMap
    rig : RigGeometry
    start_mm : float, optional
        First guess of the depth; by default it is found, for which both axes are needed.

    Returns
    -------
    points : (rows, cols, 3) float64 array
        mm; NaN where nothing was decoded.
    depth_variance : (rows, cols) float64 array
        mm² along z, by the coordinates' noise alone.
    """
    shape = correspondence.shape
    slopes = rig.camera.pixel_slopes(origin=correspondence.origin, shape=shape)
    valid = correspondence.valid
    axes = [correspondence.axes.get(axis) for axis in (Axis.COLUMN, Axis.ROW)]
    count = int(valid.sum())
    coordinates = np.stack([np.zeros(count) if a is None else a.coordinate[valid] for a in axes], 1)
    variance = np.stack(
        [np.full(count, np.inf) if a is None else a.variance[valid] for a in axes], axis=1
    )
    if start_mm is None:
        if any(axis is None for axis in axes):
            raise CalibrationError("a usual depth is told by a code of both axes")
        rows, cols = np.nonzero(valid)
        pixels = np.stack([cols, rows], axis=1).astype(np.float64) + correspondence.origin
        start_mm = usual_depth(rig, pixels, coordinates)
    depth, spread = depth_along_rays(rig, slopes[valid], coordinates, variance, start_mm=start_mm)
    points = np.full((*shape, 3), np.nan)
    points[valid, :2] = slopes[valid] * depth[:, np.newaxis]
    points[valid, 2] = depth
    depth_variance = np.full(shape, np.nan)
    depth_variance[valid] = spread
    return points, depth_variance
