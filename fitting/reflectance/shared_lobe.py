"""One lobe for the texels of a material, fitted with NLopt on the projected problem.

Every texel keeps its own ρ_d and ρ_s, which are solved for, so that only the one to three numbers
of the lobe's shape are searched for: BOBYQA from the best of several exponents, then SLSQP with the
gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FittingError
from fitting.reflectance.lobe import LobeVariant
from fitting.reflectance.materials import shape_bounds
from fitting.reflectance.nlopt_oracle import minimise_bobyqa, run_nlopt
from fitting.reflectance.pooled_kernels import fit_shared_lobe
from fitting.reflectance.samples import RadianceSamples

Floats = NDArray[np.float64]
_START_EXPONENTS = (3.0, 8.0, 20.0, 50.0, 120.0, 300.0, 800.0)
_DESCENTS = 2
_ROUGHLY = 0.01  # precision of a shape from which gradients lead on


@dataclass(frozen=True)
class SharedLobe:
    """A lobe shared by texels.

    Attributes
    ----------
    shape : (3,) array
        ln k, ln r, ln c.
    cost : float
        Twice the cost of all texels.
    rho : (n, 2, 3) array
        ρ_d and ρ_s of each texel.
    texel_cost : (n,) array
    """

    shape: Floats
    cost: float
    rho: Floats
    texel_cost: Floats


class PooledProblem:
    """Cost of a shared lobe over the samples of many texels."""

    def __init__(
        self,
        samples: RadianceSamples,
        variant: LobeVariant,
        *,
        misfit_floor: float = 0.0,
        misfit_relative: float = 0.0,
        huber_limit: float = 3.0,
    ) -> None:
        if samples.texels == 0 or not samples.valid.any():
            raise FittingError("no valid samples: a lobe cannot be fitted to nothing")
        self.samples = samples
        self.variant = variant
        self.misfit = (float(misfit_floor), float(misfit_relative))
        self.huber_limit = float(huber_limit)
        self._rho = np.zeros((samples.texels, 2, 3))
        self._costs = np.zeros(samples.texels)
        self._gradients = np.zeros((samples.texels, 3))

    def evaluate(self, free_shape: Floats) -> tuple[float, Floats]:
        """Twice the cost for the free shape parameters, and its gradient."""
        shape = np.zeros(3)
        shape[: len(free_shape)] = free_shape
        fit_shared_lobe(
            self.samples.arrays,
            *self.misfit,
            shape,
            int(self.variant),
            self.huber_limit,
            self._rho,
            self._costs,
            self._gradients,
        )
        return float(self._costs.sum()), self._gradients.sum(axis=0)[: int(self.variant)]

    def shared_lobe(self, free_shape: Floats) -> SharedLobe:
        """The fit at the given shape."""
        cost = self.evaluate(free_shape)[0]
        shape = np.zeros(3)
        shape[: len(free_shape)] = free_shape
        return SharedLobe(shape, cost, self._rho.copy(), self._costs.copy())


def fit_pooled(problem: PooledProblem, *, starts: Floats | None = None) -> SharedLobe:
    """Lobe of least cost for all texels together.

    Parameters
    ----------
    problem : PooledProblem
    starts : (s, p) array, optional
        Free shape parameters to start from, the best of them; by default exponents from 3 to 800.

    Returns
    -------
    SharedLobe
    """
    free = int(problem.variant)
    bounds = shape_bounds()[:free]
    if starts is None:
        starts = np.zeros((len(_START_EXPONENTS), free))
        starts[:, 0] = [math.log(k) for k in _START_EXPONENTS]
    ranked = sorted(starts, key=lambda start: problem.evaluate(start)[0])
    best_cost, best = math.inf, ranked[0]
    for start in ranked[:_DESCENTS]:
        cost, shape = minimise_bobyqa(
            *(lambda x: problem.evaluate(x)[0], start, bounds[:, 0], bounds[:, 1]),
            precision=_ROUGHLY,
        )
        if cost < best_cost:
            best_cost, best = cost, shape
    return problem.shared_lobe(_polish(problem, best, bounds))


def _polish(problem: PooledProblem, shape: Floats, bounds: Floats) -> Floats:
    import nlopt

    optimiser = nlopt.opt(nlopt.LD_SLSQP, len(shape))
    scale = max(problem.evaluate(shape)[0], 1e-300)

    def objective(x: Floats, gradient: Floats) -> float:
        cost, slopes = problem.evaluate(x)
        if gradient.size:
            gradient[:] = slopes / scale
        return cost / scale

    optimiser.set_lower_bounds(bounds[:, 0])
    optimiser.set_upper_bounds(bounds[:, 1])
    optimiser.set_ftol_rel(1e-8)
    optimiser.set_xtol_abs(1e-5)
    optimiser.set_maxeval(60)
    return run_nlopt(optimiser, objective, shape)[1]
