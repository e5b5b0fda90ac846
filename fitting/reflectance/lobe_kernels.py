"""Compiled sums behind variable projection: one lobe, three colour channels.

For given lobe parameters the model is linear in ρ_d and ρ_s, so that every quantity of a
Levenberg-Marquardt step (cost, gradient, the Hessian of Gauss and Newton with the linear part
projected out: Golub and Pereyra 1973, Kaufman 1975) follows from a few sums over the samples.
Each kernel has a plain NumPy reference in ``tests/fitting/reflectance``.

Layout: ``weight[c, i]`` is u cos²θ w / σ² of channel c and sample i (u: the robust weight),
``target[c, i]`` is u cos θ w y / σ², with y the radiance over the irradiance at normal incidence.
``axes[0..2, i]`` is −v_x l_x, −v_y l_y, v_z l_z. Lobe parameters are (ln k, ln r, ln c) with
r = C_z / |C_x| and c = C_y / C_x, and ρ_s is the highlight's value at normal incidence seen
head-on: (d / r)**k with d = −v_x l_x − c v_y l_y + r v_z l_z.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fitting.reflectance.elementary_functions import vector_exp, vector_log

PARAMETERS = 3
CHANNELS = 3
_SMALLEST_BASE = 1e-30
_LARGEST_EXPONENT = 250.0
_NO_LIMIT = 1e100  # instead of an infinite one, which has no quotients
_SUMS = {"reassoc", "contract", "nsz", "arcp"}
Floats = NDArray[np.float64]


class Workspace(NamedTuple):
    """Buffers of one texel's fit, reused from texel to texel.

    Attributes
    ----------
    axes : (3, n) array
        Products of directions, see above.
    rows : (6, n) array
        cos θ √w / σ and y √w / σ per channel.
    weight, target : (3, n) array
    lobe : (n,) array
        The lobe at the samples.
    slopes : (3, n) array
        Its derivatives by ln k, ln r, ln c.
    sums : (3, 5) array
    by_column : (3, 3, 3) array
    by_slope : (3, 3, 3) array
    gradient : (3,) array
    hessian : (3, 3) array
        Lower triangle.
    """

    axes: Floats
    rows: Floats
    weight: Floats
    target: Floats
    lobe: Floats
    slopes: Floats
    sums: Floats
    by_column: Floats
    by_slope: Floats
    gradient: Floats
    hessian: Floats


@njit(cache=True)
def make_workspace(samples: int) -> Workspace:
    """Room for a texel of that many samples."""
    return Workspace(
        np.empty((3, samples)),
        np.empty((2 * CHANNELS, samples)),
        np.empty((CHANNELS, samples)),
        np.empty((CHANNELS, samples)),
        np.empty(samples),
        np.empty((PARAMETERS, samples)),
        np.empty((CHANNELS, 5)),
        np.zeros((CHANNELS, PARAMETERS, 3)),
        np.zeros((CHANNELS, PARAMETERS, PARAMETERS)),
        np.zeros(PARAMETERS),
        np.zeros((PARAMETERS, PARAMETERS)),
    )


@njit(cache=True, error_model="numpy")
def evaluate_lobe(axes: Floats, n: int, theta: Floats, lobe: Floats, slopes: Floats) -> None:
    """Fill the lobe and its derivatives by ln k, ln r and ln c at ``n`` samples."""
    k = math.exp(theta[0])
    r = math.exp(theta[1])
    c = math.exp(theta[2])
    ln_r = theta[1]
    # Several short loops: the compiler turns a loop into vector instructions only if it can tell
    # at little cost that the arrays in it do not overlap.
    for i in range(n):
        d = axes[0, i] + c * axes[1, i] + r * axes[2, i]
        lobe[i] = d if d > _SMALLEST_BASE else _SMALLEST_BASE
    for i in range(n):
        slopes[0, i] = k * (vector_log(lobe[i]) - ln_r)
    for i in range(n):
        exponent = slopes[0, i]
        held = min(max(exponent, -_LARGEST_EXPONENT), _LARGEST_EXPONENT)
        slopes[1, i] = vector_exp(held) if lobe[i] > _SMALLEST_BASE else 0.0
    for i in range(n):
        # Beyond the range of exponents the lobe is held, and does not change.
        rise = slopes[1, i] if abs(slopes[0, i]) < _LARGEST_EXPONENT else 0.0
        slopes[2, i] = rise * k / lobe[i]
        slopes[0, i] *= rise
    for i in range(n):
        by_base = slopes[2, i]
        b = slopes[1, i]
        slopes[1, i] = by_base * (r * axes[2, i] - lobe[i])
        lobe[i] = b
    for i in range(n):
        slopes[2, i] *= c * axes[1, i]


@njit(cache=True, fastmath=_SUMS, error_model="numpy")
def sum_columns(weight: Floats, target: Floats, lobe: Floats, n: int, sums: Floats) -> None:
    """Per channel: Σw, Σwb, Σwb², Σt, Σtb."""
    for c in range(CHANNELS):
        w_1 = 0.0
        t_1 = 0.0
        for i in range(n):
            w_1 += weight[c, i]
            t_1 += target[c, i]
        sums[c, 0] = w_1
        sums[c, 3] = t_1
    sum_lobe(weight, target, lobe, n, sums)


@njit(cache=True, fastmath=_SUMS, error_model="numpy")
def sum_lobe(weight: Floats, target: Floats, lobe: Floats, n: int, sums: Floats) -> None:
    """The sums of :func:`sum_columns` that depend on the lobe: Σwb, Σwb², Σtb."""
    # All channels in one pass: their sums do not wait for one another.
    w_b0 = w_b1 = w_b2 = 0.0
    w_bb0 = w_bb1 = w_bb2 = 0.0
    t_b0 = t_b1 = t_b2 = 0.0
    for i in range(n):
        b = lobe[i]
        wb0 = weight[0, i] * b
        wb1 = weight[1, i] * b
        wb2 = weight[2, i] * b
        w_b0 += wb0
        w_b1 += wb1
        w_b2 += wb2
        w_bb0 += wb0 * b
        w_bb1 += wb1 * b
        w_bb2 += wb2 * b
        t_b0 += target[0, i] * b
        t_b1 += target[1, i] * b
        t_b2 += target[2, i] * b
    sums[0, 1] = w_b0
    sums[1, 1] = w_b1
    sums[2, 1] = w_b2
    sums[0, 2] = w_bb0
    sums[1, 2] = w_bb1
    sums[2, 2] = w_bb2
    sums[0, 4] = t_b0
    sums[1, 4] = t_b1
    sums[2, 4] = t_b2


@njit(cache=True, fastmath=_SUMS, error_model="numpy")
def sum_slopes(
    weight: Floats,
    target: Floats,
    lobe: Floats,
    slopes: Floats,
    n: int,
    free: int,
    by_column: Floats,
    by_slope: Floats,
) -> None:
    """Per channel and parameter p: Σw s_p, Σwb s_p, Σt s_p and Σw s_p s_q for q ≤ p."""
    for c in range(CHANNELS):
        for p in range(free):
            w_s = 0.0
            wb_s = 0.0
            t_s = 0.0
            w_ss = 0.0
            w_s0 = 0.0
            w_s1 = 0.0
            for i in range(n):
                s = slopes[p, i]
                ws = weight[c, i] * s
                w_s += ws
                wb_s += ws * lobe[i]
                t_s += target[c, i] * s
                w_ss += ws * s
                w_s0 += ws * slopes[0, i]
                w_s1 += ws * slopes[1, i]
            by_column[c, p, 0] = w_s
            by_column[c, p, 1] = wb_s
            by_column[c, p, 2] = t_s
            if p > 0:
                by_slope[c, p, 0] = w_s0
            if p > 1:
                by_slope[c, p, 1] = w_s1
            by_slope[c, p, p] = w_ss


@njit(cache=True, error_model="numpy")
def solve_channel(
    a_dd: float, a_ds: float, a_ss: float, t_d: float, t_s: float
) -> tuple[float, float, float]:
    """Least squares in (ρ_d, ρ_s) ≥ 0 from normal equations; also what they take off the cost."""
    only_d = max(t_d, 0.0) / a_dd
    # Samples that the lobe does not reach at all leave a column of zeros.
    only_s = max(t_s, 0.0) / a_ss if a_ss > 0.0 else 0.0
    det = a_dd * a_ss - a_ds * a_ds
    if det > 1e-13 * a_dd * a_ss:
        rho_d = (t_d * a_ss - t_s * a_ds) / det
        rho_s = (t_s * a_dd - t_d * a_ds) / det
        if rho_d >= 0.0 and rho_s >= 0.0:
            return rho_d, rho_s, rho_d * t_d + rho_s * t_s
    gain_d = only_d * t_d
    gain_s = only_s * t_s
    if gain_d >= gain_s:
        return only_d, 0.0, gain_d
    return 0.0, only_s, gain_s


@njit(cache=True, fastmath=_SUMS, error_model="numpy")
def huber_weights(
    rows: Floats,
    lobe: Floats,
    rho: Floats,
    n: int,
    limit: float,
    weight: Floats,
    target: Floats,
) -> tuple[float, bool]:
    """Reweight all samples by Huber's rule at the present fit.

    Returns twice Huber's cost, and whether all samples are within the limit.

    ``rows[0..2]`` is cos θ √w / σ and ``rows[3..5]`` is y √w / σ per channel.
    """
    bound = min(limit, _NO_LIMIT)
    cost = 0.0
    far = 0.0
    # Without branches, and with what is far counted in floating point: the loop becomes vectors.
    for c in range(CHANNELS):
        rho_d = rho[0, c]
        rho_s = rho[1, c]
        for i in range(n):
            g = rows[c, i]
            y = rows[CHANNELS + c, i]
            residual = abs(y - g * (rho_d + rho_s * lobe[i]))
            near = residual if residual < bound else bound
            largest = residual if residual > bound else bound
            far += 1.0 if residual > bound else 0.0
            # r² within the limit, and limit (2 r − limit) beyond.
            cost += near * (2.0 * residual - near)
            u = g * (bound / largest)
            weight[c, i] = u * g
            target[c, i] = u * y
    return cost, far == 0.0
