"""What is seen of a light arm, and the arm that explains it best.

See :mod:`calibration.light_arm` for the model and for what is made of the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import robust_sigma
from calibration.arm_geometry import ArmParameters
from calibration.errors import CalibrationError
from calibration.incidence_law import TERMS, incidence_factor
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
_LEAST_GAIN = 1e-6
# Those of an arm's numbers that are the lamp's: aim, intensity and exponent.
LAMP = slice(10, 17)
INTENSITY = slice(13, 16)
# A sample of the target that is off by more than all and than this, as a logarithm, is in a shadow;
# more of them than this share are no shadow.
_SHADOW_SIGMAS = 6.0
_LEAST_SHADOW = 0.03
_SHADOWED = 0.05
# Chance below which a misfit is not taken for noise.
CHANCE = 1e-4


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
    gains_unknown : bool
        Whether each point's radiance is known up to a factor only, the same under all poses and 1
        on average: a camera's vignetting, an uneven target.
    """

    points: NDArray[np.float64]
    normal: NDArray[np.float64]
    radiance: NDArray[np.float64]
    sigma: NDArray[np.float64]
    albedo: float = 1.0
    gains_unknown: bool = False

    @property
    def is_monochrome(self) -> bool:
        """Whether the three channels are one, their variances tripled."""
        return np.array_equal(self.radiance[..., 0], self.radiance[..., 1], equal_nan=True)


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

    def target_gains(self, arm: ArmParameters) -> NDArray[np.float64]:
        """Factors (points,) of the target's points that suit an arm best, 1 on average."""
        return self._gains_of(self._by_incidence(arm))

    def _gains_of(self, predicted: NDArray[np.float64]) -> NDArray[np.float64]:
        shading = self.shading
        weight = np.where(np.isfinite(shading.radiance), 1 / shading.sigma**2, 0.0)
        seen = np.where(weight > 0, shading.radiance, 0.0)
        products = np.sum(weight * predicted * seen, axis=(0, 2))
        squares = np.sum(weight * predicted**2, axis=(0, 2))
        known = squares > 0
        if not known.any():
            return np.ones(len(shading.points))
        gains = np.where(known, products / np.where(known, squares, 1), 1.0)
        return np.asarray(gains / np.maximum(gains[known].mean(), _LEAST_GAIN))

    def shading_residuals(self, arm: ArmParameters) -> NDArray[np.float64]:
        """(poses, points, 3) over their standard errors; NaN where not known."""
        shading = self.shading
        predicted = self._suited(arm)
        return np.asarray((predicted - shading.radiance) / (shading.sigma * np.sqrt(self.excess)))

    def without_shadows(self, numbers: NDArray[np.float64]) -> ArmProblem:
        """Without the few samples of the target that no lamp explains: a shadow is upon them.

        At the target's corners a shadow on a point or two looks like a bend of the light, as long
        as each pose is looked at by itself.
        """
        shading = self.shading
        predicted = self.of_any_law()._suited(self.split(numbers)[0])
        known = np.isfinite(shading.radiance) & (shading.radiance > 0) & (predicted > 0)
        off = np.log(np.where(known, shading.radiance, 1) / np.where(known, predicted, 1))
        spread = robust_sigma(off[known])
        far = known & (np.abs(off) > max(_SHADOW_SIGMAS * spread, _LEAST_SHADOW))
        if not 0 < far.sum() < _SHADOWED * known.sum():
            return self
        seen = np.where(far.any(axis=2, keepdims=True), np.nan, shading.radiance)
        return replace(self, shading=replace(shading, radiance=seen))

    def shading_misfit(self, arm: ArmParameters) -> float:
        """Root mean square of the target's radiance over that predicted, less one."""
        predicted = self._suited(arm)
        seen = np.isfinite(self.shading.radiance) & (predicted > 0)
        if not seen.any():
            return float("nan")
        off = self.shading.radiance[seen] / predicted[seen] - 1
        return float(np.sqrt(np.mean(off**2)))

    def _suited(self, arm: ArmParameters) -> NDArray[np.float64]:
        """Radiance with the law of incidence and the gains that suit it best."""
        predicted = self._by_incidence(arm)
        if self.shading.gains_unknown:
            predicted = predicted * self._gains_of(predicted)[:, np.newaxis]
        return predicted

    def _by_incidence(self, arm: ArmParameters) -> NDArray[np.float64]:
        """Radiance (poses, points, 3) with the law of incidence that suits it best."""
        shading = self.shading
        places = arm.positions(self.poses)[:, np.newaxis]
        axes = arm.axes(self.poses)[:, np.newaxis]
        towards = places - shading.points
        cosine = np.maximum(towards @ shading.normal, 0) / np.linalg.norm(towards, axis=-1)
        light = fall_off(places, axes, arm.exponent, shading.points) * cosine
        if not self.matt:
            seen, weight = self._logarithms()
            lit = light > 0
            light = light * incidence_factor(
                cosine,
                np.where(lit, seen - np.log(np.where(lit, light, 1.0)), 0.0),
                np.where(lit, weight, 0.0),
                by_point=shading.gains_unknown,
            )
        return np.asarray(light[..., np.newaxis] * arm.intensity * (shading.albedo / np.pi))

    def _logarithms(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Of the target's radiance, mean over its colours (poses, points), and their weights."""
        cached = self.__dict__.get("_logs")
        if cached is None:
            seen, sigma = self.shading.radiance, self.shading.sigma
            known = np.isfinite(seen) & (seen > 0)
            seen = np.where(known, seen, 1.0)
            weight = np.where(known, (seen / np.where(known, sigma, 1.0)) ** 2, 0.0)
            total, by_colour = weight.sum(axis=2), weight.sum(axis=(0, 1))
            logs = np.log(seen)
            # Colours weigh otherwise from pose to pose: their levels must not differ.
            logs = logs - (weight * logs).sum(axis=(0, 1)) / np.where(by_colour > 0, by_colour, 1.0)
            mean = (weight * logs).sum(axis=2) / np.where(total > 0, total, 1.0)
            cached = mean, total
            object.__setattr__(self, "_logs", cached)
        return cached

    def sphere_shift_sigmas(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """By which spheres were moved (spheres,), over their standard errors, RMS of three axes."""
        _, moves = self.split(numbers)
        shifts = [_whitened(one, move) for one, move in zip(self.highlights, moves, strict=True)]
        return np.sqrt(np.mean(np.square(shifts), axis=1))

    def shading_excess(self, numbers: NDArray[np.float64], alone: NDArray[np.float64]) -> float:
        """By how much the target is off beyond what noise explains, mean square; 1 if by chance.

        A likelihood ratio (S. S. Wilks, 1938): what the sum of squares of an arm fitted to
        everything is beyond that of one fitted without the target, with as many degrees of freedom
        as the target has samples, less the lamp's numbers and the law's. A target of another law is
        off by something smooth, which neighbouring points share; so what is off in level, slope and
        bend at each pose is held against noise by itself too, and the larger ratio counts.

        Parameters
        ----------
        numbers : (n,) array
            Fitted to everything, with the variances of the target as given.
        alone : (n,) array
            Fitted to all but the target.
        """
        from scipy.stats import chi2

        residuals = self.shading_residuals(self.split(numbers)[0])
        known = np.isfinite(residuals)
        poses = int(known.any(axis=(1, 2)).sum())
        free = 1 if self.shading.gains_unknown else 0
        alike = 1 / 3 if self.shading.is_monochrome else 1.0
        pulled = self._pull(numbers, alone)
        smooth = self._smooth_parts(residuals)
        total = pulled + float(np.sum(residuals[known] ** 2))
        shared = pulled + float(smooth @ smooth)
        fitted = LAMP.stop - LAMP.start + (0 if self.matt else TERMS)
        count = alike * known.sum() - free * len(self.shading.points) - fitted
        smooth_count = len(smooth) * (1 - free / max(poses, 1)) - fitted
        ratios = [1.0]
        for found, freedom in ((total, count), (shared, smooth_count)):
            if chi2.sf(found, max(freedom, 1.0)) < CHANCE:
                ratios.append(found / max(freedom, 1.0))
        return max(ratios)

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

    def _smooth_parts(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Level, slope and bend of residuals (poses, points, 3) over the target, unit variances."""
        points = self.shading.points - self.shading.points.mean(axis=0)
        _, size, axes = np.linalg.svd(points, full_matrices=False)
        u, v = (points @ axes[:2].T / (size[:2] / np.sqrt(len(points)))).T
        terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
        parts = []
        for one in residuals:
            seen = np.isfinite(one).all(axis=1)
            if seen.sum() >= len(terms.T):
                basis, _ = np.linalg.qr(terms[seen])
                parts.append(basis.T @ one[seen].sum(axis=1) / np.sqrt(3))
        return np.concatenate(parts) if parts else np.zeros(0)

    def residuals(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """All of them, the spheres' outlines and what is known of any arm among them."""
        return self._with_shading(numbers, self._lit(numbers))

    def _lit(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """The target's residuals, (m,); none where the target is left out."""
        if np.isinf(self.excess):
            return np.zeros(0)
        return self.shading_residuals(self.split(numbers)[0]).ravel()

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
