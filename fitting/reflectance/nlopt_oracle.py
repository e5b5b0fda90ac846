"""NLopt on one texel: slow, general, and independent of the fast solver, which is held to it.

The objective is the solver's: Huber's loss of the standardised residuals, and the priors. Here all
unknowns (shape, ρ_d and ρ_s) are optimised together under bounds, by SLSQP with analytic gradients,
or the shape alone by BOBYQA with the linear part solved for.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FittingError
from fitting.reflectance.materials import Material, shape_bounds
from fitting.reflectance.samples import RadianceSamples

if TYPE_CHECKING:
    import nlopt

Floats = NDArray[np.float64]
_UNKNOWNS = 9
_SMALLEST_BASE = 1e-30
_MAX_EVALUATIONS = 400


@dataclass(frozen=True)
class TexelProblem:
    """The objective of one texel.

    Attributes
    ----------
    axes : (3, n) array
        −v_x l_x, −v_y l_y, v_z l_z.
    gain : (n, 3) array
        cos θ over the standard error.
    target : (n, 3) array
        Radiance over the standard error.
    material : Material
    huber_limit : float
    """

    axes: Floats
    gain: Floats
    target: Floats
    material: Material
    huber_limit: float

    @classmethod
    def of(
        cls, samples: RadianceSamples, texel: int, material: Material, huber_limit: float
    ) -> TexelProblem:
        """Problem of one texel of a tile.

        Raises
        ------
        FittingError
            The texel has no valid sample.
        """
        one = samples.take([texel])
        keep = one.valid[0]
        if not keep.any():
            raise FittingError(f"texel {texel} has no valid sample: there is nothing to fit")
        view, light, radiance, variance = (
            array[0, keep].astype(np.float64)
            for array in (one.view, one.light, one.radiance, one.variance)
        )
        weight = one.weight[0, keep, np.newaxis].astype(np.float64)
        total = variance + material.misfit_floor**2 + (material.misfit_relative * radiance) ** 2
        scale = np.sqrt(weight / total)
        axes = (view * light * np.array([-1.0, -1.0, 1.0])).T
        return cls(axes, light[:, 2:] * scale, radiance * scale, material, huber_limit)

    def lobe(self, shape: Floats) -> tuple[Floats, Floats]:
        """The lobe at the samples, (n,), and its derivatives by the shape, (n, 3)."""
        k, r, c = np.exp(shape)
        across, along = c * self.axes[1], r * self.axes[2]
        base = self.axes[0] + across + along
        lit = base > _SMALLEST_BASE
        safe = np.where(lit, base, 1.0)
        exponent = k * (np.log(safe) - shape[1])
        value = np.where(lit, np.exp(np.clip(exponent, -250.0, 250.0)), 0.0)
        slope = value * k / safe
        return value, np.stack([value * exponent, slope * along - value * k, slope * across], 1)

    def cost(self, unknowns: Floats) -> tuple[float, Floats]:
        """Twice the cost, priors included, and its gradient by ln k, ln r, ln c, ρ_d, ρ_s."""
        shape, rho_d, rho_s = unknowns[:3], unknowns[3:6], unknowns[6:]
        value, slopes = self.lobe(shape)
        residual = self.gain * (rho_d + value[:, np.newaxis] * rho_s) - self.target
        size = np.abs(residual)
        near = size <= self.huber_limit
        limit = self.huber_limit if np.isfinite(self.huber_limit) else 0.0
        loss = np.where(near, residual**2, limit * (2.0 * size - limit)).sum()
        pull = self.gain * np.where(near, residual, limit * np.sign(residual))
        gradient = np.empty(_UNKNOWNS)
        gradient[:3] = 2.0 * slopes.T @ (pull @ rho_s)
        gradient[3:6] = 2.0 * pull.sum(axis=0)
        gradient[6:] = 2.0 * value @ pull
        off = shape - self.material.shape_mean
        pulled = self.material.shape_precision @ off
        off_s = rho_s - self.material.specular_mean
        pulled_s = self.material.specular_precision * off_s
        gradient[:3] += 2.0 * pulled
        gradient[6:] += 2.0 * pulled_s
        return float(loss + off @ pulled + off_s @ pulled_s), gradient

    @property
    def brightest(self) -> Floats:
        """Largest reflectance of a sample per channel, (3,)."""
        return np.maximum(np.max(np.abs(self.target) / self.gain, axis=0), 1e-12)

    def start(self, shape: Floats) -> Floats:
        """All unknowns for a lobe's shape: non-negative least squares for ρ."""
        from scipy.optimize import nnls

        value = self.lobe(shape)[0]
        unknowns = np.concatenate([shape, np.zeros(6)])
        for c in range(3):
            columns = np.stack([self.gain[:, c], self.gain[:, c] * value], axis=1)
            unknowns[3 + c], unknowns[6 + c] = nnls(columns, self.target[:, c])[0]
        return unknowns


