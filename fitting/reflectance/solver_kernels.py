"""Compiled fit of a batch of texels, shared out between the cores.

Per texel: gather valid samples, test for a highlight, search starts, descend, take the best,
propagate its covariance. Nothing here raises: a texel that cannot be fitted carries a flag
(:mod:`fitting.reflectance.flags`), and its neighbours are fitted all the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from fitting.reflectance.covariance_kernels import ALL, propagate_covariance
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
    make_workspace,
    sum_columns,
)
from fitting.reflectance.start_kernels import diffuse_gain, gain_of, search_starts

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

DIFFUSE = int(TexelFlag.DIFFUSE)
UNOBSERVED = int(TexelFlag.UNOBSERVED)
LOBE_FROM_PRIOR = int(TexelFlag.LOBE_FROM_PRIOR)
AT_BOUND = int(TexelFlag.AT_BOUND)
NOT_CONVERGED = int(TexelFlag.NOT_CONVERGED)
NO_SAMPLES = int(TexelFlag.NO_SAMPLES)
DARK = int(TexelFlag.DARK)
SAMPLES_DROPPED = int(TexelFlag.SAMPLES_DROPPED)
NOT_FINITE = int(TexelFlag.NOT_FINITE)

_CHUNK = 64
_REWEIGHTINGS = 8
_HARDLY_NARROWED = 0.7  # variance of ln k over the prior's


class MaterialTable(NamedTuple):
    """One row per material; see :class:`fitting.reflectance.priors.Material`.

    Attributes
    ----------
    free : (m,) array
    mean : (m, 3) array
    precision : (m, 3, 3) array
    specular_mean, specular_precision : (m, 3) array
    misfit_floor, misfit_relative : (m,) array
        What the model itself is off by: radiance, and share of the radiance.
    """

    free: NDArray[np.int32]
    mean: Floats
    precision: Floats
    specular_mean: Floats
    specular_precision: Floats
    misfit_floor: Floats
    misfit_relative: Floats


class SolverSettings(NamedTuple):
    """What the kernels are told; see :class:`fitting.reflectance.solver.SolverOptions`.

    Attributes
    ----------
    bounds : (3, 2) array
        Ranges of ln k, ln r, ln c.
    ln_ratios : (m,) array
        Grid of ln r for starts, beside the prior's.
    huber_limit : float
        Standardised residual beyond which the loss is linear.
    threshold : float
        Fall of the cost below the diffuse fit's that a highlight must bring.
    power : float
        Fall to be expected of the material's highlight where it counts as observable.
    tolerance : float
    max_iterations : int
    """

    bounds: Floats
    ln_ratios: Floats
    huber_limit: float
    threshold: float
    power: float
    tolerance: float
    max_iterations: int


@njit(cache=True, error_model="numpy")
def gather_samples(
    view: Singles,
    light: Singles,
    radiance: Singles,
    variance: Singles,
    weight: Singles,
    misfit_floor: float,
    misfit_relative: float,
    space: Workspace,
    ceiling: Floats,
) -> tuple[int, bool]:
    """Valid samples of a texel in the layout of the kernels; their number, and if any was bad.

    ``ceiling`` becomes the largest variance that ρ can have: ten times the brightest sample.
    """
    n = 0
    bad = False
    for c in range(CHANNELS):
        ceiling[c] = 0.0
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
        for c in range(CHANNELS):
            y = float(radiance[i, c])
            off = misfit_relative * y
            scale = math.sqrt(w / (variance[i, c] + misfit_floor * misfit_floor + off * off))
            space.rows[c, n] = cosine * scale
            space.rows[CHANNELS + c, n] = y * scale
            ceiling[c] = max(ceiling[c], abs(y) / cosine)
        n += 1
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
    space: Workspace, n: int, prior: LobePrior, huber_limit: float, rho: Floats
) -> float:
    """Huber's fit of ρ under the lobe in ``space``; return twice its cost, without priors."""
    cost = np.inf
    for _ in range(_REWEIGHTINGS):
        sum_columns(space.weight, space.target, space.lobe, n, space.sums)
        solve_columns(space.sums, prior, rho)
        new_cost = huber_weights(
            space.rows, space.lobe, rho, n, huber_limit, space.weight, space.target
        )
        if not cost - new_cost > 1e-4 * new_cost:
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
    return fit_columns(space, n, nothing, huber_limit, rho)


@njit(cache=True, error_model="numpy")
def find_highlight(
    space: Workspace, n: int, prior: LobePrior, settings: SolverSettings, starts: Floats
) -> tuple[float, float]:
    """Fill ``starts``: the prior's lobe first where there is one, then the grid's minima.

    Returns the largest fall of the cost that a lobe brings, and the fall to be expected of the
    material's own highlight (0 where nothing is known of it).
    """
    known = prior.precision[0, 0] > 0.0
    from_grid = starts[1:] if known else starts
    fall = search_starts(space, n, settings.ln_ratios, prior, settings.bounds, from_grid)
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
            rho,
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
    return iterations, converged


