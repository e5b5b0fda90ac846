"""Compiled per-pixel loops of decoding; :mod:`acquisition.decoding` decides what they are run on.

Each has a plain NumPy reference in ``tests/acquisition``. Frames come as a stack
``(steps, rows, cols)`` of sensor numbers; rows are shared among threads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

TWO_PI = 2 * math.pi


@njit(parallel=True, cache=True, fastmath={"contract", "reassoc"})
def fit_fringe(
    stack: NDArray[np.uint8] | NDArray[np.uint16],
    solution: NDArray[np.float64],
    origin_turns: float,
    read_variance: float,
    gain: float,
    saturation: int,
    turns: NDArray[np.float32],
    variance: NDArray[np.float32],
    modulation: NDArray[np.float32],
    ambient: NDArray[np.float32],
    saturated: NDArray[np.bool_],
) -> None:
    """Fit ``A + B cos(φ + shift)`` to every pixel and write phase, variance, B and A.

    ``solution`` (3, steps) is the pseudo-inverse that takes samples to (A, B cos φ, -B sin φ).
    ``turns`` receives (φ/2π - origin) in [0, 1), ``variance`` its variance for samples of variance
    ``read_variance + gain * value``.
    """
    steps, rows, cols = stack.shape
    for row in prange(rows):
        for col in range(cols):
            a = 0.0
            c = 0.0
            s = 0.0
            top = 0
            for step in range(steps):
                value = stack[step, row, col]
                if value > top:
                    top = value
                a += solution[0, step] * value
                c += solution[1, step] * value
                s -= solution[2, step] * value
            amplitude = math.sqrt(c * c + s * s)
            ambient[row, col] = a
            modulation[row, col] = amplitude
            if top >= saturation:
                saturated[row, col] = True
            if amplitude == 0.0:
                turns[row, col] = 0.0
                variance[row, col] = np.inf
                continue
            # dφ = (cos φ ds - sin φ dc) / B, with dc, ds linear in the samples.
            cos_phase = c / amplitude
            sin_phase = s / amplitude
            sum_variance = 0.0
            for step in range(steps):
                slope = cos_phase * solution[2, step] + sin_phase * solution[1, step]
                sum_variance += slope * slope * (read_variance + gain * stack[step, row, col])
            turn = math.atan2(s, c) / TWO_PI - origin_turns
            turns[row, col] = turn - math.floor(turn)
            variance[row, col] = sum_variance / (amplitude * amplitude * TWO_PI * TWO_PI)


@njit(parallel=True, cache=True)
def shift_in_bit(
    code: NDArray[np.int32],
    bit_frame: NDArray[np.uint8] | NDArray[np.uint16],
    threshold: NDArray[np.float32],
) -> None:
    """Append one bit, ``bit_frame > threshold``, to every pixel's Gray word."""
    rows, cols = code.shape
    for row in prange(rows):
        for col in range(cols):
            bit = 1 if bit_frame[row, col] > threshold[row, col] else 0
            code[row, col] = (code[row, col] << 1) | bit


@njit(parallel=True, cache=True)
def gray_to_cell(code: NDArray[np.int32]) -> NDArray[np.int32]:
    """Binary cell number of every Gray word."""
    rows, cols = code.shape
    cell = np.empty_like(code)
    for row in prange(rows):
        for col in range(cols):
            word = code[row, col]
            shift = 16
            while shift > 0:
                word ^= word >> shift
                shift >>= 1
            cell[row, col] = word
    return cell


@njit(parallel=True, cache=True)
def unwrap(
    turns: NDArray[np.float32],
    variance: NDArray[np.float32],
    coarse: NDArray[np.float64],
    coarse_variance: NDArray[np.float32],
    period: float,
    half_width: float,
    sigmas: float,
    coordinate: NDArray[np.float64],
    contradicts: NDArray[np.bool_],
) -> None:
    """Coordinate of the fringe order nearest to a coarse coordinate.

    A pixel contradicts its coarse coordinate if the two differ by more than ``half_width`` plus
    ``sigmas`` standard deviations.
    """
    rows, cols = turns.shape
    for row in prange(rows):
        for col in range(cols):
            near = coarse[row, col]
            order = math.floor(near / period - turns[row, col] + 0.5)
            fine = period * (order + turns[row, col])
            coordinate[row, col] = fine
            spread = math.sqrt(period * period * variance[row, col] + coarse_variance[row, col])
            if not abs(fine - near) <= half_width + sigmas * spread:
                contradicts[row, col] = True
