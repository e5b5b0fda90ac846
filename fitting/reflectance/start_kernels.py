"""Compiled search for starting lobes on a grid of (k, r).

The exponents are the powers of two, so that each lobe is the square of the last and the whole grid
needs no exponential. Every lobe's cost is exact, ρ_d and ρ_s being solved for.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fitting.reflectance.descent_kernels import LobePrior, prior_cost
from fitting.reflectance.lobe_kernels import (
    CHANNELS,
    Workspace,
    solve_channel,
    sum_columns,
    sum_lobe,
)

Floats = NDArray[np.float64]
EXPONENT_OCTAVES = 12  # k = 1, 2, 4 … 2048


@njit(cache=True, error_model="numpy")
def gain_of(sums: Floats) -> float:
    """What diffuse and specular columns take off the cost together, ρ ≥ 0."""
    gain = 0.0
    for c in range(CHANNELS):
        gain += solve_channel(sums[c, 0], sums[c, 1], sums[c, 2], sums[c, 3], sums[c, 4])[2]
    return gain


@njit(cache=True, error_model="numpy")
def diffuse_gain(sums: Floats) -> float:
    """What the diffuse column alone takes off the cost, ρ_d ≥ 0."""
    gain = 0.0
    for c in range(CHANNELS):
        gain += max(sums[c, 3], 0.0) ** 2 / sums[c, 0]
    return gain


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "nsz"})
def raise_base(axes: Floats, n: int, ratio: float, anisotropy: float, lobe: Floats) -> None:
    """Fill the lobe of exponent 1, scaled so that its largest value is 1."""
    largest = 0.0
    for i in range(n):
        d = max(axes[0, i] + anisotropy * axes[1, i] + ratio * axes[2, i], 0.0)
        lobe[i] = d
        largest = max(largest, d)
    scale = 1.0 / largest if largest > 0.0 else 0.0
    for i in range(n):
        lobe[i] *= scale


@njit(cache=True, error_model="numpy")
def square_lobe(lobe: Floats, n: int) -> None:
    """Double the exponent; what is too small to matter becomes zero before it is denormal."""
    for i in range(n):
        b = lobe[i] * lobe[i]
        lobe[i] = b if b > 1e-120 else 0.0


@njit(cache=True, error_model="numpy")
def search_starts(
    space: Workspace, n: int, ln_ratios: Floats, prior: LobePrior, bounds: Floats, starts: Floats
) -> float:
    """Fill ``starts`` (number, 3) with the best local minima of the grid, best first.

    Returns the largest fall of the data's cost below the diffuse fit's, over the whole grid. A
    start that the grid does not offer repeats the best one.
    """
    number = starts.shape[0]
    found = np.full(number, np.inf)
    cost = np.empty(EXPONENT_OCTAVES)
    theta = prior.mean.copy()
    most = 0.0
    sum_columns(space.weight, space.target, space.lobe, n, space.sums)
    without = diffuse_gain(space.sums)
    for m in range(len(ln_ratios)):
        if prior.free < 2 and m > 0:
            break
        theta[1] = prior.mean[1] + ln_ratios[m] if prior.free >= 2 else prior.mean[1]
        raise_base(space.axes, n, math.exp(theta[1]), math.exp(theta[2]), space.lobe)
        for j in range(EXPONENT_OCTAVES):
            if j > 0:
                square_lobe(space.lobe, n)
            sum_lobe(space.weight, space.target, space.lobe, n, space.sums)
            gain = gain_of(space.sums)
            most = max(most, gain - without)
            theta[0] = j * math.log(2.0)
            cost[j] = prior_cost(theta, prior) - gain
            if theta[0] < bounds[0, 0] or theta[0] > bounds[0, 1]:
                cost[j] = np.inf
        for j in range(EXPONENT_OCTAVES):
            if j > 0 and cost[j - 1] <= cost[j]:
                continue
            if j < EXPONENT_OCTAVES - 1 and cost[j + 1] < cost[j]:
                continue
            theta[0] = j * math.log(2.0)
            place = number
            while place > 0 and cost[j] < found[place - 1]:
                place -= 1
            for s in range(number - 1, place, -1):
                found[s] = found[s - 1]
                starts[s] = starts[s - 1]
            if place < number:
                found[place] = cost[j]
                starts[place] = theta
    for s in range(1, number):
        if found[s] == np.inf:
            starts[s] = starts[0]
    if number > 0 and found[0] == np.inf:
        for s in range(number):
            starts[s] = prior.mean
    return most
