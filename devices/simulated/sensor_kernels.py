r"""Compiled exposure: light looked up, photons counted, read out and quantised in one pass.

Random numbers are those of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014) at a position that depends
on the frame's key and on the pixel alone: the same frame comes out whatever the number of threads.
Photons follow Poisson's distribution exactly: by inversion below a mean of 10, by Hörmann's
transformed rejection PTRS (Insurance: Mathematics and Economics 12, 1993) above. Read noise is
normal, by the rational approximation AS 241 (Wichura, Applied Statistics 37, 1988; PPND7, seven
digits).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
# Random numbers that a pixel may use.
_DRAWS = np.uint64(64)
_S11, _S27, _S30, _S31 = np.uint64(11), np.uint64(27), np.uint64(30), np.uint64(31)


@njit(inline="always")
def _uniform(key: np.uint64, counter: np.uint64) -> float:
    """A number between 0 and 1, neither of them."""
    x = key + counter * _GOLDEN
    x = (x ^ (x >> _S30)) * _MIX_1
    x = (x ^ (x >> _S27)) * _MIX_2
    x = x ^ (x >> _S31)
    return (float(x >> _S11) + 0.5) / 9007199254740992.0


@njit(inline="always")
def _normal(p: float) -> float:
    """The standard normal quantile of p (AS 241, PPND7)."""
    q = p - 0.5
    if abs(q) <= 0.425:
        r = 0.180625 - q * q
        above = ((59.109374720 * r + 159.29113202) * r + 50.434271938) * r + 3.3871327179
        below = ((67.187563600 * r + 78.757757664) * r + 17.895169469) * r + 1.0
        return q * above / below
    r = math.sqrt(-math.log(p if q < 0 else 1 - p))
    if r <= 5:
        r -= 1.6
        above = ((0.17023821103 * r + 1.3067284816) * r + 2.7568153900) * r + 1.4234372777
        below = (0.12021132975 * r + 0.73700164250) * r + 1.0
    else:
        r -= 5
        above = ((0.017337203997 * r + 0.42868294337) * r + 3.0812263860) * r + 6.6579051150
        below = (0.012258202635 * r + 0.24197894225) * r + 1.0
    return above / below if q > 0 else -above / below


@njit(inline="always")
def _poisson(mean: float, key: np.uint64, counter: np.uint64) -> float:
    """A number of photons."""
    one = np.uint64(1)
    if mean < 10:
        left = _uniform(key, counter)
        share = math.exp(-mean)
        count = 0
        while left > share and count < 200:
            left -= share
            count += 1
            share *= mean / count
        return float(count)
    b = 0.931 + 2.53 * math.sqrt(mean)
    a = -0.059 + 0.02483 * b
    accept = 0.9277 - 3.6224 / (b - 2)
    for _ in range(31):
        u = _uniform(key, counter) - 0.5
        v = _uniform(key, counter + one)
        counter += one + one
        us = 0.5 - abs(u)
        k = math.floor((2 * a / us + b) * u + mean + 0.43)
        if us >= 0.07 and v <= accept:
            return k
        if k < 0 or (us < 0.013 and v > us):
            continue
        inverse = 1.1239 + 1.1328 / (b - 3.4)
        log_left = math.log(v * inverse / (a / (us * us) + b))
        if log_left <= k * math.log(mean) - mean - math.lgamma(k + 1):
            return k
    return math.floor(mean + 0.5)


@njit(inline="always")
def _look_up(picture: NDArray[np.float32], col: float, row: float) -> float:
    """Bilinear value of a picture, 0 outside.

    OpenCV's remap rounds coordinates to a 32nd of a pixel, which decoding would see.
    """
    rows, cols = picture.shape
    if not (-0.5 <= col <= cols - 0.5 and -0.5 <= row <= rows - 0.5):
        return 0.0
    col = min(max(col, 0.0), cols - 1.0)
    row = min(max(row, 0.0), rows - 1.0)
    c = min(int(col), cols - 2)
    r = min(int(row), rows - 2)
    u = col - c
    v = row - r
    top = picture[r, c] + u * (picture[r, c + 1] - picture[r, c])
    bottom = picture[r + 1, c] + u * (picture[r + 1, c + 1] - picture[r + 1, c])
    return top + v * (bottom - top)


@njit(parallel=True, cache=True)
def look_up(picture: NDArray[np.float32], at: NDArray[np.float32]) -> NDArray[np.float64]:
    """Picture values at (n, 2) columns and rows, bilinear, 0 outside."""
    found = np.empty(len(at))
    for n in prange(len(at)):
        found[n] = _look_up(picture, at[n, 0], at[n, 1])
    return found


@njit(parallel=True, cache=True)
def expose(
    shown: NDArray[np.float32],
    panel: NDArray[np.float32],
    response: NDArray[np.float32],
    steady: NDArray[np.float32],
    sensitivity: NDArray[np.float32],
    offset_e: NDArray[np.float32],
    scale_e: float,
    dark_e: float,
    well_e: float,
    read_noise_e: float,
    gain: float,
    black: float,
    ceiling: float,
    key: np.uint64,
    out: NDArray[np.uint16],
) -> None:
    """Expose a frame into ``out``, (n,) sensor numbers.

    Parameters
    ----------
    shown : (rows, cols) float32 array
        Light of the projector's panel.
    panel : (n, 2) float32 array
        Panel column and row that light each pixel.
    response : (n,) float32 array
        Radiance of each pixel per light of the panel.
    steady : (n,) float32 array
        Radiance from all other light.
    sensitivity : (n,) float32 array
        Of each pixel, about 1.
    offset_e : (n,) float32 array
        Fixed offset of each pixel, electrons.
    scale_e : float
        Electrons per radiance.
    dark_e : float
        Electrons that heat sets free.
    well_e : float
        Most electrons that a pixel holds.
    read_noise_e : float
        Standard deviation of the read-out.
    gain : float
        Sensor numbers per electron.
    black : float
        Sensor number of no light.
    ceiling : float
        Largest sensor number.
    key : uint64
        Of the frame's noise.
    out : (n,) uint8 or uint16 array
    """
    for n in prange(len(out)):
        light = steady[n] + response[n] * _look_up(shown, panel[n, 0], panel[n, 1])
        mean = max(light * scale_e * sensitivity[n] + dark_e, 0.0)
        counter = np.uint64(n) * _DRAWS
        noise = _normal(_uniform(key, counter)) * read_noise_e
        # Far above the well, the count does not matter.
        caught = well_e
        if mean < 4 * well_e:
            caught = min(_poisson(mean, key, counter + np.uint64(1)), well_e)
        number = math.floor((caught + noise + offset_e[n]) * gain + black + 0.5)
        out[n] = min(max(number, 0.0), ceiling)
