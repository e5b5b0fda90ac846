"""Compiled fit of a batch of texels, shared out between the cores.

A texel that cannot be fitted carries a flag, and its neighbours are fitted all the same.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from fitting.reflectance.covariance_kernels import ALL, exponent_spread, propagate_covariance
from fitting.reflectance.descent_kernels import LobePrior
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.lobe_kernels import CHANNELS, PARAMETERS, make_workspace
from fitting.reflectance.texel_kernels import (
    SampleArrays,
    SolverSettings,
    fit_texel,
    gather_samples,
)

Floats = NDArray[np.float64]

_NO_HIGHLIGHT = int(TexelFlag.DIFFUSE | TexelFlag.UNOBSERVED | TexelFlag.NO_SAMPLES)
_DIFFUSE = int(TexelFlag.DIFFUSE)
_LOBE_FROM_PRIOR = int(TexelFlag.LOBE_FROM_PRIOR)
_AT_BOUND = int(TexelFlag.AT_BOUND)
_NO_SAMPLES = int(TexelFlag.NO_SAMPLES)
_DARK = int(TexelFlag.DARK)
_SAMPLES_DROPPED = int(TexelFlag.SAMPLES_DROPPED)

_CHUNK = 64
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


class FitArrays(NamedTuple):
    """Where results go; see :class:`fitting.reflectance.solver.TexelFits`.

    Attributes
    ----------
    shape : (n, 3) array
    rho : (n, 2, 3) array
        ρ_d and ρ_s.
    covariance : (n, 9, 9) array
    cost : (n,) array
    samples, iterations, flags : (n,) array
    """

    shape: Floats
    rho: Floats
    covariance: Floats
    cost: Floats
    samples: NDArray[np.int32]
    iterations: NDArray[np.int32]
    flags: NDArray[np.int32]


@njit(cache=True, error_model="numpy")
def prior_of(table: MaterialTable, material: int) -> LobePrior:
    """One row of the table."""
    return LobePrior(
        table.free[material],
        table.mean[material],
        table.precision[material],
        table.specular_mean[material],
        table.specular_precision[material],
    )


@njit(cache=True, error_model="numpy")
def remark(
    theta: Floats, rho: Floats, free: int, variance: float, spread: float, bounds: Floats
) -> int:
    """Flags that follow from the result of a texel with a highlight, or without."""
    flags = 0
    if not np.any(rho > 0.0):
        flags |= _DARK
    for p in range(free):
        if theta[p] <= bounds[p, 0] or theta[p] >= bounds[p, 1]:
            flags |= _AT_BOUND
    if variance > _HARDLY_NARROWED * spread:
        flags |= _LOBE_FROM_PRIOR
    return flags


@njit(cache=True, error_model="numpy")
def fit_range(
    first: int,
    last: int,
    samples: SampleArrays,
    material: NDArray[np.int32],
    table: MaterialTable,
    settings: SolverSettings,
    fits: FitArrays,
) -> None:
    """Fit some consecutive texels on one core."""
    space = make_workspace(samples.weight.shape[1])
    ceiling = np.empty(CHANNELS)
    covariance = np.empty((ALL, ALL))
    starts = np.empty((max(settings.starts, settings.weak_starts), PARAMETERS))
    range_precision = 12.0 / (settings.bounds[:, 1] - settings.bounds[:, 0]) ** 2
    nothing = np.zeros(CHANNELS)
    for t in range(first, last):
        m = material[t]
        prior = prior_of(table, m)
        shape = fits.shape[t]
        rho = fits.rho[t]
        n, bad = gather_samples(
            samples, t, table.misfit_floor[m], table.misfit_relative[m], space, ceiling
        )
        fits.samples[t] = n
        remarks = _SAMPLES_DROPPED if bad else 0
        if n > 0:
            fits.cost[t], found, fits.iterations[t] = fit_texel(
                space, n, prior, settings, ceiling, starts, shape, rho
            )
            remarks |= found
        else:
            shape[:] = prior.mean
            rho[0] = 0.0
            rho[1] = prior.specular_mean
            space.sums[:] = 0.0
            space.hessian[:] = 0.0
            space.by_column[:] = 0.0
            remarks |= _NO_SAMPLES
        if remarks & _DIFFUSE:
            # ρ_s = 0 is the samples' word alone; its error is that of an unclipped estimate.
            prior = LobePrior(prior.free, prior.mean, prior.precision, nothing, nothing)
        propagate_covariance(space, rho, prior, range_precision, ceiling, covariance)
        fits.covariance[t] = covariance
        if remarks & _NO_HIGHLIGHT == 0:
            spread = exponent_spread(prior, range_precision)
            remarks |= remark(shape, rho, prior.free, covariance[0, 0], spread, settings.bounds)
        elif n > 0 and not np.any(rho > 0.0):
            remarks |= _DARK
        fits.flags[t] = remarks


@njit(cache=True, error_model="numpy", parallel=True)
def fit_batch(
    samples: SampleArrays,
    material: NDArray[np.int32],
    table: MaterialTable,
    settings: SolverSettings,
    fits: FitArrays,
) -> None:
    """Fit all texels; ``table`` holds one row per material."""
    texels = samples.weight.shape[0]
    # The body is a function of its own: in here, short array expressions would be parallelised.
    for chunk in prange((texels + _CHUNK - 1) // _CHUNK):
        last = min(texels, (chunk + 1) * _CHUNK)
        fit_range(chunk * _CHUNK, last, samples, material, table, settings, fits)
