"""What is seen of a light arm, and the arm that explains it best.

See :mod:`calibration.light_arm` for the model and for what is made of the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.arm_geometry import ArmParameters
from calibration.errors import CalibrationError
from calibration.lamp import fall_off
from calibration.lens import Lens
from calibration.mirror_spheres import MirrorSphere
from devices.interfaces import ArmPose

# In scales of its own covariance the problem is nearly round: new ones are better than more steps.
_EVALUATIONS = 8
_SETTLED = 0.02
_ROUNDS = 30
_CONTRADICT = "its highlights or the target's radiance contradict one another"
_STEP = 1e-6
_PIXEL_STEP = 0.01
# Chance below which a misfit is not taken for noise.
_CHANCE = 1e-4


@dataclass(frozen=True)
class SphereHighlights:
    """Highlights of the lamp on one sphere.

    Attributes
    ----------
    sphere : MirrorSphere
    pixels : (poses, 2) float64 array
        NaN where none was found.
    sigma_px : float
        Standard error on either axis.
    """

    sphere: MirrorSphere
    pixels: NDArray[np.float64]
    sigma_px: float


@dataclass(frozen=True)
class TargetShading:
    """Radiance of a flat white target under the lamp at each pose.

    Attributes
    ----------
    points : (n, 3) float64 array
        Of the target, in the rig's frame, mm.
    normal : (3,) float64 array
        Unit, towards the lamp.
    radiance : (poses, n, 3) float64 array
        Linear RGB relative to the white reference; NaN where there is none.
    sigma : (poses, n, 3) float64 array
    albedo : float
        Of the target, which is matt.
    """

    points: NDArray[np.float64]
    normal: NDArray[np.float64]
    radiance: NDArray[np.float64]
    sigma: NDArray[np.float64]
    albedo: float = 1.0


@dataclass(frozen=True)
class ArmProblem:
    """Residuals of all observations over their standard errors.

    Attributes
    ----------
    poses : tuple of ArmPose
    highlights : tuple of SphereHighlights
    shading : TargetShading
    lens : Lens
    start : ArmParameters or None
        Arm from which the numbers of a fit count.
    left_out : (poses, spheres) bool array or None
        Highlights that are not used.
    excess : float
        By which the variances of the target's radiance are scaled.
    """

    poses: tuple[ArmPose, ...]
    highlights: tuple[SphereHighlights, ...]
    shading: TargetShading
    lens: Lens
    start: ArmParameters | None = None
    left_out: NDArray[np.bool_] | None = None
    excess: float = 1.0

    @property
    def spots(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Points on each sphere and directions from them, (poses, 3), NaN where not seen."""
        return [one.sphere.reflect(self.lens.unproject(one.pixels)) for one in self.highlights]

    def around(self, start: ArmParameters) -> ArmProblem:
        """The same, with numbers that count from an arm."""
        return replace(self, start=start)

    def reweighted(self, left_out: NDArray[np.bool_], excess: float) -> ArmProblem:
        """Without some highlights (poses, spheres), and variances of the target scaled."""
        return replace(self, left_out=left_out, excess=excess)

    def misses(
        self, numbers: NDArray[np.float64], *, rejected: bool = False
    ) -> NDArray[np.float64]:
        """(poses, spheres, 2) over their standard errors; NaN where not seen, or left out."""
        arm, moves = self.split(numbers)
        lamps = arm.positions(self.poses)
        found = []
        for one, move, (rays, axes) in zip(self.highlights, moves, self._whitening(), strict=True):
            at, direction = one.sphere.reflect(rays, centre=one.sphere.centre + move)
            towards = lamps - at
            towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
            found.append(np.einsum("kai,ki->ka", axes, towards - direction))
        misses = np.stack(found, axis=1)
        if self.left_out is not None and not rejected:
            misses[self.left_out] = np.nan
        return misses

    def misses_deg(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """(poses,) angle between lamp and reflected rays, RMS over the spheres."""
        arm, moves = self.split(numbers)
        lamps = arm.positions(self.poses)
        squares = []
        for one, move in zip(self.highlights, moves, strict=True):
            rays = self.lens.unproject(one.pixels)
            at, direction = one.sphere.reflect(rays, centre=one.sphere.centre + move)
            towards = lamps - at
            towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
            squares.append(np.sum((towards - direction) ** 2, axis=1))
        seen = np.isfinite(squares)
        count = seen.sum(axis=0)
        mean = np.where(seen, squares, 0).sum(axis=0) / np.where(count > 0, count, np.nan)
        return np.asarray(np.degrees(np.sqrt(mean)))

    def _whitening(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Rays of each sphere's pixels, and axes (poses, 2, 3) in standard errors across them."""
        cached = self.__dict__.get("_axes")
        if cached is None:
            cached = [self._axes_of(one) for one in self.highlights]
            object.__setattr__(self, "_axes", cached)
        return list(cached)

    def _axes_of(self, one: SphereHighlights) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        rays = self.lens.unproject(one.pixels)
        _, middle = one.sphere.reflect(rays)
        across = [
            one.sphere.reflect(self.lens.unproject(one.pixels + step))[1] - middle
            for step in np.eye(2) * _PIXEL_STEP
        ]
        lever = np.stack(across, axis=2) / _PIXEL_STEP * one.sigma_px
        return rays, np.linalg.pinv(np.nan_to_num(lever))

    def shading_residuals(self, arm: ArmParameters) -> NDArray[np.float64]:
        """(poses, points, 3) over their standard errors; NaN where not known."""
        shading = self.shading
        places = arm.positions(self.poses)[:, np.newaxis]
        axes = arm.axes(self.poses)[:, np.newaxis]
        towards = places - shading.points
        cosine = np.maximum(towards @ shading.normal, 0) / np.linalg.norm(towards, axis=-1)
        light = fall_off(places, axes, arm.exponent, shading.points) * cosine
        predicted = light[..., np.newaxis] * arm.intensity * (shading.albedo / np.pi)
        return np.asarray((predicted - shading.radiance) / (shading.sigma * np.sqrt(self.excess)))

    def shading_excess(self, numbers: NDArray[np.float64]) -> float:
        """Mean square of the target's residuals; 1 if it may be chance."""
        from scipy.stats import chi2

        residuals = self.shading_residuals(self.split(numbers)[0])
        known = residuals[np.isfinite(residuals)]
        total = float(np.sum(known**2)) * self.excess
        return total / len(known) if chi2.sf(total, len(known)) < _CHANCE else 1.0

    def residuals(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """All of them, the spheres' outlines and what is known of any arm among them."""
        arm, moves = self.split(numbers)
        parts = [self.misses(numbers).ravel(), self.shading_residuals(arm).ravel()]
        for one, move in zip(self.highlights, moves, strict=True):
            root = np.linalg.cholesky(one.sphere.covariance + 1e-12 * np.eye(3))
            parts.append(np.linalg.solve(root, move))
        parts.append(arm.prior_residuals())
        together = np.concatenate(parts)
        return np.where(np.isfinite(together), together, 0.0)

    def jacobian(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative of the residuals, by central differences."""
        columns = []
        for number, value in enumerate(numbers):
            step = np.zeros_like(numbers)
            step[number] = _STEP * max(1.0, abs(value))
            ends = self.residuals(numbers + step) - self.residuals(numbers - step)
            columns.append(ends / (2 * step[number]))
        return np.stack(columns, axis=1)

    def minimise(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """Least sum of squares from a start, by NLopt."""
        import nlopt

        here = numbers
        for _ in range(_ROUNDS):
            jacobian = self.jacobian(here)
            scale = np.linalg.norm(jacobian, axis=0)
            scale[scale == 0] = 1.0
            values, vectors = np.linalg.eigh((jacobian / scale).T @ (jacobian / scale))
            stretch = vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1])) / scale[:, None]

            # The step that is left, in standard errors.
            if np.linalg.norm(stretch.T @ (jacobian.T @ self.residuals(here))) < _SETTLED:
                break

            def half_squares(
                y: NDArray[np.float64],
                gradient: NDArray[np.float64],
                origin: NDArray[np.float64] = here,
                axes: NDArray[np.float64] = stretch,
            ) -> float:
                at = origin + axes @ y
                residuals = self.residuals(at)
                if gradient.size:
                    gradient[:] = axes.T @ (self.jacobian(at).T @ residuals)
                return float(0.5 * residuals @ residuals)

            # No step along an axis may change a number by more than it can be trusted for.
            bound = 1 / np.max(np.abs(stretch) / self._reach(len(here))[:, None], axis=0)
            optimiser = nlopt.opt(nlopt.LD_SLSQP, len(here))
            optimiser.set_lower_bounds(-bound)
            optimiser.set_upper_bounds(bound)
            optimiser.set_min_objective(half_squares)
            # In these scales a parameter's standard error is 1.
            optimiser.set_ftol_abs(1e-4)
            optimiser.set_xtol_abs(1e-2)
            optimiser.set_maxeval(_EVALUATIONS)
            try:
                y = optimiser.optimize(np.zeros(len(here)))
            except (nlopt.RoundoffLimited, RuntimeError, ValueError) as error:
                raise CalibrationError(
                    f"the light arm's fit failed ({error}): {_CONTRADICT}"
                ) from error
            here = here + stretch @ y
        else:
            raise CalibrationError("the light arm's fit did not end: " + _CONTRADICT)
        return np.asarray(here)

    def _reach(self, count: int) -> NDArray[np.float64]:
        """Largest steps (count,) in angles and logarithms, root of the exponent, and mm."""
        reach = np.full(count, 10.0)
        reach[: len(reach) - 3 * len(self.highlights)] = 1.0
        return reach

    def split(self, numbers: NDArray[np.float64]) -> tuple[ArmParameters, NDArray[np.float64]]:
        """Arm and moves (spheres, 3) of the spheres that numbers stand for."""
        assert self.start is not None
        count = len(self.start.as_array())
        arm = self.start.moved(numbers[:count] - self.start.as_array())
        return arm, numbers[count:].reshape(-1, 3)
