"""The canvas among the range points: its plane, its mask, its frame (paper section 4.2).

PCA of the range points gives a first plane; the slope against it, by Sobel's operator, is large
where the painting ends; a seed fill from the centre of the picture stops there; the mask is
eroded; a second PCA of what is left gives the canvas frame.

Where the paper leaves a trap open: the centre may be a hole or a brush stroke, steep impasto cuts
islands off, and there may be two paintings, all of which :mod:`fitting.canvas_region` sees to;
points far from the painting tilt a plain PCA, so the first one is trimmed; and the in-plane axes of
a square painting are undetermined by PCA, so X and Y follow the edges of the mask where it is a
rectangle, else the picture's axes. A warped canvas is no plane: what it deviates stays in the
heights, and :mod:`fitting.canvas_shape` reports it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import MEDIAN_TO_SIGMA, robust_sigma
from calibration.lens import rt_from_matrix
from fitting.canvas_kernels import find_smooth, heights_above_plane
from fitting.canvas_region import disc, erode_outline, find_region, outline_pixels
from fitting.errors import FittingError
from fitting.option_limits import check_limits
from fitting.range_image import RangeImage, neighbour_steps
from fitting.spread_pixels import spread_pixels

# Points from which planes and medians are taken, at most; more do not sharpen them.
_POINTS = 200_000
_PLANE_POINTS = 50_000
# Half the width of gaps over which the seed fill goes on, in pixels.
_GAP_PX = 3
_FEWEST = 10
_MOST_PX = 100


class InPlaneAxes(StrEnum):
    """Where the canvas frame's X and Y come from."""

    MASK_EDGES = "edges of the canvas"
    PICTURE = "axes of the picture"


@dataclass(frozen=True, kw_only=True)
class CanvasOptions:
    """Thresholds of the canvas extraction.

    Attributes
    ----------
    maximum_slope : float
        Slope (tangent) at which the seed fill stops.
    sigmas : float
        Standard deviations of the slope's noise added to that.
    spike_sigmas : float
        Standard deviations, beyond what the neighbourhood's own roughness explains, at which a
        single pixel is a spike and left out of the mask.
    sigma_ratio : float
        A pixel whose height is this many times less certain than the median pixel's, as at the
        edge of a shadow, is left out.
    erosion_px : int
        Pixels taken off the mask's outline.
    seed : (int, int) or None
        Row and column, in the range image, of a pixel on the canvas; None takes what lies at the
        picture's centre.
    seed_window : float
        Side of the window around the picture's centre, as a share of the picture, in which the
        seed region is sought.
    bridge_px : int
        The seed fill does not pass where it is narrower than about twice this.
    rectangle_fill : float
        Share of its smallest enclosing rectangle that a mask must fill for its edges to set X
        and Y.

    Raises
    ------
    FittingError
        A value out of bounds.
    """

    maximum_slope: float = 2.0
    sigmas: float = 2.0
    spike_sigmas: float = 5.0
    sigma_ratio: float = 8.0
    erosion_px: int = 3
    seed: tuple[int, int] | None = None
    seed_window: float = 0.2
    bridge_px: int = 2
    rectangle_fill: float = 0.85

    def __post_init__(self) -> None:
        check_limits(
            self,
            maximum_slope=(0.01, 100),
            sigmas=(0, math.inf),
            spike_sigmas=(0, math.inf),
            sigma_ratio=(1, math.inf),
            erosion_px=(0, _MOST_PX),
            seed_window=(0.001, 1),
            bridge_px=(0, _MOST_PX),
            rectangle_fill=(0, 1),
        )


