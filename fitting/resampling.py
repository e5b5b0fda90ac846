"""From range points to the regular height field, with the right footprint.

Around each texel a quadratic is fitted to the samples under a biweight whose radius is twice the
texel pitch or twice the spacing of the samples, whichever is larger, weighted by the samples'
precision (moving least squares: Lancaster and Salkauskas, Math. Comp. 37, 1981). It reproduces
curved strokes where bilinear interpolation cuts them off, averages samples that are denser than
the grid, so that nothing aliases, and is a linear combination of the samples, whose variance
follows exactly. Neighbouring texels share samples: the correlation of their errors is measured on
one draw of noise sent through the same combination. Where there are too few samples for a
quadratic a plane is fitted. A texel that the samples do not surround closely is a gap: across the
edge of a shadow, or of a stroke that hides what is behind it, nothing is made up.

Where the samples scatter about their quadratic far beyond their noise, the surface has detail that
they do not resolve, and a share of that scatter is added to the variance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.lens import rotation
from fitting.canvas import Canvas
from fitting.errors import FittingError
from fitting.height_field import CORRELATION_REACH, HeightField
from fitting.range_image import RangeImage, neighbour_steps
from fitting.resampling_kernels import fit_local_polynomials, locate_samples, sort_into_cells

# Radius of the biweight in pitches or spacings. On paint with brush marks, noise and what the
# polynomial cuts off add up to least near this.
_RADIUS = 2.0
# Each quadrant around a texel must have a sample within this, in pitches or spacings. Beyond that
# lie steps that the camera or the projector does not see.
_REACH = 1.5
# Mean square of the samples' scatter, in their own variances, that noise explains with near
# certainty (on average it makes 0.4), and the share of more than that by which heights err. Found
# on painted strokes, where they bring the standardised errors to a spread of one.
_SCATTER = 2.0
_UNRESOLVED_SHARE = 0.7
# How much the variance may exceed that of the samples' mean.
_LARGEST_MAGNIFICATION = 9.0
_LARGEST_SIDE = 16384
# Texels to a point, and points or texels to a radius, beyond which time is spent on nothing.
_MOST_TEXELS_A_POINT = 10
_WIDEST = 50
# Rows on which the correlation of neighbours is measured, at most.
_CORRELATED_ROWS = 400


def resample_heights(
    range_image: RangeImage,
    canvas: Canvas,
    *,
    pitch_mm: float | None = None,
    footprint_mm: float | None = None,
) -> HeightField:
    """Resample a range image onto a canvas-aligned grid.

    Parameters
    ----------
    range_image : RangeImage
        Points in the camera frame.
    canvas : Canvas
        Mask and pose.
    pitch_mm : float, optional
        Distance of the texels; by default the median spacing of the points.
    footprint_mm : float, optional
        Radius of the biweight, where more smoothing is wanted than the pitch and the points'
        spacing need; see :func:`footprint_radius_mm`.

    Returns
    -------
    HeightField

    Raises
    ------
    FittingError
        The pitch asked for is not positive, finer than a tenth of the points' spacing, or makes a
        grid of more than 16384 texels a side; or the footprint is not positive, or wider than
        fifty pitches and spacings.
    """
    spacing = point_spacing_mm(range_image, canvas)
    pitch = float(np.sqrt(spacing[0] * spacing[1])) if pitch_mm is None else float(pitch_mm)
    if not (np.isfinite(pitch) and pitch > 0):
        raise FittingError(f"the pitch must be positive, not {pitch_mm} mm")
    if pitch < max(spacing) / _MOST_TEXELS_A_POINT:
        raise FittingError(
            f"a pitch of {pitch:g} mm is finer than a tenth of the points' spacing of "
            f"{max(spacing):.3g} mm, and they tell no more; ask for a coarser one"
        )
    place, heights, variance = canvas_samples(range_image, canvas)
    low = np.array([np.nanmin(place[..., axis]) for axis in (0, 1)])
    high = np.array([np.nanmax(place[..., axis]) for axis in (0, 1)])
    cols, rows = (int(n) for n in np.maximum(1, np.floor((high - low) / pitch)))
    if max(rows, cols) > _LARGEST_SIDE:
        raise FittingError(
            f"a pitch of {pitch:g} mm makes {cols} × {rows} texels, more than {_LARGEST_SIDE} a "
            "side; ask for a coarser one"
        )
    # The grid is centred on the points' extent.
    x0 = float(0.5 * (low[0] + high[0]) - 0.5 * (cols - 1) * pitch)
    y0 = float(0.5 * (low[1] + high[1]) + 0.5 * (rows - 1) * pitch)
    # In units of the median the sums are of order one, whatever the unit of length.
    unit = float(np.median(variance[canvas.mask])) or 1.0
    draw = np.random.default_rng(0)
    noise = draw.standard_normal(int(canvas.mask.sum()), dtype=np.float32)
    starts, column, samples = sort_into_cells(
        place, heights, variance, canvas.mask, x0, y0, pitch, rows, cols, unit, noise
    )
    del place, heights, variance
    radius = footprint_radius_mm(spacing, pitch, footprint_mm)
    half_axes = (radius[0] / pitch, radius[1] / pitch)
    height, texel_variance, unresolved, error, fitted = fit_local_polynomials(
        starts,
        column,
        samples,
        _window(half_axes),
        (rows, cols),
        half_axes,
        _REACH * max(pitch, *spacing) / max(radius),
        _LARGEST_MAGNIFICATION,
        _SCATTER * unit,
    )
    mask = fitted > 0
    unresolved *= np.float32(_UNRESOLVED_SHARE)
    return HeightField(
        height,
        mask,
        texel_variance * np.float32(unit) + unresolved,
        pitch,
        (x0, y0),
        canvas.rt_cam_canvas,
        _correlation(error, mask),
        float(np.sqrt(np.sum(unresolved, dtype=np.float64) / max(int(mask.sum()), 1))),
    )


def canvas_samples(
    range_image: RangeImage, canvas: Canvas
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Range points in the canvas frame.

    Returns
    -------
    place : (rows, cols, 2) float64 array
        X and Y in mm; NaN off the canvas.
    height : (rows, cols) float32 array
        Above the canvas plane, mm.
    variance : (rows, cols) float32 array
        Of the height, mm²: a point errs along its viewing ray.
    """
    return locate_samples(
        np.ascontiguousarray(range_image.points, dtype=np.float64),
        np.ascontiguousarray(range_image.depth_variance, dtype=np.float32),
        canvas.mask,
        rotation(canvas.rt_cam_canvas),
        np.ascontiguousarray(canvas.rt_cam_canvas[3:]),
    )


