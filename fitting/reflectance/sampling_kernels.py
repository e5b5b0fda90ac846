"""Compiled look-up of texels in photographs, each under its own footprint.

A texel is looked up by cubic convolution (Keys, IEEE Transactions on Acoustics, Speech, and Signal
Processing 29, 1981), which keeps what pixels resolve: a highlight along a bristle's furrow is a
pixel wide. The kernel is stretched to the texel where that is larger than the pixels' spacing, and
so takes a mean over it. Where the kernel's skirts reach beyond the picture, or to a pixel that is
saturated, a tent of half the reach takes its place. Of a mosaic, each of the four grids of like
pixels is looked up by itself, two pixels being their spacing, so that nothing is made up between
the colours, and slopes of radiance do not turn into colour.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


@njit(inline="always")
def _tent(away: float) -> float:
    return max(1.0 - abs(away), 0.0)


@njit(inline="always")
def _cubic(away: float) -> float:
    """Keys' kernel with the slope of -1/2 at 1, which reproduces quadratics."""
    x = abs(away)
    if x < 1.0:
        return (1.5 * x - 2.5) * x * x + 1.0
    if x < 2.0:
        return ((2.5 - 0.5 * x) * x - 4.0) * x + 2.0
    return 0.0


@njit(cache=True)
def _look_up(image, variance, flat, row_phase, col_phase, step, channel, u, v, wide, high, sharp):  # type: ignore[no-untyped-def]
    """Weighted mean and its variance at column u and row v; NaN if a pixel in reach is unusable.

    The kernel is the cubic if ``sharp``, otherwise the tent.
    """
    rows, cols = image.shape[:2]
    wide = max(wide, float(step))
    high = max(high, float(step))
    reach = 2.0 if sharp else 1.0
    left, right = u - reach * wide, u + reach * wide
    top, bottom = v - reach * high, v + reach * high
    if not (left >= -1.0 and top >= -1.0 and right <= cols and bottom <= rows):
        return math.nan, math.nan
    total = 0.0
    light = 0.0
    noise = 0.0
    first_row = math.floor(top) + 1
    first_row += (row_phase - first_row) % step
    first_col = math.floor(left) + 1
    first_col += (col_phase - first_col) % step
    for row in range(first_row, math.ceil(bottom), step):
        down = (row - v) / high
        down = _cubic(down) if sharp else _tent(down)
        for col in range(first_col, math.ceil(right), step):
            along = (col - u) / wide
            weight = down * (_cubic(along) if sharp else _tent(along))
            if abs(weight) <= 1e-9:
                continue
            if row < 0 or col < 0 or row >= rows or col >= cols:
                return math.nan, math.nan
            gain = 1.0 / flat[row, col] if flat.size > 0 else 1.0
            total += weight
            light += weight * gain * image[row, col, channel]
            noise += weight * weight * gain * gain * variance[row, col, channel]
    if not total > 0.0:
        return math.nan, math.nan
    return light / total, noise / (total * total)


@njit(cache=True)
def _look_up_best(image, variance, flat, row_phase, col_phase, step, channel, u, v, wide, high):  # type: ignore[no-untyped-def]
    """By the cubic where all of its reach is usable, otherwise by the tent."""
    mean, noise = _look_up(
        image, variance, flat, row_phase, col_phase, step, channel, u, v, wide, high, True
    )
    if math.isfinite(mean) and math.isfinite(noise):
        return mean, noise
    return _look_up(
        image, variance, flat, row_phase, col_phase, step, channel, u, v, wide, high, False
    )


@njit(parallel=True, cache=True)
def look_up_texels(
    image: NDArray[np.float32],
    variance: NDArray[np.float32],
    flat: NDArray[np.float32],
    channels: NDArray[np.int64],
    pixels: NDArray[np.float64],
    footprint: NDArray[np.float64],
    usable: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Radiance and variance (n, 3) of texels; NaN where a channel cannot be had.

    Parameters
    ----------
    image, variance : (rows, cols, 3) array, or (rows, cols, 1) of a mosaic or of grey
    flat : (rows, cols) array, or (0, 0)
    channels : (2, 2) array
        Channel by parity of row and column; negative for pixels of three channels.
    pixels : (n, 2) array
        Column and row of the texels' centres.
    footprint : (n, 2) array
        Width and height of the texels in pixels.
    usable : (n,) bool array
        Which texels to look up.
    """
    n = len(pixels)
    radiance = np.full((n, 3), np.nan)
    noise = np.full((n, 3), np.nan)
    for i in prange(n):
        if not usable[i]:
            continue
        u, v = pixels[i]
        wide, high = footprint[i]
        if channels[0, 0] < 0:
            for c in range(image.shape[2]):
                radiance[i, c], noise[i, c] = _look_up_best(
                    image, variance, flat, 0, 0, 1, c, u, v, wide, high
                )
            for c in range(image.shape[2], 3):
                radiance[i, c], noise[i, c] = radiance[i, 0], noise[i, 0]
            continue
        counts = np.zeros(3)
        light = np.zeros(3)
        squares = np.zeros(3)
        for row in range(2):
            for col in range(2):
                c = channels[row, col]
                mean, own = _look_up_best(image, variance, flat, row, col, 2, 0, u, v, wide, high)
                counts[c] += 1.0
                light[c] += mean
                squares[c] += own
        for c in range(3):
            radiance[i, c] = light[c] / counts[c]
            noise[i, c] = squares[c] / (counts[c] * counts[c])
    return radiance, noise


@njit(parallel=True, cache=True)
def store_samples(
    frames: NDArray[np.float64],
    towards_light: NDArray[np.float64],
    irradiance: NDArray[np.float64],
    radiance: NDArray[np.float64],
    noise: NDArray[np.float64],
    place: int,
    light_out: NDArray[np.float32],
    radiance_out: NDArray[np.float32],
    variance_out: NDArray[np.float32],
    weight_out: NDArray[np.float32],
) -> None:
    """Fill one photograph's samples: directions in the texels' frames, radiance over irradiance.

    A sample that lacks a channel, or light, has weight zero; all that is stored is finite.
    """
    for n in prange(len(frames)):
        for k in range(3):
            light_out[n, place, k] = (
                frames[n, k, 0] * towards_light[n, 0]
                + frames[n, k, 1] * towards_light[n, 1]
                + frames[n, k, 2] * towards_light[n, 2]
            )
        good = light_out[n, place, 2] > 0.0
        for c in range(3):
            good = good and irradiance[n, c] > 0.0 and 0.0 < noise[n, c] < math.inf
            good = good and math.isfinite(radiance[n, c])
        weight_out[n, place] = 1.0 if good else 0.0
        for c in range(3):
            if good:
                radiance_out[n, place, c] = radiance[n, c] / irradiance[n, c]
                variance_out[n, place, c] = noise[n, c] / (irradiance[n, c] * irradiance[n, c])
            else:
                radiance_out[n, place, c] = 0.0
                variance_out[n, place, c] = 1.0