@dataclass(frozen=True)
class Canvas:
    """Where the canvas is.

    Attributes
    ----------
    mask : (rows, cols) bool array
        Pixels of the range image on the canvas.
    rt_cam_canvas : (6,) float64 array
        Pose of the canvas frame; its origin is the centre of the mask's points on the plane.
    axes : InPlaneAxes
        What X and Y were taken from.
    outline : (rows, cols) bool array
        The mask with its gaps filled.
    warnings : tuple of str
        What was ambiguous.
    """

    mask: NDArray[np.bool_]
    rt_cam_canvas: NDArray[np.float64]
    axes: InPlaneAxes
    outline: NDArray[np.bool_]
    warnings: tuple[str, ...] = ()


def extract_canvas(range_image: RangeImage, options: CanvasOptions | None = None) -> Canvas:
    """Find the canvas in a range image.

    Parameters
    ----------
    range_image : RangeImage
        Points in the camera frame.
    options : CanvasOptions, optional
        Thresholds.

    Returns
    -------
    Canvas

    Raises
    ------
    FittingError
        Nothing smooth near the centre of the picture, or nothing left after the erosion.
    """
    options = options or CanvasOptions()
    points = np.ascontiguousarray(range_image.points, dtype=np.float64)
    variance = np.ascontiguousarray(range_image.depth_variance, dtype=np.float32)
    valid = range_image.valid & np.isfinite(points[..., 0] + points[..., 1] + points[..., 2])
    valid &= np.isfinite(variance)
    if valid.sum() < _FEWEST:
        raise FittingError(f"a canvas takes {_FEWEST} points, there are {int(valid.sum())}")
    centre, normal = _trimmed_plane(_thinned(points, valid))
    height = heights_above_plane(points, valid, centre, normal)
    spacing = _point_spacing(points, valid, normal)
    smooth = find_smooth(
        points, variance, valid, normal, spacing, options.maximum_slope, options.sigmas
    )
    smooth |= _level_gaps(height, smooth, valid, options.maximum_slope * spacing)
    region = find_region(
        smooth, seed=options.seed, window=options.seed_window, bridge_px=options.bridge_px
    )
    outline = erode_outline(region.outline, options.erosion_px)
    mask = outline & valid
    if mask.sum() < _FEWEST:
        raise FittingError(
            f"the canvas is empty: {int(region.outline.sum())} pixels are smooth around the centre "
            f"of the picture and {int(mask.sum())} are left after an erosion of "
            f"{options.erosion_px} px; centre the painting in the picture, name a seed pixel, or "
            "raise the slope limit"
        )
    mask &= variance <= options.sigma_ratio**2 * np.median(_thinned(variance, mask))
    mask &= ~_spikes(height, variance, mask, options.spike_sigmas)
    centre, normal = _plane(_thinned(points, mask))
    corners = points[tuple(outline_pixels(mask).T)]
    x_axis, kind = _in_plane_axis(corners, centre, normal, options.rectangle_fill)
    rotation = np.stack([x_axis, np.cross(normal, x_axis), normal], axis=1)
    local = (corners - centre) @ rotation
    middle = 0.5 * (local[:, :2].min(axis=0) + local[:, :2].max(axis=0))
    origin = centre + rotation[:, :2] @ middle
    return Canvas(mask, rt_from_matrix(rotation, origin), kind, outline, region.warnings)


def _thinned(values: NDArray[np.floating], mask: NDArray[np.bool_]) -> NDArray[np.floating]:
    """Values at pixels spread over the mask."""
    return values.reshape(mask.size, *values.shape[2:])[spread_pixels(mask, _POINTS)]


def _point_spacing(
    points: NDArray[np.float64], valid: NDArray[np.bool_], normal: NDArray[np.float64]
) -> float:
    """Median distance on the plane of neighbours, along rows or columns, whichever is less."""
    found = []
    for step in neighbour_steps(points, valid):
        flat = step - (step @ normal)[:, np.newaxis] * normal
        found.append(np.median(np.linalg.norm(flat, axis=1)) if len(step) else np.nan)
    if np.isnan(found).all() or not np.nanmin(found) > 0:
        raise FittingError("no two neighbouring pixels were measured: there is no surface to find")
    return float(np.nanmin(found))


