"""Compiled cost of one lobe that many texels share, with ρ_d and ρ_s of their own."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from fitting.reflectance.batch_kernels import MaterialTable, prior_of
from fitting.reflectance.descent_kernels import LobePrior, descend, linearise
from fitting.reflectance.lobe_kernels import (
    CHANNELS,
    PARAMETERS,
    Workspace,
    evaluate_lobe,
    make_workspace,
)
from fitting.reflectance.texel_kernels import (
    SampleArrays,
    fit_columns,
    forget_weights,
    gather_samples,
)

Floats = NDArray[np.float64]
_TOLERANCE = 1e-5
_STEPS = 20


@njit(cache=True, error_model="numpy")
def fit_under_lobe(
    samples: SampleArrays,
    texel: int,
    misfit_floor: float,
    misfit_relative: float,
    theta: Floats,
    free: int,
    huber_limit: float,
    rho: Floats,
    gradient: Floats,
) -> float:
    """One texel's twice the cost under a given lobe; fills its ρ and the gradient by the shape."""
    space = make_workspace(samples.weight.shape[1])
    none = np.zeros(CHANNELS)
    flat = LobePrior(free, theta, np.zeros((PARAMETERS, PARAMETERS)), none, none)
    n = gather_samples(samples, texel, misfit_floor, misfit_relative, space, np.empty(CHANNELS))[0]
    gradient[:] = 0.0
    rho[:] = 0.0
    if n == 0:
        return 0.0
    evaluate_lobe(space.axes, n, theta, space.lobe, space.slopes)
    forget_weights(space, n)
    cost = fit_columns(space, n, flat, huber_limit, rho, _TOLERANCE)
    linearise(space, n, theta, rho, flat)
    for p in range(free):
        gradient[p] = 2.0 * space.gradient[p]
    return cost


@njit(cache=True, error_model="numpy", parallel=True)
def fit_shared_lobe(
    samples: SampleArrays,
    misfit_floor: float,
    misfit_relative: float,
    theta: Floats,
    free: int,
    huber_limit: float,
    rhos: Floats,
    costs: Floats,
    gradients: Floats,
) -> None:
    """Per texel under the lobe ``theta``: ρ, twice the cost, and the cost's gradient (n, 3)."""
    for t in prange(samples.weight.shape[0]):
        costs[t] = fit_under_lobe(
            samples,
            t,
            misfit_floor,
            misfit_relative,
            theta,
            free,
            huber_limit,
            rhos[t],
            gradients[t],
        )


@njit(cache=True, error_model="numpy")
def occam_factor(space: Workspace, prior: LobePrior) -> float:
    """By how much the samples narrow the prior: ln of its volume over the posterior's, twice over.

    Of the lobe's shape and of ρ_s, from the sums and the Hessian in ``space`` (Laplace's method).
    """
    factor = 0.0
    volume = np.empty((PARAMETERS, PARAMETERS))
    for posterior in (True, False):
        sign = 1.0 if posterior else -1.0
        for p in range(prior.free):
            for q in range(p + 1):
                entry = prior.precision[p, q]
                if posterior:
                    entry += space.hessian[p, q]
                for m in range(q):
                    entry -= volume[p, m] * volume[q, m]
                if p == q:
                    entry = max(entry, 1e-12)
                    factor += sign * math.log(entry)
                    volume[p, p] = math.sqrt(entry)
                else:
                    volume[p, q] = entry / volume[q, q]
    for c in range(CHANNELS):
        own = space.sums[c, 2] - space.sums[c, 1] ** 2 / space.sums[c, 0]
        if prior.specular_precision[c] > 0.0:
            factor += math.log(1.0 + max(own, 0.0) / prior.specular_precision[c])
    return factor


@njit(cache=True, error_model="numpy")
def compare_materials(
    samples: SampleArrays,
    texel: int,
    misfit_floor: float,
    misfit_relative: float,
    table: MaterialTable,
    bounds: Floats,
    huber_limit: float,
    costs: Floats,
) -> None:
    """Fill −2 ln of the likelihood (m,) of one texel's samples under each material."""
    space = make_workspace(samples.weight.shape[1])
    rho = np.zeros((2, CHANNELS))
    theta = np.empty(PARAMETERS)
    n = gather_samples(samples, texel, misfit_floor, misfit_relative, space, np.empty(CHANNELS))[0]
    costs[:] = 0.0
    if n == 0:
        return
    for m in range(costs.shape[0]):
        prior = prior_of(table, m)
        theta[:] = prior.mean
        forget_weights(space, n)
        costs[m] = descend(
            *(space, n, theta, rho, prior.mean, np.inf, bounds, prior, huber_limit),
            *(_TOLERANCE, _STEPS),
        )[0]
        costs[m] += occam_factor(space, prior)


@njit(cache=True, error_model="numpy", parallel=True)
def cost_under_materials(
    samples: SampleArrays,
    misfit_floor: float,
    misfit_relative: float,
    table: MaterialTable,
    bounds: Floats,
    huber_limit: float,
    costs: Floats,
) -> None:
    """−2 ln of the likelihood (texels, materials) of each texel's samples, but for a constant.

    Lobe and ρ_s are integrated over what they may be within the material (Laplace's method).
    """
    for t in prange(samples.weight.shape[0]):
        compare_materials(
            samples, t, misfit_floor, misfit_relative, table, bounds, huber_limit, costs[t]
        )
