r"""Compiled loops of fringe decoding; :mod:`acquisition.decoding` decides what they are run on.

Each has a plain NumPy reference in ``tests/acquisition``. Pictures come flat, and are worked on in
blocks that stay in the innermost cache: every memory location is read and written once per group
of four steps, and every loop is simple enough to be vectorised. Within a block all quantities are
float32. That suffices: samples enter as differences from the fringe's first frame, which are exact
whole numbers, and what rounding adds to a phase is below 10⁻⁶ of a turn (noise of a phase is some
10⁻³). Only the final coordinate, some thousands of pixels long, is float64.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from acquisition.correspondence import Rejection
from acquisition.rejection_kernels import UNCERTAIN_ORDER

# No "nnan" or "ninf": what is not finite must stay so.
_FAST = {"contract", "reassoc", "nsz", "arcp"}
_BLOCK = 2048

_F = np.float32
_ZERO, _HALF, _ONE, _QUARTER, _TINY = _F(0), _F(0.5), _F(1), _F(0.25), _F(1e-30)
_TWO_PI, _FOUR = _F(2 * np.pi), _F(4)
_MARGIN, _STEEPNESS = _F(1.1), _F(11 * (2 * np.pi) ** 2)

# atan(x)/2π ≈ x Σ c_i x^2i on [0, 1] to 4e-8 of a turn: weighted least squares, exchanged until
# the error ripples evenly.
_ATAN = (
    0.15915432410965719,
    -0.053026236060591425,
    0.03152510412646911,
    -0.021061477567092642,
    0.012672438684393654,
    -0.0053482302980196565,
    0.0010841163681056653,
)
_T0, _T1, _T2, _T3, _T4, _T5, _T6 = (_F(c) for c in _ATAN)

# Rows of a block's working array.
_A, _C, _S, _SQUARES, _TOP = range(5)
_TURN, _VARIANCE, _MODULATION, _MISFIT, _FLAGS = range(5, 10)
_WORKING_ROWS = 10
# Rows no longer wanted once a fringe is fitted.
_ORDER, _FINE, _PULL = _SQUARES, _TOP, _C
SUMS = 5  # of these, what is kept between groups of steps: A, c, s, squares, top

_LOW_MODULATION = int(Rejection.LOW_MODULATION)
_SATURATED = int(Rejection.SATURATED)
_WRONG_ORDER = int(Rejection.WRONG_ORDER)
_OUT_OF_RANGE = int(Rejection.OUT_OF_RANGE)
_MIXED_LIGHT = int(Rejection.MIXED_LIGHT)


@njit(inline="always")
def _turn(c: np.float32, s: np.float32) -> np.float32:
    """Angle of (c, s) in turns, in [0, 1]."""
    across, up = abs(c), abs(s)
    low = up if up < across else across
    high = across if up < across else up
    x = low / (high + _TINY)
    z = x * x
    even = _T3 + z * (_T4 + z * (_T5 + z * _T6))
    turn = x * (_T0 + z * (_T1 + z * (_T2 + z * even)))
    turn = _QUARTER - turn if up > across else turn
    turn = _HALF - turn if c < _ZERO else turn
    return _ONE - turn if s < _ZERO else turn


@njit(fastmath=_FAST, error_model="numpy")
def _fold_block(block, m, first, frames, weights, reference):  # type: ignore[no-untyped-def]
    """Add four steps to a block's A, c, s, sum of squares, and largest sample."""
    frame0, frame1, frame2, frame3 = frames
    a0, a1, a2, a3 = weights[0, 0], weights[0, 1], weights[0, 2], weights[0, 3]
    c0, c1, c2, c3 = weights[1, 0], weights[1, 1], weights[1, 2], weights[1, 3]
    s0, s1, s2, s3 = weights[2, 0], weights[2, 1], weights[2, 2], weights[2, 3]
    if first:
        for j in range(m):
            r = _F(reference[j])
            u0, u1 = _F(frame0[j]) - r, _F(frame1[j]) - r
            u2, u3 = _F(frame2[j]) - r, _F(frame3[j]) - r
            block[_A, j] = a0 * u0 + a1 * u1 + a2 * u2 + a3 * u3 + r
            block[_C, j] = c0 * u0 + c1 * u1 + c2 * u2 + c3 * u3
            block[_S, j] = s0 * u0 + s1 * u1 + s2 * u2 + s3 * u3
            block[_SQUARES, j] = u0 * u0 + u1 * u1 + u2 * u2 + u3 * u3
            low = u0 if u0 > u1 else u1
            high = u2 if u2 > u3 else u3
            block[_TOP, j] = r + (low if low > high else high)
        return
    for j in range(m):
        r = _F(reference[j])
        u0, u1 = _F(frame0[j]) - r, _F(frame1[j]) - r
        u2, u3 = _F(frame2[j]) - r, _F(frame3[j]) - r
        block[_A, j] += a0 * u0 + a1 * u1 + a2 * u2 + a3 * u3
        block[_C, j] += c0 * u0 + c1 * u1 + c2 * u2 + c3 * u3
        block[_S, j] += s0 * u0 + s1 * u1 + s2 * u2 + s3 * u3
        block[_SQUARES, j] += u0 * u0 + u1 * u1 + u2 * u2 + u3 * u3
        low = u0 if u0 > u1 else u1
        high = u2 if u2 > u3 else u3
        top = r + (low if low > high else high)
        block[_TOP, j] = top if top > block[_TOP, j] else block[_TOP, j]


