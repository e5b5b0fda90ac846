"""Compiled fit of one texel.

Gather valid samples, test for a highlight, search starts, descend, take the best. Nothing here
raises: a texel that cannot be fitted carries a flag (:mod:`fitting.reflectance.flags`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fitting.reflectance.descent_kernels import (
    LobePrior,
    descend,
    linearise,
    solve_columns,
)
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.lobe_kernels import (
    CHANNELS,
    PARAMETERS,
    Workspace,
    evaluate_lobe,
    huber_weights,
    sum_columns,
)
from fitting.reflectance.start_kernels import diffuse_gain, gain_of, search_starts

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

DIFFUSE = int(TexelFlag.DIFFUSE)
UNOBSERVED = int(TexelFlag.UNOBSERVED)
NOT_CONVERGED = int(TexelFlag.NOT_CONVERGED)
NOT_FINITE = int(TexelFlag.NOT_FINITE)

_REWEIGHTINGS = 8
_CLOSELY = 1e-4
_ROUGHLY = 1e-2
# ρ² over the largest variance that ρ can have: a thousand times the brightest sample.
_FAR_BEYOND = 1e4


class SampleArrays(NamedTuple):
    """The arrays of :class:`fitting.reflectance.samples.RadianceSamples`.

    Attributes
    ----------
    view, light, radiance, variance : (n, m, 3) array
    weight : (n, m) array
    """

    view: Singles
    light: Singles
    radiance: Singles
    variance: Singles
    weight: Singles


class SolverSettings(NamedTuple):
    """What the kernels are told; see :class:`fitting.reflectance.solver.SolverOptions`.

    Attributes
    ----------
    bounds : (3, 2) array
        Ranges of ln k, ln r, ln c.
    starts, weak_starts : int
        Descents of a texel with a highlight, with a weak one.
    ln_ratios, weak_ln_ratios : (m,) array
        Their grids of ln r for starts, beside the prior's.
    huber_limit : float
        Standardised residual beyond which the loss is linear.
    threshold : float
        Fall of the cost below the diffuse fit's that a highlight must bring.
    weak : float
        Fall below which a highlight is weak.
    power : float
        Fall to be expected of the material's highlight where it counts as observable.
    tolerance : float
    max_iterations : int
    """

    bounds: Floats
    starts: int
    ln_ratios: Floats
    weak_starts: int
    weak_ln_ratios: Floats
    huber_limit: float
    threshold: float
    weak: float
    power: float
    tolerance: float
    max_iterations: int


@njit(cache=True, error_model="numpy")
def gather_samples(
    samples: SampleArrays,
    texel: int,
    misfit_floor: float,
    misfit_relative: float,
    space: Workspace,
    ceiling: Floats,
) -> tuple[int, bool]:
    """Valid samples of a texel in the layout of the kernels; their number, and if any was bad.

    ``ceiling`` becomes the largest variance that ρ can have: ten times the brightest sample.
    """
    views, lights, radiances, variances, weights = samples
    view = views[texel]
    light = lights[texel]
    radiance = radiances[texel]
    variance = variances[texel]
    weight = weights[texel]
    n = 0
    bad = False
    for i in range(weight.shape[0]):
        w = float(weight[i])
        if w == 0.0:
            continue
        cosine = float(light[i, 2])
        total = w + cosine + light[i, 0] + light[i, 1] + view[i, 0] + view[i, 1] + view[i, 2]
        good = w > 0.0
        for c in range(CHANNELS):
            total += radiance[i, c] + variance[i, c]
            good = good and variance[i, c] > 0.0
        if not (good and math.isfinite(total)):
            bad = True
            continue
        if cosine <= 0.0 or view[i, 2] <= 0.0:
            continue
        space.axes[0, n] = -float(view[i, 0]) * float(light[i, 0])
        space.axes[1, n] = -float(view[i, 1]) * float(light[i, 1])
        space.axes[2, n] = float(view[i, 2]) * cosine
        space.lobe[n] = cosine
        space.slopes[0, n] = w
        for c in range(CHANNELS):
            space.weight[c, n] = float(variance[i, c])
            space.target[c, n] = float(radiance[i, c])
        n += 1
    # Roots and quotients in loops of their own, which the compiler turns into vectors.
    floor = misfit_floor * misfit_floor
    for c in range(CHANNELS):
        brightest = 0.0
        for i in range(n):
            off = misfit_relative * space.target[c, i]
            space.weight[c, i] += floor + off * off
        for i in range(n):
            scale = math.sqrt(space.slopes[0, i] / space.weight[c, i])
            space.rows[c, i] = scale
            space.rows[CHANNELS + c, i] = scale * space.target[c, i]
        for i in range(n):
            space.rows[c, i] *= space.lobe[i]
            brightest = max(brightest, abs(space.target[c, i]) / space.lobe[i])
        ceiling[c] = brightest
    for c in range(CHANNELS):
        ceiling[c] = (10.0 * ceiling[c]) ** 2 if ceiling[c] > 0.0 else 1.0
    return n, bad


@njit(cache=True, error_model="numpy")
def forget_weights(space: Workspace, n: int) -> None:
    """Weights of the plain least squares: Huber's factor is 1 everywhere."""
    for c in range(CHANNELS):
        for i in range(n):
            g = space.rows[c, i]
            space.weight[c, i] = g * g
            space.target[c, i] = g * space.rows[CHANNELS + c, i]


