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
    misalignment_px : float
        RMS of the smooth disagreement between decoded columns and rows that was taken out: an
        error of the calibration across the baseline. 0 where only one axis was decoded.
    """

    points: NDArray[np.float64]
    depth_variance: NDArray[np.float64]
    rejection: NDArray[np.uint8]
    focal_px: float
    misalignment_px: float

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
    repair_orders : bool
        Whether a wrong fringe order, in either coordinate, is put right where exactly one
        correction satisfies the rig's geometry.
    sigmas : float
        Standard deviations of noise that are no outlier.
    maximum_slope : float
        Steepest surface, as a tangent against the image plane, that neighbouring pixels may
        belong to.
    agreeing_share : float
        Share of a pixel's 5 × 5 neighbourhood that must lie on its surface.
    """

    epipolar_tolerance_px: float = 2.0
    repair_orders: bool = True
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

    both = len(correspondence.axes) == 2
    tolerance = np.full(len(rays), np.inf)
    misalignment = 0.0
    if both:
        sigma = np.sqrt((1 / np.maximum(weight, 1e-30)).sum(axis=1))
        tolerance = options.epipolar_tolerance_px + options.sigmas * sigma
        observed, misalignment = _align_epipolar(rays, observed, weight, rig)
    depth, variance, misfit = _solve_depth(rays, observed, weight, rig)
    off = np.flatnonzero(~(misfit <= tolerance))
    if both and options.repair_orders and len(off):
        periods = np.array([correspondence.axes[a].period_px for a in (Axis.COLUMN, Axis.ROW)])
        observed[off] = _repair_orders(rays[off], observed[off], tolerance[off], periods, rig)
        depth[off], variance[off], misfit[off] = _solve_depth(
            rays[off], observed[off], weight[off], rig
        )
    rejection = correspondence.rejection.copy()
    reasons = np.zeros(len(rays), np.uint8)
    reasons[~(np.isfinite(depth) & (depth > 0))] |= np.uint8(Rejection.NO_INTERSECTION)
    if both:
        reasons[~(misfit <= tolerance)] |= np.uint8(Rejection.OFF_EPIPOLAR)
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
    points = depth_image[..., np.newaxis] * ray_image
    return RangeImage(points, variance_image, rejection, focal, misalignment)


def _align_epipolar(
    rays: NDArray[np.float64],
    observed: NDArray[np.float64],
    weight: NDArray[np.float64],
    rig: RigGeometry,
) -> tuple[NDArray[np.float64], float]:
    """Coordinates with the smooth disagreement between the axes removed, and its RMS in pixels.

    The axis across the baseline says next to nothing of the depth, but an error of the calibration
    along it would bend the surface. What that axis is off by, a cubic over the picture, is
    subtracted; wrong periods and noise stay, to be judged after.
    """
    if not len(rays):
        return observed.copy(), 0.0
    _, gradient = rig.projector.project_with_gradient(
        np.linalg.norm(rig.rt_proj_cam[3:]) * np.array([[0.0, 0.0, 5.0]])
    )
    along = int(np.argmax(np.abs(gradient[0] @ rig.rt_proj_cam[3:])))
    across = 1 - along
    only = np.zeros(2)
    only[along] = 1.0
    depth, _, _ = _solve_depth(rays, observed, np.broadcast_to(only, observed.shape), rig)
    points = depth[:, np.newaxis] * (rays @ rotation(rig.rt_proj_cam).T) + rig.rt_proj_cam[3:]
    seen = rig.projector.project(np.where(np.isfinite(points), points, 1.0))[:, across]
    off = np.where(depth > 0, seen - observed[:, across], np.nan)

    x, y = rays[:, 0], rays[:, 1]
    if not (depth > 0).any():
        return observed.copy(), 0.0
    # No term in the depth: where the period is wrong the depth is too, and would spoil the row.
    terms = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    used = np.flatnonzero(np.isfinite(off))
    used = used[:: max(1, len(used) // 20_000)]
    limit = np.inf
    model = np.zeros(terms.shape[1])
    for _ in range(8):
        left = off[used] - terms[used] @ model
        left -= np.median(left) if not model.any() else 0.0
        limit = min(limit, max(4 * 1.4826 * float(np.median(np.abs(left))), 0.1))
        inside = used[np.abs(left) <= limit]
        if len(inside) < 10 * len(model):
            return observed.copy(), 0.0
        model = np.linalg.lstsq(terms[inside], off[inside], rcond=1e-8)[0]
    aligned = observed.copy()
    aligned[:, across] += np.where(np.isfinite(depth), terms @ model, 0.0)
    return aligned, float(np.sqrt(np.mean((terms[inside] @ model) ** 2)))


def _repair_orders(
    rays: NDArray[np.float64],
    observed: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    periods: NDArray[np.float64],
    rig: RigGeometry,
) -> NDArray[np.float64]:
    """Coordinates moved by the one combination of whole periods that the rig's geometry allows.

    The order may be wrong by one, or by the whole panel where a coarse fringe of one period
    wrapped at the panel's edge. A column fixes the depth and with it the row; a wrong order of
    either breaks that. A pixel keeps its coordinates, and is rejected for them later, where no
    combination or more than one fits.
    """
    repaired = observed.copy()
    panel = np.array([rig.projector.width, rig.projector.height])
    matches = np.zeros(len(rays), np.int32)
    only_column = np.broadcast_to(np.array([1.0, 0.0]), observed.shape)
    across, down = (
        [-1, 0, 1] + [sign * (n - less) for sign in (-1, 1) for less in (0, 1) if n > 2]
        for n in np.round(panel / periods).astype(int)
    )
    for column_order in across:
        shifted = observed + np.array([column_order, 0.0]) * periods
        depth, _, _ = _solve_depth(rays, shifted, only_column, rig)
        points = depth[:, np.newaxis] * rays @ rotation(rig.rt_proj_cam).T + rig.rt_proj_cam[3:]
        row = rig.projector.project(np.nan_to_num(points, nan=1.0))[:, 1]
        for row_order in down:
            candidate = shifted + np.array([0.0, row_order]) * periods
            on_panel = ((candidate >= -0.5) & (candidate <= panel - 0.5)).all(axis=1)
            fits = on_panel & (depth > 0) & (np.abs(candidate[:, 1] - row) <= tolerance)
            repaired[fits] = candidate[fits]
            matches += fits
    return np.where((matches == 1)[:, np.newaxis], repaired, observed)


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