def _plane(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centre and unit normal (towards the camera) of the plane through points, by PCA."""
    centre = points.mean(axis=0)
    offset = points - centre
    _, vectors = np.linalg.eigh(offset.T @ offset)
    normal = vectors[:, 0]
    return centre, -normal if normal @ centre > 0 else normal


def _trimmed_plane(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """PCA plane of the bulk: points far off it, by the robust spread, are left out in turn."""
    thin = points[:: max(1, len(points) // _PLANE_POINTS)]
    near = np.median(thin, axis=0)
    distance = np.linalg.norm(thin - near, axis=1)
    thin = thin[distance <= 4 * np.median(distance) + 1e-12]
    kept = thin
    for _ in range(8):
        centre, normal = _plane(kept)
        off = (thin - centre) @ normal
        middle = np.median(off)
        spread = robust_sigma(off - middle)
        inside = np.abs(off - middle) <= 4 * spread + 1e-12
        if inside.sum() == len(kept) or inside.sum() < 10:
            break
        kept = thin[inside]
    return centre, normal


def _level_gaps(
    height: NDArray[np.float32], smooth: NDArray[np.bool_], valid: NDArray[np.bool_], rise: float
) -> NDArray[np.bool_]:
    """Pixels without a point in narrow gaps between smooth ones of about one height.

    A dead row of the sensor does not part a canvas; the shadow of a frame, which stands higher,
    does. ``rise`` is the steepest slope per pixel.
    """
    there = smooth.astype(np.uint8)
    closed = cv2.morphologyEx(there, cv2.MORPH_CLOSE, disc(_GAP_PX)).astype(bool) & ~valid
    if closed.any():
        far = np.float32(np.inf)
        # From one edge of the widest gap to the other.
        around = disc(2 * _GAP_PX)
        highest = cv2.dilate(np.where(smooth, height, -far), around)[closed]
        lowest = cv2.erode(np.where(smooth, height, far), around)[closed]
        closed[closed] = highest - lowest <= rise * _GAP_PX
    return closed


def _spikes(
    height: NDArray[np.float32],
    variance: NDArray[np.float32],
    mask: NDArray[np.bool_],
    sigmas: float,
) -> NDArray[np.bool_]:
    """Pixels that stand off the median of their 5 × 5 neighbourhood by more than it explains."""
    weight = mask.astype(np.float32)
    around = cv2.boxFilter(weight, -1, (5, 5), normalize=False)
    mean = cv2.boxFilter(height * weight, -1, (5, 5), normalize=False)
    filled = np.where(mask, height, mean / np.maximum(around, 1))
    off = np.abs(filled - cv2.medianBlur(filled, 5))
    roughness = np.float32(MEDIAN_TO_SIGMA) * cv2.medianBlur(off, 5)
    noise = np.where(mask, variance, np.float32(0)) + roughness * roughness
    return np.asarray(mask & (off * off > np.float32(sigmas**2) * noise))


def _in_plane_axis(
    points: NDArray[np.float64],
    centre: NDArray[np.float64],
    normal: NDArray[np.float64],
    rectangle_fill: float,
) -> tuple[NDArray[np.float64], InPlaneAxes]:
    """Canvas X: the mask's edge nearest to the picture's horizontal, or that horizontal."""
    x_axis = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    x_axis /= np.linalg.norm(x_axis)
    y_axis = np.cross(normal, x_axis)
    flat = np.stack([(points - centre) @ x_axis, (points - centre) @ y_axis], axis=1)
    hull = cv2.convexHull(flat.astype(np.float32))
    _, (width, height), angle = cv2.minAreaRect(hull)
    if width * height <= 0 or cv2.contourArea(hull) < rectangle_fill * width * height:
        return x_axis, InPlaneAxes.PICTURE
    turn = np.deg2rad((angle + 45) % 90 - 45)
    return np.cos(turn) * x_axis + np.sin(turn) * y_axis, InPlaneAxes.MASK_EDGES
