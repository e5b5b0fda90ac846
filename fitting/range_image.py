r"""The range image: a point in space for every decoded camera pixel (paper section 4.1).

Each pixel's viewing ray is intersected with the light that its projector coordinate names. The
unknown is the depth z along the ray; the decoded column and row (one of them is enough) are
observations of where the point lies on the projector's panel. Gauss-Newton through both lens
models gives z, and the decoding variances give
:math:`\sigma_z^{-2} = \sum_i (\partial u_i/\partial z)^2 / \sigma_i^2`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap, Rejection
from calibration.rig_geometry import RigGeometry
from fitting.depth_solver import AXES, Depths, PanelCorrection, PanelSightings, solve
from fitting.epipolar import align_axes, repair_orders
from fitting.errors import FittingError
from fitting.option_limits import check_limits
from fitting.spread_pixels import spread_pixels
from fitting.triangulation_kernels import find_supported, place_points

# Pixels by which the axes are aligned.
_SAMPLES = 100_000


@dataclass(frozen=True)
class RangeImage:
    """Points seen by the camera's pixels, in the camera frame.

    Attributes
    ----------
    points : (rows, cols, 3) float64 array
        Positions in mm; NaN where rejected.
    depth_variance : (rows, cols) float32 array
        Variance of the depth z in mm²; infinite where rejected. The point moves along its viewing
        ray ``points / z`` when z does.
    rejection : (rows, cols) uint16 array
        :class:`~acquisition.correspondence.Rejection` bits.
    focal_px : float
        Focal length of the camera, which turns depth into the spacing of the points.
    misalignment_px : float
        RMS of the smooth disagreement between decoded columns and rows that was taken out: an
        error of the calibration across the baseline. 0 where only one axis was decoded.
    """

    points: NDArray[np.float64]
    depth_variance: NDArray[np.float32]
    rejection: NDArray[np.uint16]
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

    Raises
    ------
    FittingError
        A value out of bounds.
    """

    epipolar_tolerance_px: float = 2.0
    repair_orders: bool = True
    sigmas: float = 6.0
    maximum_slope: float = 5.0
    agreeing_share: float = 0.3

    def __post_init__(self) -> None:
        check_limits(
            self,
            epipolar_tolerance_px=(0, math.inf),
            sigmas=(0, math.inf),
            maximum_slope=(0, math.inf),
            agreeing_share=(0, 1),
        )


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
    sightings = PanelSightings.of(correspondence, rig.camera)
    use = correspondence.valid.reshape(-1)
    correction, misalignment = PanelCorrection.none(), 0.0
    both = len(correspondence.axes) == 2
    if both:
        alignment = align_axes(sightings.take(spread_pixels(use, _SAMPLES)), rig)
        correction, misalignment = alignment.correction, alignment.rms_px
    solved = solve(sightings, rig, correction)
    reasons = np.where(np.isfinite(solved.depth), 0, Rejection.NO_INTERSECTION).astype(np.uint16)
    if both:
        off = _contradictory(sightings, solved.misfit, use, options)
        if options.repair_orders and len(off):
            solved = _resolve(sightings, solved, off, correspondence, rig, correction, options)
            reasons[off] = np.where(np.isfinite(solved.depth[off]), 0, Rejection.NO_INTERSECTION)
            off = off[_contradictory(sightings.take(off), solved.misfit[off], use[off], options)]
        reasons[off] |= np.uint16(Rejection.OFF_EPIPOLAR)

    shape = correspondence.shape
    rejection = correspondence.rejection | (use * reasons).reshape(shape)
    focal = float(np.mean(rig.camera.focal_px))
    depth, variance = solved.depth.reshape(shape), solved.variance.reshape(shape)
    valid = rejection == 0
    supported = find_supported(
        depth,
        variance,
        valid,
        options.maximum_slope / focal,
        options.sigmas,
        options.agreeing_share,
    )
    rejection[valid & ~supported] |= np.uint16(Rejection.OUTLIER)
    valid = rejection == 0
    if valid.sum() < 10:
        raise FittingError(
            f"only {int(valid.sum())} of {int(use.sum())} decoded pixels could be triangulated; "
            "check that the calibration belongs to this rig, and its units"
        )
    variance[~valid] = np.inf
    points = place_points(sightings.slopes.reshape(*shape, 2), depth, valid)
    return RangeImage(points, variance, rejection, focal, misalignment)


def _tolerance(sightings: PanelSightings, options: RangeOptions) -> NDArray[np.float32]:
    """Disagreement of the axes that noise and calibration explain, pixels."""
    column, row = sightings.variances
    allowed = np.float32(options.epipolar_tolerance_px)
    return allowed + np.float32(options.sigmas) * np.sqrt(column + row)


def _contradictory(
    sightings: PanelSightings,
    misfit: NDArray[np.float32],
    use: NDArray[np.bool_],
    options: RangeOptions,
) -> NDArray[np.intp]:
    """Indices of usable pixels whose column and row contradict one another."""
    return np.flatnonzero(use & ~(misfit <= _tolerance(sightings, options)))


def _resolve(
    sightings: PanelSightings,
    solved: Depths,
    off: NDArray[np.intp],
    correspondence: CorrespondenceMap,
    rig: RigGeometry,
    correction: PanelCorrection,
    options: RangeOptions,
) -> Depths:
    """The depths with those of contradictory pixels solved again after a repair."""
    column, row = (correspondence.axes[axis].period_px for axis in AXES)
    wrong = sightings.take(off)
    repaired = repair_orders(wrong, _tolerance(wrong, options), (column, row), rig, correction)
    again = solve(repaired, rig, correction)
    depth, variance, misfit = solved.depth.copy(), solved.variance.copy(), solved.misfit.copy()
    depth[off], variance[off], misfit[off] = again.depth, again.variance, again.misfit
    return Depths(depth, variance, misfit)


def neighbour_steps(
    points: NDArray[np.float64], mask: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Steps from points to their neighbours, on a regular choice of some fifty thousand.

    Parameters
    ----------
    points : (rows, cols, 3) array
    mask : (rows, cols) bool array
        Points to regard.

    Returns
    -------
    down, right : (n, 3) arrays
        To the next row and to the next column.
    """
    rows = np.flatnonzero(mask[:-1].any(axis=1))
    rows = rows[:: max(1, int(mask.sum()) // 50_000)]
    found = []
    for down, right in ((1, 0), (0, 1)):
        cols = mask.shape[1] - right
        row, col = np.nonzero(mask[rows, :cols] & mask[rows + down, right:])
        row = rows[row]
        found.append(points[row + down, col + right] - points[row, col])
    return found[0], found[1]