@njit(cache=True, error_model="numpy")
def fit_texel(
    space: Workspace,
    n: int,
    prior: LobePrior,
    settings: SolverSettings,
    starts: Floats,
    theta: Floats,
    rho: Floats,
) -> tuple[float, int, int]:
    """Fit gathered samples; return twice the data's cost, the flags and the iterations.

    On return ``space`` holds the sums and the Hessian that the covariance is made of.
    """
    flags = 0
    iterations = 0
    cost = np.inf
    forget_weights(space, n)
    fall, expected = find_highlight(space, n, prior, settings, starts)
    highlight = fall > settings.threshold
    if highlight:
        iterations, converged = descend_from_starts(space, n, prior, settings, starts, theta, rho)
        diffuse_cost = np.inf
        if settings.huber_limit < np.inf:
            diffuse_cost = fit_diffuse(space, n, settings.huber_limit, rho)
        evaluate_lobe(space.axes, n, theta, space.lobe, space.slopes)
        forget_weights(space, n)
        cost = fit_columns(space, n, prior, settings.huber_limit, rho)
        finite = math.isfinite(cost + np.sum(theta) + np.sum(rho))
        highlight = finite and diffuse_cost - cost > settings.threshold
        if not finite:
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
    cost = fit_columns(space, n, prior, settings.huber_limit, rho)
    return cost, flags | UNOBSERVED, iterations


@njit(cache=True, error_model="numpy")
def remark(
    theta: Floats, rho: Floats, free: int, variance: float, spread: float, bounds: Floats
) -> int:
    """Flags that follow from the result of a texel with a highlight, or without."""
    flags = 0
    if not np.any(rho > 0.0):
        flags |= DARK
    for p in range(free):
        if theta[p] <= bounds[p, 0] or theta[p] >= bounds[p, 1]:
            flags |= AT_BOUND
    if variance > _HARDLY_NARROWED * spread:
        flags |= LOBE_FROM_PRIOR
    return flags


@njit(cache=True, error_model="numpy", parallel=True)
def fit_batch(
    view: Singles,
    light: Singles,
    radiance: Singles,
    variance: Singles,
    weight: Singles,
    material: NDArray[np.int32],
    table: MaterialTable,
    settings: SolverSettings,
    number_of_starts: int,
    thetas: Floats,
    rhos: Floats,
    covariances: Singles,
    costs: Floats,
    counts: NDArray[np.int32],
    iterations: NDArray[np.int32],
    flags: NDArray[np.int32],
) -> None:
    """Fit all texels; ``table`` holds one row per material, the outputs one per texel."""
    texels, samples = weight.shape
    range_precision = 12.0 / (settings.bounds[:, 1] - settings.bounds[:, 0]) ** 2
    for chunk in prange((texels + _CHUNK - 1) // _CHUNK):
        space = make_workspace(samples)
        ceiling = np.empty(CHANNELS)
        covariance = np.empty((ALL, ALL))
        starts = np.empty((number_of_starts, PARAMETERS))
        for t in range(chunk * _CHUNK, min(texels, (chunk + 1) * _CHUNK)):
            m = material[t]
            prior = LobePrior(
                table.free[m],
                table.mean[m],
                table.precision[m],
                table.specular_mean[m],
                table.specular_precision[m],
            )
            n, bad = gather_samples(
                view[t],
                light[t],
                radiance[t],
                variance[t],
                weight[t],
                table.misfit_floor[m],
                table.misfit_relative[m],
                space,
                ceiling,
            )
            counts[t] = n
            remarks = SAMPLES_DROPPED if bad else 0
            if n > 0:
                costs[t], found, iterations[t] = fit_texel(
                    space, n, prior, settings, starts, thetas[t], rhos[t]
                )
                remarks |= found
            else:
                thetas[t] = prior.mean
                rhos[t, 0] = 0.0
                rhos[t, 1] = prior.specular_mean
                space.sums[:] = 0.0
                space.hessian[:] = 0.0
                space.by_column[:] = 0.0
                remarks |= NO_SAMPLES
            if remarks & DIFFUSE:
                # ρ_s = 0 is the samples' word alone; its error is that of an unclipped estimate.
                alone = LobePrior(
                    prior.free, prior.mean, prior.precision, np.zeros(CHANNELS), np.zeros(CHANNELS)
                )
                propagate_covariance(space, rhos[t], alone, range_precision, ceiling, covariance)
            else:
                propagate_covariance(space, rhos[t], prior, range_precision, ceiling, covariance)
            covariances[t] = covariance
            if remarks & (DIFFUSE | UNOBSERVED | NO_SAMPLES) == 0:
                spread = 1.0 / (prior.precision[0, 0] + range_precision[0])
                remarks |= remark(
                    thetas[t], rhos[t], prior.free, covariance[0, 0], spread, settings.bounds
                )
            elif n > 0 and not np.any(rhos[t] > 0.0):
                remarks |= DARK
            flags[t] = remarks
