"""Compiled loops over what is left of a picture when all its fringes are decoded.

Pictures come flat.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from acquisition.correspondence import Rejection

# Not a rejection yet: the neighbours have the last word.
UNCERTAIN_ORDER = 1 << 15
_OUT_OF_RANGE = int(Rejection.OUT_OF_RANGE)
_WRONG_ORDER = int(Rejection.WRONG_ORDER)
PROVISIONAL = UNCERTAIN_ORDER | _OUT_OF_RANGE
_BLOCK = 512
_ZERO = np.float32(0)


@njit(parallel=True, cache=True)
def subtract_series(near, period, origin_turns, series):  # type: ignore[no-untyped-def]
    """Subtract a Fourier series in the phase of a coordinate from it, in place.

    ``series`` (harmonics, 3) holds order, cosine and sine, the latter two in turns of the raw phase
    ``near / period + origin_turns``.
    """
    for j in prange(near.size):
        angle = 2 * np.pi * (near[j] / period + origin_turns)
        error = 0.0
        for row in range(len(series)):
            at = series[row, 0] * angle
            error += series[row, 1] * np.cos(at) + series[row, 2] * np.sin(at)
        near[j] -= period * error


@njit(parallel=True, cache=True)
def mask_rejected(rejection, coordinate, variance, provisional):  # type: ignore[no-untyped-def]
    """Where a pixel is rejected, set its coordinate to NaN and its variance to infinity.

    Parameters
    ----------
    rejection : (pixels,) uint16 array
    coordinate, variance : (pixels,) arrays
        Changed in place.
    provisional : int
        Bits that are no reason yet.

    Returns
    -------
    int, int
        Pixels that are not rejected, and those with a provisional bit among them.
    """
    accepted, unsettled = 0, 0
    settled = np.uint16(~provisional & 0xFFFF)
    pixels = rejection.size
    for number in prange((pixels + _BLOCK - 1) // _BLOCK):
        start = number * _BLOCK
        m = min(_BLOCK, pixels - start)
        bits = rejection[start : start + m]
        some = np.uint16(0)
        for j in range(m):
            some |= bits[j]
        good, odd = m, 0
        if some:
            for j in range(m):
                if bits[j] & settled:
                    coordinate[start + j] = np.nan
                    variance[start + j] = np.inf
                    good -= 1
                elif bits[j]:
                    odd += 1
        accepted += good
        unsettled += odd
    return accepted, unsettled


@njit(parallel=True, cache=True)
def begin_pictures(ambient, rejection):  # type: ignore[no-untyped-def]
    """No light, and nothing rejected."""
    for j in prange(ambient.size):
        ambient[j] = _ZERO
        rejection[j] = np.uint16(0)


@njit(parallel=True, cache=True)
def settle(rejection, wrong):  # type: ignore[no-untyped-def]
    """Clear the provisional bits in place, and reject the orders that are ``wrong`` (pixels,)."""
    settled = np.uint16(~PROVISIONAL & 0xFFFF)
    for j in prange(rejection.size):
        bits = rejection[j] & settled
        rejection[j] = bits | np.uint16(_WRONG_ORDER) if wrong[j] else bits


@njit(parallel=True, cache=True)
def flag_outside(coordinate, extent, rejection):  # type: ignore[no-untyped-def]
    """Add the rejection's bit where a coordinate lies off a panel of ``extent`` pixels."""
    for j in prange(rejection.size):
        if coordinate[j] < -0.5 or coordinate[j] > extent - 0.5:
            rejection[j] |= np.uint16(_OUT_OF_RANGE)
