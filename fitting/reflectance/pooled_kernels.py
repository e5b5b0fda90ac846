"""Compiled cost of one lobe that many texels share, with ρ_d and ρ_s of their own."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from fitting.reflectance.descent_kernels import LobePrior, linearise, specular_prior_cost
from fitting.reflectance.lobe_kernels import CHANNELS, PARAMETERS, evaluate_lobe, make_workspace
from fitting.reflectance.solver_kernels import (
    MaterialTable,
    fit_columns,
    forget_weights,
    gather_samples,
)

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]


@njit(cache=True, error_model="numpy", parallel=True)
def fit_shared_lobe(
    view: Singles,
    light: Singles,
    radiance: Singles,
    variance: Singles,
    weight: Singles,
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
    for t in prange(weight.shape[0]):
        space = make_workspace(weight.shape[1])
        flat = LobePrior(
            free,
            theta,
            np.zeros((PARAMETERS, PARAMETERS)),
            np.zeros(CHANNELS),
            np.zeros(CHANNELS),
        )
        n = gather_samples(
            view[t],
            light[t],
            radiance[t],
            variance[t],
            weight[t],
            misfit_floor,
            misfit_relative,
            space,
            np.empty(CHANNELS),
        )[0]
        costs[t] = 0.0
        gradients[t] = 0.0
        rhos[t] = 0.0
        if n == 0:
            continue
        evaluate_lobe(space.axes, n, theta, space.lobe, space.slopes)
        forget_weights(space, n)
        costs[t] = fit_columns(space, n, flat, huber_limit, rhos[t])
        linearise(space, n, theta, rhos[t], flat)
        for p in range(free):
            gradients[t, p] = 2.0 * space.gradient[p]


@njit(cache=True, error_model="numpy", parallel=True)
def cost_under_materials(
    view: Singles,
    light: Singles,
    radiance: Singles,
    variance: Singles,
    weight: Singles,
    misfit_floor: float,
    misfit_relative: float,
    table: MaterialTable,
    huber_limit: float,
    costs: Floats,
) -> None:
    """Twice the cost (texels, materials) under each material's own lobe and highlight."""
    for t in prange(weight.shape[0]):
        space = make_workspace(weight.shape[1])
        rho = np.zeros((2, CHANNELS))
        n = gather_samples(
            view[t],
            light[t],
            radiance[t],
            variance[t],
            weight[t],
            misfit_floor,
            misfit_relative,
            space,
            np.empty(CHANNELS),
        )[0]
        for m in range(costs.shape[1]):
            costs[t, m] = 0.0
            if n == 0:
                continue
            prior = LobePrior(
                table.free[m],
                table.mean[m],
                table.precision[m],
                table.specular_mean[m],
                table.specular_precision[m],
            )
            evaluate_lobe(space.axes, n, prior.mean, space.lobe, space.slopes)
            forget_weights(space, n)
            costs[t, m] = fit_columns(space, n, prior, huber_limit, rho)
            costs[t, m] += specular_prior_cost(rho, prior)