@njit(fastmath=_FAST, error_model="numpy")
def _vary_with_phase(block, m, moments, read, gain, black):  # type: ignore[no-untyped-def]
    """Modulation, and the phase's variance for any steps."""
    m00, m01, m02 = moments[0, 0], moments[0, 1], moments[0, 2]
    m10, m11, m12 = moments[1, 0], moments[1, 1], moments[1, 2]
    m20, m21, m22 = moments[2, 0], moments[2, 1], moments[2, 2]
    for j in range(m):
        a, c, s = block[_A, j], block[_C, j], block[_S, j]
        power = c * c + s * s + _TINY
        inverse = _ONE / power
        cc, cs, ss = c * c * inverse, c * s * inverse, s * s * inverse
        flat = m00 * cc + m01 * cs + m02 * ss
        light = (a - black) * flat + c * (m10 * cc + m11 * cs + m12 * ss)
        light += s * (m20 * cc + m21 * cs + m22 * ss)
        light = light if light > _ZERO else _ZERO
        block[_VARIANCE, j] = (read * flat + gain * light) * inverse
        block[_MODULATION, j] = np.sqrt(power)


@njit(fastmath=_FAST, error_model="numpy")
def _fit_block(block, m, reference, fringe, sample):  # type: ignore[no-untyped-def]
    """Phase, its variance, modulation and flags of a block of folded steps."""
    read, gain, black = sample.read, sample.gain, sample.black
    if fringe.isotropic:
        # The same at every phase, and by any light: even steps, four or more.
        even = fringe.moments[0, 0]
        for j in range(m):
            a, c, s = block[_A, j], block[_C, j], block[_S, j]
            power = c * c + s * s + _TINY
            light = a - black if a > black else _ZERO
            block[_VARIANCE, j] = even * (read + gain * light) / power
            block[_MODULATION, j] = np.sqrt(power)
    else:
        _vary_with_phase(block, m, fringe.moments, read, gain, black)
    for j in range(m):
        turn = _turn(block[_C, j], block[_S, j]) - fringe.origin_turns
        block[_TURN, j] = turn - np.floor(turn)
    gram = fringe.gram
    g00, g01, g02 = gram[0, 0], gram[0, 1] + gram[1, 0], gram[0, 2] + gram[2, 0]
    g11, g12, g22 = gram[1, 1], gram[1, 2] + gram[2, 1], gram[2, 2]
    limit, harmonics2 = fringe.squares_limit, fringe.harmonics * fringe.harmonics
    floor, contrast2 = sample.least * sample.least, sample.contrast * sample.contrast
    for j in range(m):
        a, c, s = block[_A, j], block[_C, j], block[_S, j]
        u = a - _F(reference[j])
        explained = u * (g00 * u + g01 * c + g02 * s) + c * (g11 * c + g12 * s) + g22 * s * s
        left = block[_SQUARES, j] - explained
        noise = read + gain * (a - black if a > black else _ZERO)
        b = block[_MODULATION, j]
        low = b * b <= floor + contrast2 * noise or b * b <= _TINY + _TINY
        # Whether √left > √(limit noise) + harmonics b, without the roots.
        by_noise, by_harmonics = limit * noise, harmonics2 * b * b
        beyond = left - by_noise - by_harmonics
        mixed = beyond > _ZERO and beyond * beyond > _FOUR * by_noise * by_harmonics
        flags = _F(_LOW_MODULATION) if low else _ZERO
        flags += _F(_MIXED_LIGHT) if mixed else _ZERO
        flags += _F(_SATURATED) if block[_TOP, j] >= sample.saturation else _ZERO
        block[_MISFIT, j] = left if left > _ZERO else _ZERO
        block[_FLAGS, j] = flags


