"""What is seen of a light arm, and the arm that explains it best.

See :mod:`calibration.light_arm` for the model and for what is made of the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.arm_geometry import ArmParameters
from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.mirror_spheres import MirrorSphere
from calibration.target_shading import CHANCE, LitTarget, TargetShading
from devices.interfaces import ArmPose

# In scales of its own covariance the problem is nearly round: new ones are better than more steps.
_EVALUATIONS = 8
_SETTLED = 0.02
_ROUNDS = 30
_CONTRADICT = "its highlights or the target's radiance contradict one another"
_STEP = 1e-6
_PIXEL_STEP = 0.01
# Those of an arm's numbers that are the lamp's: aim, intensity and exponent.
LAMP = slice(10, 17)
INTENSITY = slice(13, 16)


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
        By which the variances of the target's radiance are scaled; infinite leaves it out.
    lamp_only : bool
        Whether the arm is held where it is.
    matt : bool
        Whether the target follows Lambert's law; otherwise it departs from it by the incidence.
    """

    poses: tuple[ArmPose, ...]
    highlights: tuple[SphereHighlights, ...]
    shading: TargetShading
    lens: Lens
    start: ArmParameters | None = None
    left_out: NDArray[np.bool_] | None = None
    excess: float = 1.0
    lamp_only: bool = False
    matt: bool = True

    @property
    def spots(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Points on each sphere and directions from them, (poses, 3), NaN where not seen."""
        return [one.sphere.reflect(self.lens.unproject(one.pixels)) for one in self.highlights]

    @cached_property
    def target(self) -> LitTarget:
        """The target under the arm's lamp."""
        return LitTarget(self.shading, self.poses, self.matt, self.excess)

    def around(self, start: ArmParameters) -> ArmProblem:
        """The same, with numbers that count from an arm."""
        return replace(self, start=start)

    def of_highlights(self, left_out: NDArray[np.bool_] | None = None) -> ArmProblem:
        """By the highlights alone, without some (poses, spheres)."""
        return replace(self, left_out=left_out, excess=np.inf)

    def of_lamp(self) -> ArmProblem:
        """The lamp alone, by the target; the arm stays where it is."""
        return replace(self, excess=1.0, lamp_only=True)

    def of_all(self, excess: float) -> ArmProblem:
        """Everything, with the variances of the target scaled."""
        return replace(self, excess=excess, lamp_only=False)

    def of_any_law(self) -> ArmProblem:
        """With a target that reflects as it likes by the incidence."""
        return replace(self, matt=False)

    def misses(
        self, numbers: NDArray[np.float64], *, rejected: bool = False
    ) -> NDArray[np.float64]:
        """(poses, spheres, 2) over their standard errors; NaN where not seen, or left out."""
        arm, moves = self.split(numbers)
        lamps = arm.positions(self.poses)
        found = []
        for one, move, (rays, axes) in zip(self.highlights, moves, self._whitening, strict=True):
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

    @cached_property
    def _whitening(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Rays of each sphere's pixels, and axes (poses, 2, 3) in standard errors across them."""
        return [self._axes_of(one) for one in self.highlights]

    def _axes_of(self, one: SphereHighlights) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        rays = self.lens.unproject(one.pixels)
        _, middle = one.sphere.reflect(rays)
        across = [
            one.sphere.reflect(self.lens.unproject(one.pixels + step))[1] - middle
            for step in np.eye(2) * _PIXEL_STEP
        ]
        lever = np.stack(across, axis=2) / _PIXEL_STEP * one.sigma_px
        return rays, np.linalg.pinv(np.nan_to_num(lever))

    def without_shadows(self, numbers: NDArray[np.float64]) -> ArmProblem:
        """Without the few samples of the target that no lamp explains; itself if there are none."""
        shading = self.target.without_shadows(self.split(numbers)[0])
        return self if shading is self.shading else replace(self, shading=shading)

    def sphere_shift_sigmas(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """By which spheres were moved (spheres,), over their standard errors, RMS of three axes."""
        _, moves = self.split(numbers)
        shifts = [_whitened(one, move) for one, move in zip(self.highlights, moves, strict=True)]
        return np.sqrt(np.mean(np.square(shifts), axis=1))

    def shading_excess(self, numbers: NDArray[np.float64], alone: NDArray[np.float64]) -> float:
        """By how much the target is off beyond what noise explains, mean square; 1 if by chance.

        See :meth:`~calibration.target_shading.LitTarget.excess_over_noise`.

        Parameters
        ----------
        numbers : (n,) array
            Fitted to everything, with the variances of the target as given.
        alone : (n,) array
            Fitted to all but the target.
        """
        return self.target.excess_over_noise(
            self.split(numbers)[0],
            pull=self._pull(numbers, alone),
            lamp_numbers=LAMP.stop - LAMP.start,
        )

    def agrees(self, numbers: NDArray[np.float64], alone: NDArray[np.float64]) -> bool:
        """Whether the target moves the arm no farther than the highlights allow by chance.

        Parameters
        ----------
        numbers : (n,) array
            Fitted to everything.
        alone : (n,) array
            Fitted to all but the target.
        """
        from scipy.stats import chi2

        return bool(chi2.sf(self._pull(numbers, alone), LAMP.start) >= CHANCE)

    def _pull(self, numbers: NDArray[np.float64], alone: NDArray[np.float64]) -> float:
        """By how much the highlights' sum of squares grows as the target is listened to."""
        without = replace(self, excess=np.inf)
        return float(np.sum(without.residuals(numbers) ** 2 - without.residuals(alone) ** 2))

    def radius_error(self, numbers: NDArray[np.float64]) -> tuple[float, float]:
        """By which the spheres' radius is wrong, relative, and its standard error.

        Spheres, arm and lamp grow together from the camera's place without any highlight moving: a
        radius is as right as it was measured, for all that spheres show. The target stands where
        the code says, and its shading contradicts a lamp that is too near or too far. What is given
        is the step of Gauss and Newton in the radius, with all else free (C. R. Rao's score test).

        Parameters
        ----------
        numbers : (n,) array
            Fitted to everything.
        """
        step = 1e-4
        ends = [
            replace(
                self, highlights=tuple(_scaled(one, 1 + change) for one in self.highlights)
            ).misses(numbers)
            for change in (step, -step)
        ]
        residuals, jacobian = self.residuals(numbers), self.jacobian(numbers)
        grown = np.zeros_like(residuals)
        grown[: ends[0].size] = np.nan_to_num((ends[0] - ends[1]) / (2 * step)).ravel()
        scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
        basis, size, _ = np.linalg.svd(jacobian / scale, full_matrices=False)
        basis = basis[:, size > 1e-7 * size[0]]
        left = grown - basis @ (basis.T @ grown)
        told = max(float(left @ left), 1e-300)
        return float(-(left @ residuals) / told), float(1 / np.sqrt(told))

    def residuals(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """All of them, the spheres' outlines and what is known of any arm among them."""
        return self._with_shading(numbers, self._lit(numbers))

    def _lit(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """The target's residuals, (m,); none where the target is left out."""
        if np.isinf(self.excess):
            return np.zeros(0)
        return self.target.residuals(self.split(numbers)[0]).ravel()

    def _with_shading(
        self, numbers: NDArray[np.float64], lit: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        arm, moves = self.split(numbers)
        parts = [self.misses(numbers).ravel(), lit]
        for one, move in zip(self.highlights, moves, strict=True):
            parts.append(_whitened(one, move))
        parts.append(arm.prior_residuals())
        together = np.concatenate(parts)
        return np.where(np.isfinite(together), together, 0.0)

    def jacobian(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative of the residuals, by central differences."""
        jacobian = np.zeros((len(self.residuals(numbers)), len(numbers)))
        here, moves = self._lit(numbers), 3 * len(self.highlights)
        for number in range(len(numbers))[LAMP if self.lamp_only else slice(None)]:
            step = np.zeros_like(numbers)
            step[number] = _STEP * max(1.0, abs(numbers[number]))
            # Where the spheres are, the target does not tell.
            arm_moves = number < len(numbers) - moves
            ends = [
                self._with_shading(at, self._lit(at) if arm_moves else here)
                for at in (numbers + step, numbers - step)
            ]
            jacobian[:, number] = (ends[0] - ends[1]) / (2 * step[number])
        return jacobian

    def minimise(
        self, numbers: NDArray[np.float64], *, rounds: int = _ROUNDS
    ) -> NDArray[np.float64]:
        """Least sum of squares from a start, by NLopt.

        Raises
        ------
        CalibrationError
            After so many rounds it has not ended.
        """
        import nlopt

        here = numbers
        for _ in range(rounds):
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


def _scaled(one: SphereHighlights, factor: float) -> SphereHighlights:
    """Highlights of a sphere that is larger and as much farther from the camera."""
    sphere = replace(
        one.sphere,
        centre=one.sphere.centre * factor,
        radius_mm=one.sphere.radius_mm * factor,
        covariance=one.sphere.covariance,
    )
    return replace(one, sphere=sphere)


def _whitened(one: SphereHighlights, move: NDArray[np.float64]) -> NDArray[np.float64]:
    """A sphere's move (3,) in standard errors of its outline."""
    root = np.linalg.cholesky(one.sphere.covariance + 1e-12 * np.eye(3))
    return np.asarray(np.linalg.solve(root, move))
