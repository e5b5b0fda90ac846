"""Compiled look-up of texels in photographs, each under its own footprint.

A texel is looked up with a tent over the pixels: as wide as the texel is in the photograph, or as
the spacing of the pixels where that is larger. Of texels smaller than a pixel this is bilinear
interpolation, of larger ones a mean over the texel. Of a mosaic, each of the four grids of like
pixels is looked up by itself, two pixels being their spacing, so that nothing is made up between
the colours, and slopes of radiance do not turn into colour.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


@njit(cache=True)
def _look_up(image, variance, flat, row_phase, col_phase, step, channel, u, v, wide, high):  # type: ignore[no-untyped-def]
    """Weighted mean and its variance at column u and row v; NaN if a pixel in reach is unusable."""
    rows, cols = image.shape[:2]
    wide = max(wide, float(step))
    high = max(high, float(step))
    if not (u - wide >= -1.0 and v - high >= -1.0 and u + wide <= cols and v + high <= rows):
        return math.nan, math.nan
    total = 0.0
    light = 0.0
    noise = 0.0
    first_row = math.floor(v - high) + 1
    first_row += (row_phase - first_row) % step
    first_col = math.floor(u - wide) + 1
    first_col += (col_phase - first_col) % step
    for row in range(first_row, math.ceil(v + high), step):
        down = 1.0 - abs(row - v) / high
        for col in range(first_col, math.ceil(u + wide), step):
            weight = down * (1.0 - abs(col - u) / wide)
            if weight <= 1e-9:
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
                radiance[i, c], noise[i, c] = _look_up(
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
                mean, own = _look_up(image, variance, flat, row, col, 2, 0, u, v, wide, high)
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
