r"""The range image: a point in space for every decoded camera pixel (paper section 4.1).

Each pixel's viewing ray is intersected with the light that its projector coordinate names. The
unknown is the depth z along the ray; the decoded column and row (one of them is enough) are
observations of where the point lies on the projector's panel. Gauss-Newton through both lens
models gives z, and the decoding variances give
:math:`\sigma_z^{-2} = \sum_i (\partial u_i/\partial z)^2 / \sigma_i^2`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap, Rejection
from acquisition.patterns import Axis
from calibration.lens import rotation
from calibration.rig_geometry import RigGeometry
from fitting.errors import FittingError
from fitting.neighbour_kernels import count_agreeing_neighbours

_ITERATIONS = 5
_AXIS_INDEX = {Axis.COLUMN: 0, Axis.ROW: 1}


@dataclass(frozen=True)
class RangeImage:
    """Points seen by the camera's pixels, in the camera frame.

    Attributes
    ----------
    points : (rows, cols, 3) float64 array
        Positions in mm; NaN where rejected.
    depth_variance : (rows, cols) float64 array
        Variance of the depth z in mm²; infinite where rejected. The point moves along its viewing
        ray ``points / z`` when z does.
    rejection : (rows, cols) uint8 array
        :class:`~acquisition.correspondence.Rejection` bits.
    focal_px : float
        Focal length of the camera, which turns depth into the spacing of the points.
    """

    points: NDArray[np.float64]
    depth_variance: NDArray[np.float64]
    rejection: NDArray[np.uint8]
    focal_px: float

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(rows, cols) bool array: pixels with a point."""
        return self.rejection == 0


@dataclass(frozen=True, kw_only=True)
class RangeOptions:
    """What triangulation accepts.

    Attributes
    ----------
    epipolar_tolerance_px : float
        Disagreement between column and row, beyond ``sigmas`` standard deviations, that a
        calibration is allowed.
    sigmas : float
        Standard deviations of noise that are no outlier.
    maximum_slope : float
        Steepest surface, as a tangent against the image plane, that neighbouring pixels may
        belong to.
    agreeing_share : float
        Share of a pixel's 5 × 5 neighbourhood that must lie on its surface.
    """

    epipolar_tolerance_px: float = 2.0
    sigmas: float = 6.0
    maximum_slope: float = 5.0
    agreeing_share: float = 0.3


def triangulate(
    correspondence: CorrespondenceMap, rig: RigGeometry, options: RangeOptions | None = None
) -> RangeImage:
    """Turn a correspondence map into a range image.

    Parameters
    ----------
    correspondence : CorrespondenceMap
        Decoded projector coordinates.
    rig : RigGeometry
        Camera, projector, and the pose between them.
    options : RangeOptions, optional
        Rejection thresholds.

    Returns
    -------
    RangeImage

    Raises
    ------
    FittingError
        Fewer than ten points are left.
    """
    options = options or RangeOptions()
    use = correspondence.valid
    rays = rig.camera.unproject(correspondence.pixels()[use])
    observed = np.zeros((len(rays), 2))
    weight = np.zeros((len(rays), 2))
    for axis, decoded in correspondence.axes.items():
        observed[:, _AXIS_INDEX[axis]] = decoded.coordinate[use]
        weight[:, _AXIS_INDEX[axis]] = 1.0 / decoded.variance[use]

    depth, variance, misfit = _solve_depth(rays, observed, weight, rig)
    rejection = correspondence.rejection.copy()
    reasons = np.zeros(len(rays), np.uint8)
    reasons[~(np.isfinite(depth) & (depth > 0))] |= np.uint8(Rejection.NO_INTERSECTION)
    if len(correspondence.axes) == 2:
        sigma = np.sqrt((1 / np.maximum(weight, 1e-30)).sum(axis=1))
        off = misfit > options.epipolar_tolerance_px + options.sigmas * sigma
        reasons[off] |= np.uint8(Rejection.OFF_EPIPOLAR)
    rejection[use] |= reasons

    depth_image = np.full(use.shape, np.nan)
    depth_image[use] = depth
    variance_image = np.full(use.shape, np.inf)
    variance_image[use] = variance
    ray_image = np.full((*use.shape, 3), np.nan)
    ray_image[use] = rays

    focal = float(np.mean(rig.camera.focal_px))
    valid = rejection == 0
    share = count_agreeing_neighbours(
        np.where(valid, depth_image, np.nan),
        np.where(valid, variance_image, 0.0),
        options.maximum_slope / focal,
        options.sigmas,
    )
    rejection[valid & (share < options.agreeing_share)] |= np.uint8(Rejection.OUTLIER)
    valid = rejection == 0
    if valid.sum() < 10:
        raise FittingError(
            f"only {int(valid.sum())} of {int(use.sum())} decoded pixels could be triangulated; "
            "check that the calibration belongs to this rig, and its units"
        )
    depth_image[~valid] = np.nan
    variance_image[~valid] = np.inf
    return RangeImage(depth_image[..., np.newaxis] * ray_image, variance_image, rejection, focal)


def _solve_depth(
    rays: NDArray[np.float64],
    observed: NDArray[np.float64],
    weight: NDArray[np.float64],
    rig: RigGeometry,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Depth along each ray, its variance, and the distance left on the panel in pixels."""
    turned = rays @ rotation(rig.rt_proj_cam).T
    shift = rig.rt_proj_cam[3:]
    depth = _pinhole_depth(turned, shift, observed, weight, rig)
    with np.errstate(invalid="ignore", divide="ignore"):
        for _ in range(_ITERATIONS):
            depth = np.where(depth > 0, depth, np.nan)
            pixels, gradient = rig.projector.project_with_gradient(
                depth[:, np.newaxis] * turned + shift
            )
            slope = np.einsum("nij,nj->ni", gradient, turned)
            information = (weight * slope**2).sum(axis=1)
            step = (weight * slope * (observed - pixels)).sum(axis=1) / information
            depth = depth + step
            if np.nanmax(np.abs(step / depth), initial=0.0) < 1e-10:
                break
        misfit = np.linalg.norm(np.where(weight > 0, observed - pixels, 0.0), axis=1)
        return depth, 1 / information, misfit


def _pinhole_depth(
    turned: NDArray[np.float64],
    shift: NDArray[np.float64],
    observed: NDArray[np.float64],
    weight: NDArray[np.float64],
    rig: RigGeometry,
) -> NDArray[np.float64]:
    """Starting depth: weighted intersection that ignores the projector's distortion."""
    focal, centre = rig.projector.intrinsics[:2], rig.projector.intrinsics[2:4]
    slope = (observed - centre) / focal
    # x_proj - slope * z_proj = 0 is linear in the depth.
    by_depth = turned[:, :2] - slope * turned[:, 2:]
    constant = shift[:2] - slope * shift[2]
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = -(weight * by_depth * constant).sum(axis=1) / (weight * by_depth**2).sum(axis=1)
    return np.asarray(depth)
