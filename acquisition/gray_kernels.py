"""Compiled loops of Gray decoding: words of bits from pictures, and cells from words.

Each has a plain NumPy reference in ``tests/acquisition``. Pictures come flat.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from acquisition.correspondence import Rejection

_BLOCK = 2048
_F = np.float32
# Holds every sample and every difference of two exactly.
_WIDE = np.float32
_LOW_MODULATION = int(Rejection.LOW_MODULATION)
_SATURATED = int(Rejection.SATURATED)


@njit(parallel=True, cache=True)
def read_bits(words, begin, first, first_threshold, second, second_threshold, both):  # type: ignore[no-untyped-def]
    """Append one bit, or two, to every pixel's word: 1 where a picture exceeds its threshold.

    Parameters
    ----------
    words : (pixels,) int32 array
    begin : bool
        Whether the words begin with this bit, whatever they are.
    first, second : (pixels,) uint8 or uint16 arrays
        Pictures of two bits, the more significant first.
    first_threshold, second_threshold : (pixels,) arrays
        Pictures of the inverse, or float32 levels.
    both : bool
        Whether the second bit counts.
    """
    pixels = words.size
    for number in prange((pixels + _BLOCK - 1) // _BLOCK):
        start = number * _BLOCK
        end = min(start + _BLOCK, pixels)
        word, m = words[start:end], end - start
        if begin:
            word[:] = 0
        bit, level = first[start:end], first_threshold[start:end]
        for j in range(m):
            word[j] = (word[j] << 1) | np.int32(bit[j] > level[j])
        if both:
            bit, level = second[start:end], second_threshold[start:end]
            for j in range(m):
                word[j] = (word[j] << 1) | np.int32(bit[j] > level[j])


@njit
def _weigh(low, next_low, bit, inverse):  # type: ignore[no-untyped-def]
    for j in range(low.size):
        contrast = abs(_WIDE(bit[j]) - _WIDE(inverse[j]))
        lowest, second = _WIDE(low[j]), _WIDE(next_low[j])
        larger = contrast if contrast > lowest else lowest
        next_low[j] = larger if larger < second else second
        low[j] = contrast if contrast < lowest else lowest


@njit(parallel=True, cache=True)
def weigh_bits(least, second_least, first, first_inverse, second, second_inverse, both):  # type: ignore[no-untyped-def]
    """Keep the two smallest contrasts of a pixel's bits.

    A cell's edge blurs one bit of a pixel at most: the second smallest contrast tells whether the
    word can be read.

    Parameters
    ----------
    least, second_least : (pixels,) arrays
        Smallest differences between a bit and its inverse so far, in the pictures' own type where
        that is one of whole numbers.
    first, first_inverse, second, second_inverse : (pixels,) arrays
        Two bits, and their inverses.
    both : bool
        Whether the second bit counts.
    """
    pixels = least.size
    for number in prange((pixels + _BLOCK - 1) // _BLOCK):
        start = number * _BLOCK
        end = min(start + _BLOCK, pixels)
        low, next_low = least[start:end], second_least[start:end]
        _weigh(low, next_low, first[start:end], first_inverse[start:end])
        if both:
            _weigh(low, next_low, second[start:end], second_inverse[start:end])


@njit(parallel=True, cache=True)
def light_of_bit(bit, inverse, ceiling, ambient, rejection):  # type: ignore[no-untyped-def]
    """Mean of a bit and its inverse, into ``ambient``, and bits where both are saturated."""
    pixels = ambient.size
    for number in prange((pixels + _BLOCK - 1) // _BLOCK):
        start = number * _BLOCK
        end = min(start + _BLOCK, pixels)
        a, b, m = bit[start:end], inverse[start:end], end - start
        level, flags = ambient[start:end], rejection[start:end]
        for j in range(m):
            level[j] = _F(0.5) * (_F(a[j]) + _F(b[j]))
        for j in range(m):
            dimmer = _F(a[j]) if a[j] < b[j] else _F(b[j])
            flags[j] |= np.uint16(_SATURATED) if dimmer >= ceiling else np.uint16(0)


@njit(inline="always")
def _cell(word: np.int32) -> np.int32:
    word ^= word >> 16
    word ^= word >> 8
    word ^= word >> 4
    word ^= word >> 2
    return word ^ (word >> 1)


@njit(parallel=True, cache=True)
def gray_to_cell(words: NDArray[np.int32]) -> NDArray[np.int32]:
    """Binary cell number of every Gray word."""
    cells = np.empty_like(words)
    flat, out = words.reshape(-1), cells.reshape(-1)
    pixels = flat.size
    for number in prange((pixels + _BLOCK - 1) // _BLOCK):
        start = number * _BLOCK
        word, cell = flat[start : start + _BLOCK], out[start : start + _BLOCK]
        for j in range(word.size):
            cell[j] = _cell(word[j])
    return cells


@njit(parallel=True, cache=True)
def cell_centres(words, first, step, out):  # type: ignore[no-untyped-def]
    """Coordinate ``first + step * cell`` of every Gray word, into ``out``."""
    pixels = words.size
    for number in prange((pixels + _BLOCK - 1) // _BLOCK):
        start = number * _BLOCK
        word, centre = words[start : start + _BLOCK], out[start : start + _BLOCK]
        for j in range(word.size):
            centre[j] = first + step * _cell(word[j])


@njit(parallel=True, cache=True)
def judge_words(  # type: ignore[no-untyped-def]
    second_least, ambient, read, gain, black, contrast, least, modulation, rejection
):
    """Modulation of a Gray code, and the rejection's bit where it is low.

    ``modulation`` receives half the second smallest contrast; it is low below ``least``, or below
    ``contrast`` standard deviations, for samples of variance
    ``read + gain * max(level - black, 0)``.
    """
    pixels = second_least.size
    for number in prange((pixels + _BLOCK - 1) // _BLOCK):
        start = number * _BLOCK
        end = min(start + _BLOCK, pixels)
        low, level, m = second_least[start:end], ambient[start:end], end - start
        half, bits = modulation[start:end], rejection[start:end]
        for j in range(m):
            half[j] = _F(0.5) * _F(low[j])
        for j in range(m):
            # Half a difference of two samples has half their variance.
            light = level[j] - black if level[j] > black else 0.0
            noise = _F(0.5) * (read + gain * light)
            dim = half[j] * half[j] <= contrast * contrast * noise or half[j] <= least
            bits[j] |= np.uint16(_LOW_MODULATION) if dim else np.uint16(0)