@njit(fastmath=_FAST, error_model="numpy")
def _correct_block(block, m, series):  # type: ignore[no-untyped-def]
    """Subtract a Fourier series in the raw phase from a block's phases, and stretch their noise."""
    # Rows that unwrapping fills later: what is subtracted, and its derivative.
    for j in range(m):
        block[_ORDER, j] = _ZERO
        block[_FINE, j] = _ONE
    for row in range(series.shape[0]):
        times = int(series[row, 0])
        cosine, sine = series[row, 1], series[row, 2]
        steepness = _TWO_PI * _F(times)
        for j in range(m):
            inverse = _ONE / (block[_MODULATION, j] + _TINY)
            c, s = block[_C, j] * inverse, block[_S, j] * inverse
            x, y = _ONE, _ZERO
            for _ in range(times):
                x, y = x * c - y * s, x * s + y * c
            block[_ORDER, j] += cosine * x + sine * y
            block[_FINE, j] -= steepness * (sine * x - cosine * y)
    for j in range(m):
        turn = block[_TURN, j] - block[_ORDER, j]
        block[_TURN, j] = turn - np.floor(turn)
        block[_VARIANCE, j] *= block[_FINE, j] * block[_FINE, j]


@njit(fastmath=_FAST, error_model="numpy")
def _unwrap_block(block, m, step, near, variance, rejection):  # type: ignore[no-untyped-def]
    """Order nearest to the coarse coordinate, what both give together, and their contradictions.

    From here on the block holds the variance of the coordinate, not of the phase.
    """
    period = _F(step.period)
    square = period * period
    inverse = _ONE / period
    sigmas2, mixed2 = step.sigmas * step.sigmas, step.mixed_sigmas * step.mixed_sigmas
    certain2 = step.certain_sigmas * step.certain_sigmas
    borne_out2, reach2 = step.borne_out_sigmas * step.borne_out_sigmas, step.reach * step.reach
    for j in range(m):
        turn = block[_TURN, j]
        order = np.floor(near[j] * inverse - turn + _HALF)
        fine = period * (order + turn)
        block[_ORDER, j] = order
        block[_FINE, j] = fine
        own = square * block[_VARIANCE, j]
        joint = own + variance[j]
        apart = abs(fine - near[j]) - step.half_width
        apart2 = apart * apart if apart > _ZERO else _ZERO
        # The spread follows from a modulation that is itself uncertain by the phase's noise s, and
        # those who pass a limit on it are the overrated: (1 + s)² allows for one standard
        # deviation, and 1.1 + 11 s² is no less.
        rated = joint * (_MARGIN + _STEEPNESS * block[_VARIANCE, j])
        certain = certain2 * rated <= reach2
        # Written so that what is not a number contradicts.
        wrong = not (apart2 <= sigmas2 * joint and borne_out2 * rated <= reach2)
        flags = _F(_WRONG_ORDER) if wrong else _ZERO
        flags += _ZERO if certain else _F(UNCERTAIN_ORDER)
        flags += _F(_MIXED_LIGHT) if apart2 > mixed2 * joint else _ZERO
        block[_MISFIT, j] = flags
        # What the coarse coordinate adds to the fine one, by inverse variance.
        share = own / (joint + step.systematic) if certain else _ZERO
        block[_PULL, j] = share * (near[j] - fine)
        block[_VARIANCE, j] = own - share * own
    for j in range(m):
        both = np.int32(block[_FLAGS, j]) | np.int32(block[_MISFIT, j])
        rejection[j] |= np.uint16(both)