@njit(cache=True, error_model="numpy")
def fit_columns(
    space: Workspace, n: int, prior: LobePrior, huber_limit: float, rho: Floats, tolerance: float
) -> float:
    """Huber's fit of ρ under the lobe in ``space``; return twice its cost, without priors.

    Reweighting starts from the weights in ``space`` and ends when a step gains less than the
    tolerance, relative to the cost.
    """
    cost = np.inf
    for _ in range(_REWEIGHTINGS):
        sum_columns(space.weight, space.target, space.lobe, n, space.sums)
        solve_columns(space.sums, prior, rho)
        new_cost, near = huber_weights(
            space.rows, space.lobe, rho, n, huber_limit, space.weight, space.target
        )
        if near or not cost - new_cost > tolerance * new_cost:
            cost = new_cost
            break
        cost = new_cost
    sum_columns(space.weight, space.target, space.lobe, n, space.sums)
    return cost


@njit(cache=True, error_model="numpy")
def fit_diffuse(space: Workspace, n: int, huber_limit: float, rho: Floats) -> float:
    """Huber's fit of ρ_d with ρ_s = 0; return twice its cost."""
    none = np.zeros(CHANNELS)
    exactly = np.full(CHANNELS, 1e30)
    space.lobe[:n] = 0.0
    forget_weights(space, n)
    nothing = LobePrior(0, np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS)), none, exactly)
    return fit_columns(space, n, nothing, huber_limit, rho, _ROUGHLY)


@njit(cache=True, error_model="numpy")
def find_highlight(
    space: Workspace, n: int, prior: LobePrior, ln_ratios: Floats, bounds: Floats, starts: Floats
) -> tuple[float, float]:
    """Fill ``starts``: the prior's lobe first where there is one, then the grid's minima.

    Returns the largest fall of the cost that a lobe brings, and the fall to be expected of the
    material's own highlight (0 where nothing is known of it).
    """
    known = prior.precision[0, 0] > 0.0
    from_grid = starts[1:] if known else starts
    fall = search_starts(space, n, ln_ratios, prior, bounds, from_grid)
    expected = 0.0
    if known:
        starts[0] = prior.mean
        evaluate_lobe(space.axes, n, prior.mean, space.lobe, space.slopes)
        sum_columns(space.weight, space.target, space.lobe, n, space.sums)
        sums = space.sums
        fall = max(fall, gain_of(sums) - diffuse_gain(sums))
        for c in range(CHANNELS):
            alone = sums[c, 2] - sums[c, 1] ** 2 / sums[c, 0]
            expected += prior.specular_mean[c] ** 2 * max(alone, 0.0)
    return fall, expected


