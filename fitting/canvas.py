"""The canvas among the range points: its plane, its mask, its frame (paper section 4.2).

PCA of the range points gives a first plane; the Sobel gradient of the heights above it is large
where the painting ends; a seed fill from the centre of the picture stops there; the mask is
eroded; a second PCA of what is left gives the canvas frame.

Where the paper leaves a trap open: the centre may be a hole or a brush stroke, so the seed is the
largest smooth region near the centre; steep impasto leaves islands in the fill, so enclosed gaps
are filled again; points far from the painting tilt a plain PCA, so the first one is trimmed; and
the in-plane axes of a square painting are undetermined by PCA, so X and Y follow the edges of the
mask where it is a rectangle, else the picture's axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from calibration.lens import rt_from_matrix
from fitting.errors import FittingError
from fitting.range_image import RangeImage


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
    seed_window : float
        Side of the window around the picture's centre, as a share of the picture, in which the
        seed region is sought.
    rectangle_fill : float
        Share of its smallest enclosing rectangle that a mask must fill for its edges to set X
        and Y.
    """

    maximum_slope: float = 2.0
    sigmas: float = 2.0
    spike_sigmas: float = 5.0
    sigma_ratio: float = 8.0
    erosion_px: int = 3
    seed_window: float = 0.2
    rectangle_fill: float = 0.85


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
    """

    mask: NDArray[np.bool_]
    rt_cam_canvas: NDArray[np.float64]
    axes: InPlaneAxes
    outline: NDArray[np.bool_]


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
    valid = range_image.valid
    centre, normal = _trimmed_plane(range_image.points[valid])
    slope, slope_sigma = _slope(range_image, normal, centre)
    noise = options.sigmas * slope_sigma
    # Where noise alone reaches the limit nothing is known of the slope, and the fill stops too.
    smooth = valid & (slope < options.maximum_slope + noise) & (noise < options.maximum_slope)
    region = _seed_region(smooth, options.seed_window)
    outline = _erode(ndimage.binary_fill_holes(region), options.erosion_px)
    mask = outline & valid
    if mask.sum() < 10:
        raise FittingError(
            f"the canvas is empty: {int(region.sum())} pixels are smooth around the centre of the "
            f"picture and {int(mask.sum())} are left after an erosion of {options.erosion_px} px; "
            "centre the painting in the picture, or raise the slope limit"
        )
    variance = np.where(mask, range_image.depth_variance, np.inf)
    mask &= variance <= options.sigma_ratio**2 * np.median(variance[mask])
    centre, normal = _plane(range_image.points[mask])
    mask &= ~_spikes(range_image, mask, centre, normal, options.spike_sigmas)
    points = range_image.points[mask]
    centre, normal = _plane(points)
    x_axis, kind = _in_plane_axis(points, centre, normal, options.rectangle_fill)
    rotation = np.stack([x_axis, np.cross(normal, x_axis), normal], axis=1)
    local = (points - centre) @ rotation
    middle = 0.5 * (local[:, :2].min(axis=0) + local[:, :2].max(axis=0))
    origin = centre + rotation[:, :2] @ middle
    return Canvas(mask, rt_from_matrix(rotation, origin), kind, outline)


def _plane(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centre and unit normal (towards the camera) of the plane through points, by PCA."""
    centre = points.mean(axis=0)
    offset = points - centre
    _, vectors = np.linalg.eigh(offset.T @ offset)
    normal = vectors[:, 0]
    return centre, -normal if normal @ centre > 0 else normal


def _trimmed_plane(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """PCA plane of the bulk: points far off it, by the robust spread, are left out in turn."""
    thin = points[:: max(1, len(points) // 200_000)]
    near = np.median(thin, axis=0)
    distance = np.linalg.norm(thin - near, axis=1)
    thin = thin[distance <= 4 * np.median(distance) + 1e-12]
    kept = thin
    for _ in range(8):
        centre, normal = _plane(kept)
        off = (thin - centre) @ normal
        middle = np.median(off)
        spread = 1.4826 * np.median(np.abs(off - middle))
        inside = np.abs(off - middle) <= 4 * spread + 1e-12
        if inside.sum() == len(kept) or inside.sum() < 10:
            break
        kept = thin[inside]
    return centre, normal


def _slope(
    range_image: RangeImage, normal: NDArray[np.float64], centre: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sobel slope of the heights above a plane (mm per mm), and its noise."""
    valid = range_image.valid
    height = np.where(valid, (range_image.points - centre) @ normal, 0.0)
    filled = _fill_from_nearest(height, valid)
    # Sobel's weights sum to 8 pixel spacings, and to a variance of 12.
    gradient = np.hypot(cv2.Sobel(filled, cv2.CV_64F, 1, 0), cv2.Sobel(filled, cv2.CV_64F, 0, 1))
    spacing = np.abs(np.median(range_image.points[valid][:, 2])) / range_image.focal_px
    ray_normal = np.abs((range_image.points[valid] @ normal) / range_image.points[valid][:, 2])
    sigma = np.zeros(valid.shape)
    sigma[valid] = np.sqrt(range_image.depth_variance[valid]) * ray_normal
    return gradient / (8 * spacing), sigma * np.sqrt(12) / (8 * spacing)


def _spikes(
    range_image: RangeImage,
    mask: NDArray[np.bool_],
    centre: NDArray[np.float64],
    normal: NDArray[np.float64],
    sigmas: float,
) -> NDArray[np.bool_]:
    """Pixels that stand off the median of their 5 × 5 neighbourhood by more than it explains."""
    height = np.where(mask, (range_image.points - centre) @ normal, 0.0)
    filled = _fill_from_nearest(height, mask).astype(np.float32)
    off = np.abs(filled - cv2.medianBlur(filled, 5))
    roughness = 1.4826 * cv2.medianBlur(off, 5)
    sigma = np.sqrt(np.where(mask, range_image.depth_variance, 0.0))
    return np.asarray(mask & (off > sigmas * np.hypot(sigma, roughness)))


def _fill_from_nearest(
    values: NDArray[np.float64], valid: NDArray[np.bool_]
) -> NDArray[np.float64]:
    _, labels = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    by_label = np.zeros(labels.max() + 1)
    by_label[labels[valid]] = values[valid]
    return by_label[labels]


def _seed_region(smooth: NDArray[np.bool_], window: float) -> NDArray[np.bool_]:
    """Seed fill from the centre: the connected region that holds most of the central window."""
    _, labels = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=4)
    rows, cols = smooth.shape
    for share in (window, 0.5, 1.0):
        half_rows, half_cols = max(1, round(rows * share / 2)), max(1, round(cols * share / 2))
        central = labels[
            max(0, rows // 2 - half_rows) : rows // 2 + half_rows + 1,
            max(0, cols // 2 - half_cols) : cols // 2 + half_cols + 1,
        ]
        votes = np.bincount(central.ravel(), minlength=2)
        votes[0] = 0
        if votes.max() > 0.05 * central.size or (share == 1.0 and votes.max() > 0):
            return np.asarray(labels == votes.argmax())
    raise FittingError(
        "the canvas is empty: no smooth surface anywhere in the range image; check exposure and "
        "focus of the scan"
    )


def _erode(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    if pixels == 0:
        return mask
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    # Beyond the picture nothing is known, so its border erodes too.
    eroded = cv2.erode(
        mask.astype(np.uint8), disc, borderType=cv2.BORDER_CONSTANT, borderValue=(0,)
    )
    return eroded.astype(bool)


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
