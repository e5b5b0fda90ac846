r"""Fringes of a plan: which frames are the steps of which fringe, and what they weigh in its fit.

The model of a step is :math:`v_k = A + B\cos(\varphi + \delta_k)
= A + c\cos\delta_k - s\sin\delta_k` with :math:`c = B\cos\varphi`, :math:`s = B\sin\varphi`:
linear in (A, c, s), so that least squares gives all three for any three or more distinct shifts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import DecodingError
from acquisition.patterns import Axis, PhaseShift
from acquisition.plan import Plan

STEPS_AT_ONCE = 4
# Steps crowded together so much that noise counts this many times over determine no phase.
_LARGEST_EXCESS = 30.0


@dataclass(frozen=True)
class Fringe:
    """The steps of one fringe at one exposure, among the frames of a plan.

    Attributes
    ----------
    axis : Axis
    period_px : float
    origin_rad : float
    gamma : float
    shifts_rad : (steps,) float64 array
    frame_ids : tuple of str
        Frame of each step.
    exposure_s : float or None
        Exposure asked for; None where the plan does not say.
    """

    axis: Axis
    period_px: float
    origin_rad: float
    gamma: float
    shifts_rad: NDArray[np.float64]
    frame_ids: tuple[str, ...]
    exposure_s: float | None = None

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.shifts_rad)

    @property
    def solution(self) -> NDArray[np.float64]:
        """(3, steps) array that takes the samples to (A, c, s); errors as of :attr:`fit`."""
        return self.fit.solution

    @property
    def fit(self) -> StepFit:
        """What the fit of the steps weighs.

        Raises
        ------
        DecodingError
            The steps do not determine a phase.
        """
        fit = _fit_of(tuple(self.shifts_rad))
        if fit is None:
            raise DecodingError(
                f"the {self.axis} fringe of period {self.period_px:g} px has "
                f"{self.steps} steps that do not determine a phase; three distinct "
                "shifts, spread over the period, are the least"
            )
        return fit


@dataclass(frozen=True)
class StepFit:
    r"""Least squares of the steps of a fringe.

    Attributes
    ----------
    design : (steps, 3) float64 array
        Takes (A, c, s) to the samples.
    solution : (3, steps) float64 array
        Takes the samples to (A, c, s).
    step_weights : (groups, 3, 4) float32 array
        The solution in groups of four steps, filled with zeros.
    variance_moments : (3, 3) float32 array
        By which the phase's variance follows from the fit, in squared turns. With
        :math:`d\varphi = (\cos\varphi\,ds - \sin\varphi\,dc)/B` and a sample's variance linear
        in its level, row i belongs to the i-th of (1, c, s) in the level, and column j to the j-th
        of (cos², cos·sin, sin²).
    isotropic : bool
        Whether the phase's variance is the same at every phase, whatever the light.
    gram : (3, 3) float32 array
        The quadratic form of (A, c, s) that the samples' squares hold.
    excess : float
        Standard deviation of (c, s), in the direction where it is largest, over that of steps
        spread evenly.
    """

    design: NDArray[np.float64]
    solution: NDArray[np.float64]
    step_weights: NDArray[np.float32]
    variance_moments: NDArray[np.float32]
    isotropic: bool
    gram: NDArray[np.float32]
    excess: float


@lru_cache(maxsize=64)
def _fit_of(shifts: tuple[float, ...]) -> StepFit | None:
    """The fit of steps, None where they do not determine a phase."""
    delta = np.array(shifts)
    design = np.stack([np.ones_like(delta), np.cos(delta), -np.sin(delta)], axis=1)
    if len(shifts) < 3 or np.linalg.matrix_rank(design, tol=1e-6) < 3:
        return None
    solution = np.linalg.pinv(design)
    spread = np.linalg.eigvalsh(solution[1:] @ solution[1:].T)[-1] * len(shifts) / 2
    excess = float(np.sqrt(spread))
    if excess > _LARGEST_EXCESS:
        return None
    groups = -(-len(shifts) // STEPS_AT_ONCE)
    padded = np.zeros((3, groups * STEPS_AT_ONCE))
    padded[:, : len(shifts)] = solution
    grouped = padded.reshape(3, groups, STEPS_AT_ONCE).transpose(1, 0, 2)
    _, cosine, sine = solution
    products = np.stack([sine**2, -2 * sine * cosine, cosine**2])
    moments = design.T @ products.T / (2 * np.pi) ** 2
    even = np.zeros((3, 3))
    even[0] = moments[0, 0], 0.0, moments[0, 0]
    return StepFit(
        design,
        np.ascontiguousarray(solution),
        np.ascontiguousarray(grouped, np.float32),
        np.ascontiguousarray(moments, np.float32),
        bool(np.abs(moments - even).max() <= 1e-6 * moments[0, 0]),
        np.ascontiguousarray(design.T @ design, np.float32),
        excess,
    )


def find_fringes(plan: Plan) -> list[Fringe]:
    """Group the phase-shift frames of a plan into fringes.

    Sorted by axis, then from coarse to fine; the exposures of one fringe follow one another, the
    longest first.
    """
    groups: dict[tuple[Axis, float, float, float, float | None], list[tuple[float, str]]] = {}
    for frame in plan.frames:
        if isinstance(frame.pattern, PhaseShift):
            steps = groups.setdefault((*frame.pattern.fringe, frame.exposure_s), [])
            steps.append((frame.pattern.shift_rad, frame.id))
    fringes = [
        Fringe(
            *key[:4], np.array([shift for shift, _ in steps]), tuple(i for _, i in steps), key[4]
        )
        for key, steps in groups.items()
    ]
    return sorted(fringes, key=_from_coarse_to_fine)


def exposures_of_fringes(fringes: list[Fringe]) -> list[tuple[Fringe, ...]]:
    """Fringes in the order of :func:`find_fringes`, those that differ in exposure only together."""
    together: dict[tuple[Axis, float, float, float], list[Fringe]] = {}
    for fringe in fringes:
        key = (fringe.axis, fringe.period_px, fringe.origin_rad, fringe.gamma)
        together.setdefault(key, []).append(fringe)
    return [tuple(exposures) for exposures in together.values()]


def _from_coarse_to_fine(fringe: Fringe) -> tuple[Axis, float, float, float, float]:
    return (
        fringe.axis,
        -fringe.period_px,
        fringe.origin_rad,
        fringe.gamma,
        -(fringe.exposure_s or 0.0),
    )