@njit(fastmath=_FAST, error_model="numpy")
def _begin_block(sums, start, m):  # type: ignore[no-untyped-def]
    """Working array of a block, with the sums so far (none: ``sums`` of no columns)."""
    block = np.empty((_WORKING_ROWS, _BLOCK), np.float32)
    if sums.shape[1]:
        for k in range(SUMS):
            kept = sums[k, start : start + m]
            for j in range(m):
                block[k, j] = kept[j]
    return block


@njit(fastmath=_FAST, error_model="numpy")
def _folded(frames, weights, reference, sums, start, m):  # type: ignore[no-untyped-def]
    """Working array of a block after four more steps."""
    block = _begin_block(sums, start, m)
    end = start + m
    parts = (
        frames[0][start:end],
        frames[1][start:end],
        frames[2][start:end],
        frames[3][start:end],
    )
    _fold_block(block, m, sums.shape[1] == 0, parts, weights, reference[start:end])
    return block


@njit(parallel=True, cache=True, fastmath=_FAST, error_model="numpy")
def fold_steps(frames, weights, reference, sums, out):  # type: ignore[no-untyped-def]
    """Add four steps of a fringe to its sums.

    Parameters
    ----------
    frames : tuple of four (pixels,) uint8 or uint16 arrays
        A fringe of fewer steps is filled up with its reference.
    weights : (3, 4) float32 array
        What the steps add to A, c and s.
    reference : (pixels,) uint8 or uint16 array
        First frame of the fringe.
    sums : (5, pixels) float32 array
        Sums so far; (5, 0) for the first group of steps.
    out : (5, pixels) float32 array
        Receives the sums; may be ``sums``.
    """
    pixels = reference.size
    for number in prange((pixels + _BLOCK - 1) // _BLOCK):
        start = number * _BLOCK
        m = min(_BLOCK, pixels - start)
        block = _folded(frames, weights, reference, sums, start, m)
        for k in range(SUMS):
            kept = out[k, start : start + m]
            for j in range(m):
                kept[j] = block[k, j]


@njit(parallel=True, cache=True, fastmath=_FAST, error_model="numpy")
def fit_fringe(frames, weights, reference, sums, fringe, sample, out, flags):  # type: ignore[no-untyped-def]
    """Fit a fringe whose last steps are given: its phase and what goes with it.

    Parameters
    ----------
    frames, weights, reference, sums
        The last group of steps, as of :func:`fold_steps`.
    fringe : FringeModel
    sample : SampleModel
    out : (5, pixels) float32 array
        Receives phase in turns, [0, 1]; its variance; modulation; mean level; and the sum of
        squared residuals.
    flags : (pixels,) uint16 array
        Receives :class:`~acquisition.correspondence.Rejection` bits.
    """
    pixels = reference.size
    for number in prange((pixels + _BLOCK - 1) // _BLOCK):
        start = number * _BLOCK
        m = min(_BLOCK, pixels - start)
        block = _folded(frames, weights, reference, sums, start, m)
        _fit_block(block, m, reference[start : start + m], fringe, sample)
        if len(fringe.correction):
            _correct_block(block, m, fringe.correction)
        for k, row in enumerate((_TURN, _VARIANCE, _MODULATION, _A, _MISFIT)):
            kept = out[k, start : start + m]
            for j in range(m):
                kept[j] = block[row, j]
        bits = flags[start : start + m]
        for j in range(m):
            bits[j] = np.uint16(block[_FLAGS, j])


@njit(fastmath=_FAST, error_model="numpy")
def _advance_block(block, m, start, step, state):  # type: ignore[no-untyped-def]
    """Unwrap a block, and leave what it decodes to in the axis's pictures."""
    end = start + m
    near, spread = state.near[start:end], state.variance[start:end]
    flags = state.rejection[start:end]
    if step.first:
        for j in range(m):
            near[j] = step.centre
            spread[j] = _ZERO
    _unwrap_block(block, m, step, near, spread, flags)
    for j in range(m):
        spread[j] = block[_VARIANCE, j]
    if not state.coordinate.size:
        for j in range(m):
            near[j] = block[_FINE, j] + block[_PULL, j]
        return
    period, low, high = step.period, -_HALF, _F(step.extent) - _HALF
    final, contrast = state.coordinate[start:end], state.modulation[start:end]
    level = state.ambient[start:end]
    for j in range(m):
        level[j] += block[_A, j]
    for j in range(m):
        fine = period * (np.float64(block[_ORDER, j]) + np.float64(block[_TURN, j]))
        final[j] = fine + np.float64(block[_PULL, j])
    for j in range(m):
        contrast[j] = block[_MODULATION, j]
    for j in range(m):
        inside = block[_FINE, j] >= low and block[_FINE, j] <= high
        flags[j] |= np.uint16(0) if inside else np.uint16(_OUT_OF_RANGE)


@njit(parallel=True, cache=True, fastmath=_FAST, error_model="numpy")
def advance(frames, weights, reference, sums, fringe, sample, step, state):  # type: ignore[no-untyped-def]
    """Fit a fringe whose last steps are given, and unwrap it by an axis's coordinate so far.

    Parameters
    ----------
    frames, weights, reference, sums, fringe, sample
        As of :func:`fit_fringe`.
    step : UnwrapStep
    state : AxisState
        Changed in place.
    """
    pixels = reference.size
    for number in prange((pixels + _BLOCK - 1) // _BLOCK):
        start = number * _BLOCK
        m = min(_BLOCK, pixels - start)
        block = _folded(frames, weights, reference, sums, start, m)
        _fit_block(block, m, reference[start : start + m], fringe, sample)
        if len(fringe.correction):
            _correct_block(block, m, fringe.correction)
        _advance_block(block, m, start, step, state)


@njit(parallel=True, cache=True, fastmath=_FAST, error_model="numpy")
def advance_fitted(fitted, flags, step, state):  # type: ignore[no-untyped-def]
    """Unwrap a fringe that :func:`fit_fringe` has fitted, as :func:`advance` does."""
    pixels = flags.size
    for number in prange((pixels + _BLOCK - 1) // _BLOCK):
        start = number * _BLOCK
        m = min(_BLOCK, pixels - start)
        block = np.empty((_WORKING_ROWS, _BLOCK), np.float32)
        for k, row in enumerate((_TURN, _VARIANCE, _MODULATION, _A)):
            kept = fitted[k, start : start + m]
            for j in range(m):
                block[row, j] = kept[j]
        bits = flags[start : start + m]
        for j in range(m):
            block[_FLAGS, j] = _F(bits[j])
        _advance_block(block, m, start, step, state)


@njit(parallel=True, cache=True)
def merge_exposures(fitted, flags, shorter, shorter_flags, scale):  # type: ignore[no-untyped-def]
    """Join the fits of a fringe at two exposures: phases by inverse variance, in ``fitted``.

    A saturated exposure counts only where both are, and one of low modulation only where the
    other is no better. Levels stay those of the longer exposure, or become the shorter one's
    times ``scale``.

    Parameters
    ----------
    fitted, flags
        Of the longer exposure, as of :func:`fit_fringe`; replaced.
    shorter, shorter_flags
        Of the shorter exposure.
    scale : float
        Ratio of the exposures.
    """
    pixels = flags.size
    for number in prange((pixels + _BLOCK - 1) // _BLOCK):
        for j in range(number * _BLOCK, min((number + 1) * _BLOCK, pixels)):
            mine, other = flags[j], shorter_flags[j]
            if other & _SATURATED or (other & _LOW_MODULATION and not mine & _SATURATED):
                continue
            if mine & (_SATURATED | _LOW_MODULATION):
                fitted[0, j], fitted[1, j] = shorter[0, j], shorter[1, j]
                fitted[2, j], fitted[3, j] = scale * shorter[2, j], scale * shorter[3, j]
                flags[j] = other
                continue
            apart = shorter[0, j] - fitted[0, j]
            apart -= np.round(apart)
            total = fitted[1, j] + shorter[1, j]
            turn = fitted[0, j] + apart * fitted[1, j] / total
            fitted[0, j] = turn - np.floor(turn)
            fitted[1, j] = fitted[1, j] * shorter[1, j] / total
            flags[j] = mine | other