@njit(cache=True, error_model="numpy")
def descend_from_starts(
    space: Workspace,
    n: int,
    prior: LobePrior,
    settings: SolverSettings,
    starts: Floats,
    theta: Floats,
    rho: Floats,
) -> tuple[int, bool]:
    """Best minimum of all starts in ``theta`` and ``rho``; iterations, and whether it converged."""
    trial_rho = np.empty((2, CHANNELS))
    best = np.inf
    iterations = 0
    converged = False
    trial = np.empty(PARAMETERS)
    for s in range(starts.shape[0]):
        if s > 0 and np.all(starts[s] == starts[s - 1]):
            continue
        trial[:] = starts[s]
        for p in range(PARAMETERS):
            trial[p] = min(max(trial[p], settings.bounds[p, 0]), settings.bounds[p, 1])
        forget_weights(space, n)
        cost, steps, done = descend(
            space,
            n,
            trial,
            trial_rho,
            theta,
            best,
            settings.bounds,
            prior,
            settings.huber_limit,
            settings.tolerance,
            settings.max_iterations,
        )
        iterations += steps
        if cost < best:
            best = cost
            converged = done
            theta[:] = trial
            rho[:] = trial_rho
    return iterations, converged


@njit(cache=True, error_model="numpy")
def far_beyond_samples(rho: Floats, ceiling: Floats) -> bool:
    """Whether a lobe's slope alone makes up a highlight, head-on, that no sample comes near."""
    beyond = False
    for c in range(CHANNELS):
        beyond = beyond or rho[1, c] * rho[1, c] > _FAR_BEYOND * ceiling[c]
    return beyond


@njit(cache=True, error_model="numpy")
def fit_texel(
    space: Workspace,
    n: int,
    prior: LobePrior,
    settings: SolverSettings,
    ceiling: Floats,
    starts: Floats,
    theta: Floats,
    rho: Floats,
) -> tuple[float, int, int]:
    """Fit gathered samples; return twice the data's cost, the flags and the iterations.

    ``ceiling`` is that of :func:`gather_samples`. On return ``space`` holds the sums and the
    Hessian that the covariance is made of.
    """
    flags = 0
    iterations = 0
    cost = np.inf
    forget_weights(space, n)
    tried = starts[: settings.starts]
    fall, expected = find_highlight(space, n, prior, settings.ln_ratios, settings.bounds, tried)
    highlight = fall > settings.threshold
    if highlight and fall < settings.weak:
        tried = starts[: settings.weak_starts]
        find_highlight(space, n, prior, settings.weak_ln_ratios, settings.bounds, tried)
    if highlight:
        best_rho = np.empty((2, CHANNELS))
        iterations, converged = descend_from_starts(
            space, n, prior, settings, tried, theta, best_rho
        )
        diffuse_cost = np.inf
        if settings.huber_limit < np.inf:
            diffuse_cost = fit_diffuse(space, n, settings.huber_limit, rho)
        evaluate_lobe(space.axes, n, theta, space.lobe, space.slopes)
        huber_weights(
            space.rows, space.lobe, best_rho, n, settings.huber_limit, space.weight, space.target
        )
        cost = fit_columns(space, n, prior, settings.huber_limit, rho, _CLOSELY)
        sound = math.isfinite(cost + np.sum(theta) + np.sum(rho))
        if settings.threshold > -np.inf:
            sound = sound and not far_beyond_samples(rho, ceiling)
        highlight = sound and diffuse_cost - cost > settings.threshold
        if not sound:
            flags |= NOT_FINITE
        elif highlight and not converged:
            flags |= NOT_CONVERGED
    if highlight:
        linearise(space, n, theta, rho, prior)
        return cost, flags, iterations
    theta[:] = prior.mean
    space.hessian[:] = 0.0
    space.by_column[:] = 0.0
    seen_if_there = expected >= settings.power or prior.specular_precision[0] == 0.0
    if seen_if_there:
        cost = fit_diffuse(space, n, settings.huber_limit, rho)
        evaluate_lobe(space.axes, n, theta, space.lobe, space.slopes)
        sum_columns(space.weight, space.target, space.lobe, n, space.sums)
        return cost, flags | DIFFUSE, iterations
    evaluate_lobe(space.axes, n, theta, space.lobe, space.slopes)
    forget_weights(space, n)
    cost = fit_columns(space, n, prior, settings.huber_limit, rho, _CLOSELY)
    return cost, flags | UNOBSERVED, iterations
