"""Compiled covariance of all nine parameters of a texel at its minimum.

Gauss-Newton with the linear part included: the lobe parameters' covariance is the inverse of the
projected Hessian, and ρ's carries the lobe's uncertainty along.
Order: ln k, ln r, ln c, ρ_d (RGB), ρ_s (RGB).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fitting.reflectance.descent_kernels import LobePrior
from fitting.reflectance.lobe_kernels import CHANNELS, PARAMETERS, Workspace

Floats = NDArray[np.float64]
ALL = PARAMETERS + 2 * CHANNELS


@njit(cache=True, error_model="numpy")
def invert_positive(matrix: Floats, inverse: Floats) -> None:
    """Inverse of a symmetric positive definite 3 × 3 matrix (its lower triangle is read)."""
    a = matrix[0, 0]
    b = matrix[1, 0]
    c = matrix[2, 0]
    d = matrix[1, 1]
    e = matrix[2, 1]
    f = matrix[2, 2]
    scale_a = 1.0 / math.sqrt(a)
    scale_d = 1.0 / math.sqrt(d)
    scale_f = 1.0 / math.sqrt(f)
    b *= scale_a * scale_d
    c *= scale_a * scale_f
    e *= scale_d * scale_f
    det = max(1.0 + 2.0 * b * c * e - b * b - c * c - e * e, 1e-12)
    inverse[0, 0] = (1.0 - e * e) / det * scale_a * scale_a
    inverse[1, 1] = (1.0 - c * c) / det * scale_d * scale_d
    inverse[2, 2] = (1.0 - b * b) / det * scale_f * scale_f
    inverse[1, 0] = inverse[0, 1] = (c * e - b) / det * scale_a * scale_d
    inverse[2, 0] = inverse[0, 2] = (b * e - c) / det * scale_a * scale_f
    inverse[2, 1] = inverse[1, 2] = (b * c - e) / det * scale_d * scale_f


@njit(cache=True, error_model="numpy")
def exponent_spread(prior: LobePrior, range_precision: Floats) -> float:
    """Variance of ln k before the samples are looked at, whatever ln r and ln c may be."""
    information = prior.precision + np.diag(range_precision)
    spread = np.empty((PARAMETERS, PARAMETERS))
    invert_positive(information, spread)
    return float(spread[0, 0])


@njit(cache=True, error_model="numpy")
def propagate_covariance(
    space: Workspace,
    rho: Floats,
    prior: LobePrior,
    range_precision: Floats,
    ceiling: Floats,
    covariance: Floats,
) -> None:
    """Fill the (9, 9) covariance.

    ``range_precision`` (3,) and ``ceiling`` (3,), the largest variance of ρ per channel, keep
    entries finite where the data say nothing.
    """
    free = prior.free
    information = np.zeros((PARAMETERS, PARAMETERS))
    theta_cov = np.empty((PARAMETERS, PARAMETERS))
    for p in range(PARAMETERS):
        for q in range(p + 1):
            information[p, q] = prior.precision[p, q]
            if p < free and q < free:
                information[p, q] += space.hessian[p, q]
        information[p, p] += range_precision[p]
    invert_positive(information, theta_cov)
    carried = np.zeros((2 * CHANNELS, PARAMETERS))
    own = np.zeros((CHANNELS, 3))
    for c in range(CHANNELS):
        floor = 1.0 / ceiling[c]
        a_dd = space.sums[c, 0] + floor
        a_ds = space.sums[c, 1]
        a_ss = space.sums[c, 2] + prior.specular_precision[c] + floor
        det = max(a_dd * a_ss - a_ds * a_ds, 1e-13 * a_dd * a_ss)
        own[c, 0] = a_ss / det
        own[c, 1] = -a_ds / det
        own[c, 2] = a_dd / det
        for p in range(free):
            d_p = rho[1, c] * space.by_column[c, p, 0]
            s_p = rho[1, c] * space.by_column[c, p, 1]
            if rho[0, c] > 0.0:
                carried[c, p] = -(a_ss * d_p - a_ds * s_p) / det
                carried[CHANNELS + c, p] = -(a_dd * s_p - a_ds * d_p) / det
            else:
                carried[CHANNELS + c, p] = -s_p / a_ss
    for p in range(PARAMETERS):
        for q in range(PARAMETERS):
            covariance[p, q] = theta_cov[p, q]
    for i in range(2 * CHANNELS):
        for p in range(PARAMETERS):
            with_theta = 0.0
            for q in range(PARAMETERS):
                with_theta += carried[i, q] * theta_cov[q, p]
            covariance[PARAMETERS + i, p] = with_theta
            covariance[p, PARAMETERS + i] = with_theta
        for j in range(i + 1):
            entry = 0.0
            for q in range(PARAMETERS):
                entry += covariance[PARAMETERS + i, q] * carried[j, q]
            covariance[PARAMETERS + i, PARAMETERS + j] = entry
            covariance[PARAMETERS + j, PARAMETERS + i] = entry
    for c in range(CHANNELS):
        d = PARAMETERS + c
        s = d + CHANNELS
        covariance[d, d] += own[c, 0]
        covariance[d, s] += own[c, 1]
        covariance[s, d] += own[c, 1]
        covariance[s, s] += own[c, 2]
