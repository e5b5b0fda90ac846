"""Compiled cost of one lobe that many texels share, with ρ_d and ρ_s of their own."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from fitting.reflectance.batch_kernels import MaterialTable, prior_of
from fitting.reflectance.descent_kernels import LobePrior, linearise, specular_prior_cost
from fitting.reflectance.lobe_kernels import CHANNELS, PARAMETERS, evaluate_lobe, make_workspace
from fitting.reflectance.texel_kernels import (
    SampleArrays,
    fit_columns,
    forget_weights,
    gather_samples,
)

Floats = NDArray[np.float64]
_TOLERANCE = 1e-5


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
def compare_materials(
    samples: SampleArrays,
    texel: int,
    misfit_floor: float,
    misfit_relative: float,
    table: MaterialTable,
    huber_limit: float,
    costs: Floats,
) -> None:
    """Fill one texel's twice the cost (m,) under each material's own lobe and highlight."""
    space = make_workspace(samples.weight.shape[1])
    rho = np.zeros((2, CHANNELS))
    n = gather_samples(samples, texel, misfit_floor, misfit_relative, space, np.empty(CHANNELS))[0]
    costs[:] = 0.0
    if n == 0:
        return
    for m in range(costs.shape[0]):
        prior = prior_of(table, m)
        evaluate_lobe(space.axes, n, prior.mean, space.lobe, space.slopes)
        forget_weights(space, n)
        costs[m] = fit_columns(space, n, prior, huber_limit, rho, _TOLERANCE)
        costs[m] += specular_prior_cost(rho, prior)


@njit(cache=True, error_model="numpy", parallel=True)
def cost_under_materials(
    samples: SampleArrays,
    misfit_floor: float,
    misfit_relative: float,
    table: MaterialTable,
    huber_limit: float,
    costs: Floats,
) -> None:
    """Twice the cost (texels, materials) under each material's own lobe and highlight."""
    for t in prange(samples.weight.shape[0]):
        compare_materials(samples, t, misfit_floor, misfit_relative, table, huber_limit, costs[t])