def minimise_slsqp(
    problem: TexelProblem, start: Floats, *, tolerance: float = 1e-8
) -> tuple[float, Floats]:
    """Minimum of all unknowns together from one start, by SLSQP with analytic gradients.

    Parameters
    ----------
    problem : TexelProblem
    start : (9,) array
        Clipped into the bounds, outside of which NLopt refuses it.
    tolerance : float
        Relative change of cost and unknowns at which the search ends.

    Returns
    -------
    cost : float
        Twice the cost.
    unknowns : (9,) array
    """
    import nlopt

    free = int(problem.material.variant)
    lower, upper = _limits(problem)
    scale = np.concatenate([np.ones(3), problem.brightest, problem.brightest])
    # Without bounds between them, unknowns of very different size mislead the quasi-Newton matrix.
    optimiser = nlopt.opt(nlopt.LD_SLSQP, _UNKNOWNS)
    held = np.clip(start, lower, upper)
    size = max(problem.cost(held)[0], 1e-300)  # SLSQP stops early on a cost that is not near 1
    lower[free:3] = upper[free:3] = held[free:3]

    def objective(x: Floats, gradient: Floats) -> float:
        cost, slopes = problem.cost(x * scale)
        if gradient.size:
            gradient[:] = slopes * scale / size
        return cost / size

    optimiser.set_lower_bounds(lower / scale)
    optimiser.set_upper_bounds(upper / scale)
    optimiser.set_ftol_rel(tolerance)
    optimiser.set_xtol_rel(tolerance)
    optimiser.set_maxeval(_MAX_EVALUATIONS)
    cost, best = run_nlopt(optimiser, objective, held / scale)
    return cost * size, best * scale


def minimise_bobyqa(
    cost: Callable[[Floats], float],
    start: Floats,
    lower: Floats,
    upper: Floats,
    *,
    precision: float = 1e-4,
) -> tuple[float, Floats]:
    """Minimum of a cost of the shape alone, without derivatives, from one start.

    Parameters
    ----------
    cost : callable
        Projected cost of the free shape parameters.
    start, lower, upper : (p,) array
        The start is clipped into the bounds.
    precision : float
        Of the shape; that of the cost is a hundredth of it, relative.

    Returns
    -------
    cost : float
    shape : (p,) array
    """
    import nlopt

    if len(start) < 2:
        # BOBYQA needs two dimensions.
        optimiser = nlopt.opt(nlopt.LN_SBPLX, len(start))
    else:
        optimiser = nlopt.opt(nlopt.LN_BOBYQA, len(start))
    optimiser.set_lower_bounds(lower)
    optimiser.set_upper_bounds(upper)
    optimiser.set_initial_step(0.25)
    optimiser.set_ftol_rel(0.01 * precision)
    optimiser.set_xtol_abs(precision)
    optimiser.set_maxeval(_MAX_EVALUATIONS)
    return run_nlopt(optimiser, lambda x, gradient: cost(x), start)


def random_starts(problem: TexelProblem, number: int, seed: int) -> list[Floats]:
    """Starts spread evenly over ln k and ln r, ρ fitted to each."""
    rng = np.random.default_rng(seed)
    bounds = shape_bounds()
    free = int(problem.material.variant)
    starts = []
    for _ in range(number):
        shape = problem.material.shape_mean.copy()
        shape[0] = rng.uniform(*np.log([1.0, 1000.0]))
        shape[1:free] = rng.uniform(-0.25, 0.25, free - 1)
        starts.append(problem.start(np.clip(shape, bounds[:, 0], bounds[:, 1])))
    return starts


def _limits(problem: TexelProblem) -> tuple[Floats, Floats]:
    bounds = shape_bounds()
    most = 1e6 * problem.brightest
    lower = np.concatenate([bounds[:, 0], np.zeros(6)])
    return lower, np.concatenate([bounds[:, 1], most, most])


def run_nlopt(
    optimiser: nlopt.opt, objective: Callable[[Floats, Floats], float], start: Floats
) -> tuple[float, Floats]:
    """Minimise from a start that is clipped into the bounds; the best point seen is the answer.

    NLopt ends some searches with an error once rounding decides; what was found until then counts.

    Raises
    ------
    FittingError
        No point with a finite cost was seen.
    """
    import nlopt

    lowest = math.inf
    best = start

    def watched(x: Floats, gradient: Floats) -> float:
        nonlocal lowest, best
        cost = objective(x, gradient)
        if cost < lowest:
            lowest, best = cost, x.copy()
        return cost

    optimiser.set_min_objective(watched)
    inside = np.clip(start, optimiser.get_lower_bounds(), optimiser.get_upper_bounds())
    try:
        optimiser.optimize(inside)
    except (nlopt.RoundoffLimited, RuntimeError) as error:
        if not math.isfinite(lowest):
            raise FittingError(f"NLopt found no finite cost: {error}") from error
    return lowest, best