def footprint_radius_mm(
    spacing_mm: tuple[float, float], pitch_mm: float, footprint_mm: float | None = None
) -> tuple[float, float]:
    """Radius along X and Y of the biweight under which heights are fitted.

    Twice the pitch or the points' spacing, whichever is larger, or what was asked for if that is
    larger still. The heights' resolution, the full width at half maximum of what a point makes of
    the surface, is about three quarters of the radius.

    Raises
    ------
    FittingError
        The footprint asked for is not positive, or too wide.
    """
    if footprint_mm is not None and not (np.isfinite(footprint_mm) and footprint_mm > 0):
        raise FittingError(f"the footprint must be positive, not {footprint_mm} mm")
    if footprint_mm is not None and footprint_mm > _WIDEST * max(pitch_mm, *spacing_mm):
        raise FittingError(
            f"a footprint of {footprint_mm:g} mm spans more than {_WIDEST} texels and points; ask "
            "for a coarser pitch with it"
        )
    x, y = (max(_RADIUS * max(pitch_mm, s), footprint_mm or 0.0) for s in spacing_mm)
    return x, y


def point_spacing_mm(range_image: RangeImage, canvas: Canvas) -> tuple[float, float]:
    """Median distance of neighbouring points along the canvas's X and Y."""
    axes = rotation(canvas.rt_cam_canvas)[:, :2]
    steps = [
        np.median(np.abs(step @ axes), axis=0) if len(step) else np.full(2, np.nan)
        for step in neighbour_steps(range_image.points, canvas.mask)
    ]
    # Each canvas axis is crossed by whichever of rows and columns runs along it.
    spacing = np.maximum(steps[0], steps[1])
    if not (np.isfinite(spacing).all() and (spacing > 0).all()):
        raise FittingError("no two neighbouring pixels of the canvas were measured")
    return float(spacing[0]), float(spacing[1])


def _window(half_axes: tuple[float, float]) -> NDArray[np.int64]:
    """Cells to either side, by distance in rows, that an ellipse around a texel can reach."""
    across, down = half_axes
    nearest = (np.arange(int(np.ceil(down - 0.5)) + 1) - 0.5).clip(0) / down
    return np.ceil(across * np.sqrt(1 - nearest**2) - 0.5).astype(np.int64)


def _correlation(error: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Correlation of the errors of neighbours, by what one draw of noise made of the texels."""
    reach = CORRELATION_REACH
    rows = max(1, mask.shape[0] // _CORRELATED_ROWS)
    padded = np.pad(error, reach)
    there = np.pad(mask, reach)
    correlation = np.zeros((2 * reach + 1, 2 * reach + 1))
    own, own_there = error[::rows], mask[::rows]
    for i in range(reach + 1):
        for j in range(-reach, reach + 1):
            down, right = slice(reach + i, reach + i + mask.shape[0], rows), reach + j
            other = padded[down, right : right + mask.shape[1]]
            both = own_there & there[down, right : right + mask.shape[1]]
            value = float(np.sum(own * other, dtype=np.float64) / max(int(both.sum()), 1))
            correlation[reach + i, reach + j] = correlation[reach - i, reach - j] = value
    return correlation / max(correlation[reach, reach], 1e-12)
