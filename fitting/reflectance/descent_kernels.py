"""Compiled Levenberg-Marquardt on the projected problem of one texel.

The unknowns are the leading ones of (ln k, ln r, ln c); ρ_d and ρ_s follow from them. Huber's
loss is minimised by reweighting: the weighted squares touch it from above at the present fit, so a
step that lowers them lowers it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fitting.reflectance.lobe_kernels import (
    CHANNELS,
    PARAMETERS,
    Workspace,
    evaluate_lobe,
    huber_weights,
    solve_channel,
    sum_columns,
    sum_slopes,
)

Floats = NDArray[np.float64]


_LONGEST_STEP = 1.5  # in ln k, ln r, ln c
_NEAR = 0.15  # of ln k, and of the lobe's logarithm by ln r and ln c


class LobePrior(NamedTuple):
    """What a texel's material says before its samples are looked at.

    Attributes
    ----------
    free : int
        How many of ln k, ln r, ln c are fitted; the others stay at the mean.
    mean : (3,) array
        Of ln k, ln r, ln c.
    precision : (3, 3) array
        Inverse covariance; zero says nothing.
    specular_mean, specular_precision : (3,) array
        Of ρ_s, per channel; precision zero says nothing.
    """

    free: int
    mean: Floats
    precision: Floats
    specular_mean: Floats
    specular_precision: Floats


@njit(cache=True, error_model="numpy")
def solve_columns(sums: Floats, prior: LobePrior, rho: Floats) -> float:
    """Fill ρ (2, 3) from the sums of all channels; return what the fit takes off the cost."""
    gain = 0.0
    for c in range(CHANNELS):
        precision = prior.specular_precision[c]
        rho[0, c], rho[1, c], less = solve_channel(
            sums[c, 0],
            sums[c, 1],
            sums[c, 2] + precision,
            sums[c, 3],
            sums[c, 4] + precision * prior.specular_mean[c],
        )
        gain += less
    return gain


@njit(cache=True, error_model="numpy")
def prior_cost(theta: Floats, prior: LobePrior) -> float:
    """Squared distance of the lobe parameters from their prior, in its own metric."""
    cost = 0.0
    for p in range(PARAMETERS):
        for q in range(PARAMETERS):
            cost += (theta[p] - prior.mean[p]) * prior.precision[p, q] * (theta[q] - prior.mean[q])
    return cost


@njit(cache=True, error_model="numpy")
def specular_prior_cost(rho: Floats, prior: LobePrior) -> float:
    """Squared distance of ρ_s from its prior."""
    cost = 0.0
    for c in range(CHANNELS):
        cost += prior.specular_precision[c] * (rho[1, c] - prior.specular_mean[c]) ** 2
    return cost


@njit(cache=True, error_model="numpy")
def project_slopes(space: Workspace, rho: Floats, specular_precision: Floats, free: int) -> None:
    """Half the gradient and half the Gauss-Newton Hessian of the projected cost, data only."""
    sums = space.sums
    by_column = space.by_column
    gradient = space.gradient
    hessian = space.hessian
    for p in range(free):
        gradient[p] = 0.0
        for q in range(p + 1):
            hessian[p, q] = 0.0
    for c in range(CHANNELS):
        rho_d = rho[0, c]
        rho_s = rho[1, c]
        if rho_s <= 0.0:
            continue
        a_dd = sums[c, 0]
        a_ds = sums[c, 1]
        a_ss = sums[c, 2] + specular_precision[c]
        det = a_dd * a_ss - a_ds * a_ds
        both = rho_d > 0.0 and det > 1e-13 * a_dd * a_ss
        squared = rho_s * rho_s
        # Projection onto the columns that are not held at zero.
        p_dd = a_ss / det if both else 0.0
        p_ds = a_ds / det if both else 0.0
        p_ss = a_dd / det if both else 1.0 / a_ss
        for p in range(free):
            d_p = by_column[c, p, 0]
            s_p = by_column[c, p, 1]
            gradient[p] -= rho_s * (by_column[c, p, 2] - rho_d * d_p - rho_s * s_p)
            for q in range(p + 1):
                d_q = by_column[c, q, 0]
                s_q = by_column[c, q, 1]
                shared = d_p * (p_dd * d_q - p_ds * s_q) + s_p * (p_ss * s_q - p_ds * d_q)
                hessian[p, q] += squared * (space.by_slope[c, p, q] - shared)


@njit(cache=True, error_model="numpy")
def solve_step(
    hessian: Floats,
    gradient: Floats,
    held: NDArray[np.bool_],
    damping: float,
    free: int,
    step: Floats,
) -> float:
    """Damped step by Cholesky's factorisation; return −gradient · step, or −1 where it fails.

    Held parameters do not move.
    """
    factor = np.empty((PARAMETERS, PARAMETERS))
    for p in range(free):
        step[p] = 0.0
        for q in range(p + 1):
            entry = hessian[p, q]
            if held[p] or held[q]:
                entry = 1.0 if p == q else 0.0
            elif p == q:
                entry *= 1.0 + damping
            for m in range(q):
                entry -= factor[p, m] * factor[q, m]
            if p == q:
                if not entry > 1e-14 * abs(hessian[p, p]) or entry <= 0.0:
                    return -1.0
                factor[p, p] = math.sqrt(entry)
            else:
                factor[p, q] = entry / factor[q, q]
    for p in range(free):
        entry = 0.0 if held[p] else -gradient[p]
        for m in range(p):
            entry -= factor[p, m] * step[m]
        step[p] = entry / factor[p, p]
    for p in range(free - 1, -1, -1):
        entry = step[p]
        for m in range(p + 1, free):
            entry -= factor[m, p] * step[m]
        step[p] = entry / factor[p, p]
    decrease = 0.0
    for p in range(free):
        decrease -= gradient[p] * step[p]
    return decrease


@njit(cache=True, error_model="numpy")
def linearise(space: Workspace, n: int, theta: Floats, rho: Floats, prior: LobePrior) -> None:
    """Fill slope sums, gradient (prior included) and Hessian (data only) at the present fit."""
    free = prior.free
    sum_slopes(
        space.weight,
        space.target,
        space.lobe,
        space.slopes,
        n,
        free,
        space.by_column,
        space.by_slope,
    )
    project_slopes(space, rho, prior.specular_precision, free)
    for p in range(free):
        for q in range(PARAMETERS):
            space.gradient[p] += prior.precision[p, q] * (theta[q] - prior.mean[q])


@njit(cache=True, error_model="numpy")
def joins(theta: Floats, known: Floats, free: int) -> bool:
    """Whether a descent has come so near a known minimum that it can only end there."""
    # In units of the lobe's own width: narrow lobes have minima close to one another.
    scale = math.exp(known[0])
    near = abs(theta[0] - known[0]) < _NEAR
    for p in range(1, free):
        near = near and scale * abs(theta[p] - known[p]) < _NEAR
    return near


@njit(cache=True, error_model="numpy")
def descend(
    space: Workspace,
    n: int,
    theta: Floats,
    rho: Floats,
    known_theta: Floats,
    known_cost: float,
    bounds: Floats,
    prior: LobePrior,
    huber_limit: float,
    tolerance: float,
    max_iterations: int,
) -> tuple[float, int, bool]:
    """Move ``theta`` and ``rho`` to a local minimum.

    Returns twice the cost (priors included), the iterations, and whether the limit of iterations
    was not met first. A descent that arrives at a minimum that is known already ends there.
    """
    free = prior.free
    trial = np.empty(PARAMETERS)
    step = np.empty(PARAMETERS)
    damped = np.empty((PARAMETERS, PARAMETERS))
    held = np.zeros(PARAMETERS, np.bool_)
    trial_rho = np.empty((2, CHANNELS))
    trial_sums = np.empty((CHANNELS, 5))
    evaluate_lobe(space.axes, n, theta, space.lobe, space.slopes)
    sum_columns(space.weight, space.target, space.lobe, n, space.sums)
    solve_columns(space.sums, prior, rho)
    damping = 1e-3
    cost = np.inf
    level = np.inf
    iterations = 0
    moved = True
    plain = False
    while True:
        if moved:
            was_plain = plain
            new_cost, plain = huber_weights(
                space.rows, space.lobe, rho, n, huber_limit, space.weight, space.target
            )
            new_cost += prior_cost(theta, prior) + specular_prior_cost(rho, prior)
            if not (plain and was_plain):
                sum_columns(space.weight, space.target, space.lobe, n, space.sums)
                level = prior_cost(theta, prior) - solve_columns(space.sums, prior, rho)
            if new_cost >= known_cost and joins(theta, known_theta, free):
                return new_cost, iterations, True
            linearise(space, n, theta, rho, prior)
            for p in range(free):
                for q in range(p + 1):
                    damped[p, q] = space.hessian[p, q] + prior.precision[p, q]
                down = space.gradient[p]
                held[p] = (theta[p] <= bounds[p, 0] and down > 0.0) or (
                    theta[p] >= bounds[p, 1] and down < 0.0
                )
                held[p] = held[p] or damped[p, p] <= 0.0
            moved = False
            settled = cost - new_cost <= tolerance * new_cost
            cost = new_cost
            if settled and damping < 1.0:
                return cost, iterations, True
        decrease = solve_step(damped, space.gradient, held, damping, free, step)
        if decrease < 0.0:
            # Two parameters that the samples cannot tell apart: damping does it.
            damping = 8.0 * max(damping, 1e-2)
            if damping > 1e6:
                return cost, iterations, False
            continue
        if not decrease > tolerance * cost:
            return cost, iterations, True
        if iterations >= max_iterations:
            return cost, iterations, False
        iterations += 1
        for p in range(PARAMETERS):
            trial[p] = theta[p]
        for p in range(free):
            wanted = theta[p] + min(max(step[p], -_LONGEST_STEP), _LONGEST_STEP)
            trial[p] = min(max(wanted, bounds[p, 0]), bounds[p, 1])
        evaluate_lobe(space.axes, n, trial, space.lobe, space.slopes)
        sum_columns(space.weight, space.target, space.lobe, n, trial_sums)
        trial_level = prior_cost(trial, prior) - solve_columns(trial_sums, prior, trial_rho)
        if trial_level <= level:
            theta[:] = trial
            rho[:] = trial_rho
            space.sums[:] = trial_sums
            level = trial_level
            damping = max(0.1 * damping, 1e-6)
            moved = True
        else:
            damping = 8.0 * max(damping, 1e-2)
            if damping > 1e6:  # rounding decides from here on
                return cost, iterations, True
