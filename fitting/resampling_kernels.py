"""Compiled resampling: scattered samples to a regular grid by local polynomials.

Samples are sorted into the cells of the grid, so that each texel finds those around it. The
mathematics is that of :mod:`fitting.resampling`; a plain reference is in the tests.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

QUADRATIC = 6
PLANE = 3
# Smallest pivot of the normal matrix, over the sum of the weights, that determines a polynomial.
_SMALLEST_PIVOT = 1e-4
_SMALLEST_VARIANCE = 1e-6


@njit(parallel=True, cache=True)
def locate_samples(
    points: NDArray[np.float64],
    depth_variance: NDArray[np.float32],
    mask: NDArray[np.bool_],
    rotation: NDArray[np.float64],
    origin: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """X and Y (rows, cols, 2), height, and variance of the height, of points in the canvas frame.

    ``rotation`` holds the canvas's axes as columns, ``origin`` is its origin, both in the frame of
    the points. A point errs along its viewing ray, so its height errs by the ray's slope against
    the canvas. Where the mask is false, NaN.
    """
    rows, cols = mask.shape
    place = np.full((rows, cols, 2), np.nan)
    height = np.full((rows, cols), np.nan, np.float32)
    variance = np.full((rows, cols), np.nan, np.float32)
    for i in prange(rows):
        for j in range(cols):
            if not mask[i, j]:
                continue
            px = points[i, j, 0]
            py = points[i, j, 1]
            pz = points[i, j, 2]
            dx = px - origin[0]
            dy = py - origin[1]
            dz = pz - origin[2]
            place[i, j, 0] = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
            place[i, j, 1] = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
            height[i, j] = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
            along = (rotation[0, 2] * px + rotation[1, 2] * py + rotation[2, 2] * pz) / pz
            variance[i, j] = depth_variance[i, j] * along * along
    return place, height, variance


@njit(cache=True)
def sort_into_cells(
    place: NDArray[np.float64],
    height: NDArray[np.float32],
    variance: NDArray[np.float32],
    mask: NDArray[np.bool_],
    x0: float,
    y0: float,
    pitch: float,
    rows: int,
    cols: int,
    unit: float,
    noise: NDArray[np.float32],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float32]]:
    """Samples by the cell of the grid that holds them.

    Returns the first sample of each cell (rows * cols + 1) and, in that order, the columns (n,) of
    the samples in texels and the rest of them (n, 4): rows below the cell's centre; height;
    precision in 1/unit; and what ``noise`` (n,), a draw of standard normal errors, weighs under
    that precision. Samples beyond the grid belong to the cell at its edge.
    """
    starts = np.zeros(rows * cols + 1, np.int64)
    height_px, width_px = mask.shape
    cell = np.empty(mask.shape, np.int32)
    for i in range(height_px):
        for j in range(width_px):
            if mask[i, j]:
                col = min(max(math.floor((place[i, j, 0] - x0) / pitch + 0.5), 0), cols - 1)
                row = min(max(math.floor((y0 - place[i, j, 1]) / pitch + 0.5), 0), rows - 1)
                cell[i, j] = row * cols + col
                starts[cell[i, j] + 1] += 1
    for k in range(rows * cols):
        starts[k + 1] += starts[k]
    column = np.empty(starts[-1])
    samples = np.empty((starts[-1], 4), np.float32)
    free = starts[:-1].copy()
    for i in range(height_px):
        for j in range(width_px):
            if mask[i, j]:
                k = cell[i, j]
                n = free[k]
                free[k] = n + 1
                column[n] = (place[i, j, 0] - x0) / pitch
                samples[n, 0] = (y0 - place[i, j, 1]) / pitch - k // cols
                samples[n, 1] = height[i, j]
                precision = unit / max(variance[i, j], _SMALLEST_VARIANCE * unit)
                samples[n, 2] = precision
                samples[n, 3] = math.sqrt(precision) * noise[n]
    return starts, column, samples


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _gather_moments(
    starts: NDArray[np.int64],
    column: NDArray[np.float64],
    samples: NDArray[np.float32],
    window: NDArray[np.int64],
    shape: tuple[int, int],
    texel: tuple[int, int],
    half_axes: tuple[float, float],
    near: float,
    moments: NDArray[np.float64],
    heights: NDArray[np.float64],
) -> tuple[int, bool, float, float, float]:
    """Normal equations of the quadratic at a texel, in units of the half-axes.

    Writes the matrix (lower triangle) and the right-hand side. Returns the number of samples;
    whether each of the four quadrants has one within ``near`` half-axes; the variance of the
    samples' weighted mean; the weighted sum of squared heights; and the sum of the biweights.
    """
    rows, cols = shape
    row, col = texel
    per_x, per_y = 1.0 / half_axes[0], 1.0 / half_axes[1]
    within = near * near
    count = quadrants = 0
    z0 = z1 = z2 = z3 = z4 = z5 = zz = plain = squares = 0.0
    s = sx = sy = sxx = sxy = syy = sxxx = sxxy = sxyy = syyy = 0.0
    s40 = s31 = s22 = s13 = s04 = 0.0
    down = len(window) - 1
    for i in range(max(0, row - down), min(rows - 1, row + down) + 1):
        across = window[abs(i - row)]
        # Along a row the samples of the cells follow one another.
        first = starts[i * cols + max(0, col - across)]
        last = starts[i * cols + min(cols - 1, col + across) + 1]
        for n in range(first, last):
            x = (column[n] - col) * per_x
            y = (samples[n, 0] + (i - row)) * per_y
            xx = x * x
            yy = y * y
            k = 1.0 - xx - yy
            if k <= 0.0:
                continue
            k *= k
            count += 1
            if xx + yy <= within:
                if x >= 0.0:
                    quadrants |= 1 if y <= 0.0 else 2
                if x <= 0.0:
                    quadrants |= 4 if y <= 0.0 else 8
            w = k * samples[n, 2]
            z = np.float64(samples[n, 1])
            xy = x * y
            wxx = w * xx
            wyy = w * yy
            wz = w * z
            plain += k
            squares += w * k
            s += w
            sx += w * x
            sy += w * y
            sxx += wxx
            sxy += w * xy
            syy += wyy
            sxxx += wxx * x
            sxxy += wxx * y
            sxyy += wyy * x
            syyy += wyy * y
            s40 += wxx * xx
            s31 += wxx * xy
            s22 += wxx * yy
            s13 += wyy * xy
            s04 += wyy * yy
            z0 += wz
            z1 += wz * x
            z2 += wz * y
            z3 += wz * xx
            z4 += wz * xy
            z5 += wz * yy
            zz += wz * z
    moments[0, 0] = s40
    moments[1, 0], moments[1, 1] = s31, s22
    moments[2, 0], moments[2, 1], moments[2, 2] = s22, s13, s04
    moments[3, 0], moments[3, 1], moments[3, 2], moments[3, 3] = sxxx, sxxy, sxyy, sxx
    moments[4, 0], moments[4, 1], moments[4, 2] = sxxy, sxyy, syyy
    moments[4, 3], moments[4, 4] = sxy, syy
    moments[5, 0], moments[5, 1], moments[5, 2] = sxx, sxy, syy
    moments[5, 3], moments[5, 4], moments[5, 5] = sx, sy, s
    heights[0], heights[1], heights[2] = z3, z4, z5
    heights[3], heights[4], heights[5] = z1, z2, z0
    return count, quadrants == 15, squares / (s * s), zz, plain


@njit(cache=True, fastmath={"contract", "reassoc"})
def _solve_quadratic(
    moments: NDArray[np.float64],
    first: int,
    heights: NDArray[np.float64],
    factor: NDArray[np.float64],
    solution: NDArray[np.float64],
) -> float:
    """Eliminate the terms from ``first`` on, in the order xx, xy, yy, x, y, 1, by LDLᵀ.

    With the constant last, its row of the inverse matrix, the ``solution`` by which the samples are
    combined to the value at the texel, takes no forward substitution. Returns by how much the fit
    lessens the weighted sum of squares; NaN where the matrix is all but singular.
    """
    explained = 0.0
    for i in range(first, QUADRATIC):
        for j in range(first, i):
            total = moments[i, j]
            for k in range(first, j):
                total -= factor[i, k] * factor[j, k]
            # Rows of L times D for now.
            factor[i, j] = total
        pivot = moments[i, i]
        right = heights[i]
        for j in range(first, i):
            scaled = factor[i, j] * factor[j, j]
            pivot -= scaled * factor[i, j]
            right -= scaled * solution[j]
            factor[i, j] = scaled
        if not pivot > _SMALLEST_PIVOT * moments[5, 5]:
            return math.nan
        factor[i, i] = 1.0 / pivot
        solution[i] = right
        explained += right * right * factor[i, i]
    solution[5] = factor[5, 5]
    for i in range(4, first - 1, -1):
        total = 0.0
        for k in range(i + 1, QUADRATIC):
            total -= factor[k, i] * solution[k]
        solution[i] = total
    for i in range(first):
        solution[i] = 0.0
    return explained


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _combine_samples(
    starts: NDArray[np.int64],
    column: NDArray[np.float64],
    samples: NDArray[np.float32],
    window: NDArray[np.int64],
    shape: tuple[int, int],
    texel: tuple[int, int],
    half_axes: tuple[float, float],
    solution: NDArray[np.float64],
) -> tuple[float, float]:
    """Variance of the polynomial's value at a texel, and the error that the drawn noise makes.

    ``solution`` is the first row of the inverse normal matrix.
    """
    rows, cols = shape
    row, col = texel
    per_x, per_y = 1.0 / half_axes[0], 1.0 / half_axes[1]
    s0, s1, s2 = solution[0], solution[1], solution[2]
    s3, s4, s5 = solution[3], solution[4], solution[5]
    variance = error = 0.0
    down = len(window) - 1
    for i in range(max(0, row - down), min(rows - 1, row + down) + 1):
        across = window[abs(i - row)]
        first = starts[i * cols + max(0, col - across)]
        last = starts[i * cols + min(cols - 1, col + across) + 1]
        for n in range(first, last):
            x = (column[n] - col) * per_x
            y = (samples[n, 0] + (i - row)) * per_y
            k = 1.0 - x * x - y * y
            if k <= 0.0:
                continue
            share = k * k * (s5 + x * (s3 + s0 * x + s1 * y) + y * (s4 + s2 * y))
            variance += share * share * samples[n, 2]
            error += share * samples[n, 3]
    return variance, error


@njit(parallel=True, cache=True, error_model="numpy")
def fit_local_polynomials(
    starts: NDArray[np.int64],
    column: NDArray[np.float64],
    samples: NDArray[np.float32],
    window: NDArray[np.int64],
    shape: tuple[int, int],
    half_axes: tuple[float, float],
    reach: float,
    magnification: float,
    scatter: float,
) -> tuple[
    NDArray[np.float32],
    NDArray[np.float32],
    NDArray[np.float32],
    NDArray[np.float32],
    NDArray[np.uint8],
]:
    """Height, variance, unresolved variance, propagated noise, and what was fitted, per texel.

    The samples within an ellipse around a texel, its half-axes in texels, are weighted by a
    biweight and their precision, and a quadratic is fitted; failing that, a plane. The last array
    has the number of terms, 0 where a quadrant has no sample within ``reach`` half-axes or the fit
    magnifies the noise of the samples' mean by more than ``magnification``. Where the samples
    scatter about the quadratic by more than ``scatter`` times what noise alone would, the weighted
    mean square of that scatter is unresolved variance. What the drawn noise makes of each texel
    comes back in standard errors. ``window`` has, by distance in rows, the cells to either side.
    """
    rows, cols = shape
    height = np.zeros((rows, cols), np.float32)
    variance = np.zeros((rows, cols), np.float32)
    unresolved = np.zeros((rows, cols), np.float32)
    error = np.zeros((rows, cols), np.float32)
    fitted = np.zeros((rows, cols), np.uint8)
    for row in prange(rows):
        moments = np.zeros((QUADRATIC, QUADRATIC))
        factor = np.zeros((QUADRATIC, QUADRATIC))
        heights = np.zeros(QUADRATIC)
        solution = np.zeros(QUADRATIC)
        for col in range(cols):
            texel = (row, col)
            count, surrounded, of_mean, squares, plain = _gather_moments(
                starts, column, samples, window, shape, texel, half_axes, reach, moments, heights
            )
            if not surrounded:
                continue
            for terms in (QUADRATIC, PLANE):
                first = QUADRATIC - terms
                if count < terms:
                    continue
                explained = _solve_quadratic(moments, first, heights, factor, solution)
                if math.isnan(explained):
                    continue
                spread, drawn = _combine_samples(
                    starts, column, samples, window, shape, texel, half_axes, solution
                )
                if not spread <= magnification * of_mean:
                    continue
                value = 0.0
                for i in range(first, QUADRATIC):
                    value += solution[i] * heights[i]
                height[row, col] = value
                variance[row, col] = spread
                error[row, col] = drawn / math.sqrt(spread)
                fitted[row, col] = terms
                if squares - explained > scatter * plain:
                    unresolved[row, col] = (squares - explained) / moments[5, 5]
                break
    return height, variance, unresolved, error, fitted
