"""From range points to the regular height field, with the right footprint.

Around each texel a plane is fitted to the samples under a tent whose half-width is the texel
pitch or the spacing of the samples, whichever is larger, weighted by the samples' precision. On
equally precise samples that lie on the grid's own spacing this is bilinear interpolation; on
denser samples it averages them, so that nothing aliases; in both cases the height is a linear
combination of the samples, and its variance follows exactly. Where the samples lie too far apart
for that, the tent is twice as wide; texels with no sample within it stay gaps.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.lens import invert, rotation, transform
from fitting.canvas import Canvas
from fitting.errors import FittingError
from fitting.height_field import HeightField
from fitting.neighbour_kernels import accumulate_local_planes
from fitting.range_image import RangeImage

# A texel further than this from every sample, in half-widths, is a gap.
_REACH = 0.75
# Half-widths tried in turn, in units of the first.
_WIDENINGS = (1.0, 2.0)
_LARGEST_MAGNIFICATION = 9.0
_LARGEST_SIDE = 16384


def resample_heights(
    range_image: RangeImage, canvas: Canvas, *, pitch_mm: float | None = None
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

    Returns
    -------
    HeightField

    Raises
    ------
    FittingError
        The pitch asked for is not positive, or makes a grid of more than 16384 texels a side.
    """
    spacing = point_spacing_mm(range_image, canvas)
    pitch = float(np.sqrt(spacing[0] * spacing[1])) if pitch_mm is None else float(pitch_mm)
    if not (np.isfinite(pitch) and pitch > 0):
        raise FittingError(f"the pitch must be positive, not {pitch_mm} mm")
    local = transform(invert(canvas.rt_cam_canvas), range_image.points[canvas.mask])
    variance = height_variance(range_image, canvas)[canvas.mask]
    # In units of the median the sums below are of order one, whatever the units of length.
    unit = float(np.median(variance))
    variance = np.maximum(variance / unit, 1e-6) if unit > 0 else np.ones_like(variance)
    low, high = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
    cols, rows = np.maximum(1, np.floor((high - low) / pitch).astype(int))
    if max(rows, cols) > _LARGEST_SIDE:
        raise FittingError(
            f"a pitch of {pitch:g} mm makes {cols} × {rows} texels, more than {_LARGEST_SIDE} a "
            "side; ask for a coarser one"
        )
    # The grid is centred on the points' extent.
    x0 = 0.5 * (low[0] + high[0]) - 0.5 * (cols - 1) * pitch
    y0 = 0.5 * (low[1] + high[1]) + 0.5 * (rows - 1) * pitch
    height = np.zeros((rows, cols))
    texel_variance = np.zeros((rows, cols))
    mask = np.zeros((rows, cols), np.bool_)
    wanted = np.ones((rows, cols), np.bool_)
    # Where the surface turns away from the camera its samples lie further apart than the median.
    for widening in _WIDENINGS:
        moments, noise, nearest, count = accumulate_local_planes(
            (local[:, 0] - x0) / pitch,
            (y0 - local[:, 1]) / pitch,
            local[:, 2],
            variance,
            widening * max(1.0, spacing[0] / pitch),
            widening * max(1.0, spacing[1] / pitch),
            wanted,
        )
        plane, plane_variance, determined = _solve_planes(moments, noise)
        found = wanted & determined & (nearest <= _REACH) & (count >= 3)
        height[found], texel_variance[found] = plane[found], plane_variance[found]
        mask |= found
        wanted &= ~found
    return HeightField(
        height.astype(np.float32),
        mask,
        (texel_variance * unit).astype(np.float32),
        pitch,
        (float(x0), float(y0)),
        canvas.rt_cam_canvas,
    )


def point_spacing_mm(range_image: RangeImage, canvas: Canvas) -> tuple[float, float]:
    """Median distance of neighbouring points along the canvas's X and Y."""
    axes = rotation(canvas.rt_cam_canvas)[:, :2]
    steps = []
    for axis in (0, 1):
        both = canvas.mask & np.roll(canvas.mask, -1, axis=axis)
        index = [slice(None)] * 2
        index[axis] = slice(0, -1)
        both[tuple(slice(-1, None) if a == axis else slice(None) for a in (0, 1))] = False
        rows, cols = np.nonzero(both)
        thin = slice(None, None, max(1, len(rows) // 50_000))
        rows, cols = rows[thin], cols[thin]
        ahead = (rows + 1, cols) if axis == 0 else (rows, cols + 1)
        step = (range_image.points[ahead] - range_image.points[rows, cols]) @ axes
        steps.append(np.median(np.abs(step), axis=0))
    if not all(np.isfinite(step).all() for step in steps):
        raise FittingError("no two neighbouring pixels of the canvas were measured")
    # Each canvas axis is crossed by whichever of rows and columns runs along it.
    spacing = np.maximum(steps[0], steps[1])
    return float(spacing[0]), float(spacing[1])


def height_variance(range_image: RangeImage, canvas: Canvas) -> NDArray[np.float64]:
    """Variance of the height above the canvas of every pixel, (rows, cols), mm².

    A point errs along its viewing ray, so its height errs by the ray's slope against the canvas.
    """
    normal = rotation(canvas.rt_cam_canvas)[:, 2]
    with np.errstate(invalid="ignore"):
        along = (range_image.points @ normal) / range_image.points[..., 2]
        return np.asarray(range_image.depth_variance * along**2)


def _solve_planes(
    moments: NDArray[np.float64], noise: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Value of each texel's plane at its centre, its variance, and where it is determined."""
    s, sx, sy, sxx, sxy, syy, sz, sxz, syz = np.moveaxis(moments, -1, 0)
    # First row of the inverse normal matrix, by cofactors: height = a·Σwz + b·Σwxz + c·Σwyz.
    cofactor_a = sxx * syy - sxy * sxy
    cofactor_b = sxy * sy - sx * syy
    cofactor_c = sx * sxy - sxx * sy
    determinant = s * cofactor_a + sx * cofactor_b + sy * cofactor_c
    scale = np.maximum(s, 1e-30)
    # Over the cube of the weight, it is the spread of the samples in texels to the fourth.
    determined = determinant > 1e-4 * scale**3
    safe = np.where(determined, determinant, 1.0)
    a, b, c = cofactor_a / safe, cofactor_b / safe, cofactor_c / safe
    height = a * sz + b * sxz + c * syz
    v, vx, vy, vxx, vxy, vyy = np.moveaxis(noise, -1, 0)
    variance = a * a * v + b * b * vxx + c * c * vyy + 2 * (a * b * vx + a * c * vy + b * c * vxy)
    # A plane through samples on one side only is a guess, which shows in how it magnifies their
    # noise over that of their mean.
    determined &= variance <= _LARGEST_MAGNIFICATION * v / scale**2
    return height, variance, determined
