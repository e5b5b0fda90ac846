r"""The light arm: where its lamp is at every pose, and what it sends from there.

A ring whose axis is z turns by the azimuth a; an arc on it carries the lamp at the elevation e:

.. math:: L = c + R\,R_z(a)\,\rho\,(\cos\epsilon,\ -\sin\lambda\,\sin\epsilon,\
   \cos\lambda\,\sin\epsilon), \qquad \epsilon = e + e_0 - s \cos(e + e_0)

with the ring's pose (R, c) in the rig's frame, which holds the zero of the azimuth too, the radius
ρ, the zero e₀ of the elevation, the lean λ of the arc and its sag s under gravity. The lamp shines
at a point fixed to the ring and is that of :mod:`calibration.lamp`.

What is fitted: highlights on mirror spheres, as directions from a sphere to the lamp, and the
radiance of a flat white target. The spheres' places are fitted with them, held by their outlines:
an error there is shared by all poses, and so belongs in the covariance. NLopt's SLSQP (D. Kraft,
1988) minimises the sum of squares in parameters scaled by their own covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import nan_robust_sigma
from calibration.arm_fit import INTENSITY, LAMP, ArmProblem, SphereHighlights
from calibration.arm_geometry import ArmParameters, initial_arm
from calibration.errors import CalibrationError
from calibration.lamp import Lamp
from calibration.lens import Lens
from calibration.target_shading import CHANCE, TargetShading
from devices.interfaces import ArmPose

__all__ = ["LightArm", "SphereHighlights", "TargetShading", "fit_light_arm"]

_LEAST_POSES = 6
# Of the lamp's directions across the ring's axis, RMS along the narrower side.
_LEAST_SPREAD = 0.05
# In which a target that agrees with the highlights is fitted together with them: six is usual.
_TRIAL_ROUNDS = 12
# How often a target that does not agree is weighted by what is left of its misfit.
_WEIGHTINGS = 4
_OUTLIER_SIGMAS = 6.0
# Of a lamp's fall-off, to start from: at 0 a fit in its root would not know where to go.
_EXPONENTS = (0.5, 100.0)
# Standard error of a light's direction beyond which a calibration is of no use.
_LARGEST_SIGMA_DEG = 0.5


@dataclass(frozen=True)
class LightArm:
    """A calibrated light arm, in the rig's frame (that of the camera).

    Attributes
    ----------
    parameters : ArmParameters
    covariance : (17, 17) float64 array
        Of the parameters, in their order.
    poses : tuple of ArmPose
        That were fitted.
    residual_deg : (poses,) float64 array
        Angle by which the lamp misses where its highlights say it is, RMS over the spheres; NaN
        where there was no highlight.
    suspect : tuple of int
        Poses whose highlights are off by more than noise explains.
    inflation : float
        By which variances were scaled, since all highlights are off by more than noise explains.
    shading_excess : float
        Likewise of the target's radiance: above 1, the lamp's anisotropy is another one, or the
        target reflects by more than the incidence.
    target_gains : (points,) float64 array or None
        Factors of the target's points, where they were not known.
    shading_misfit : float
        Root mean square relative error of the target's radiance; NaN where it was not kept.
    sphere_shift_sigmas : (spheres,) float64 array
        How far the highlights moved each sphere from where its outline is, root mean square over
        three axes, in standard errors; empty where it was not kept.
    radius_error, radius_sigma : float
        By which the target's shading says that the spheres' radius is larger than it was given,
        relative, and its standard error, by variances as :attr:`inflation` scales them; NaN where
        it was not kept.
    matt : bool
        Whether the target follows Lambert's law; otherwise one of its own by the incidence.
    placed_by_highlights : bool
        Whether the target was not believed where the lamp is: it contradicts the highlights.
    """

    parameters: ArmParameters
    covariance: NDArray[np.float64]
    poses: tuple[ArmPose, ...]
    residual_deg: NDArray[np.float64]
    suspect: tuple[int, ...]
    inflation: float
    shading_excess: float
    target_gains: NDArray[np.float64] | None = None
    shading_misfit: float = float("nan")
    sphere_shift_sigmas: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    radius_error: float = float("nan")
    radius_sigma: float = float("nan")
    matt: bool = True
    placed_by_highlights: bool = False

    def lamp(self, pose: ArmPose) -> Lamp:
        """The lamp at a pose."""
        return self.parameters.lamp(pose)

    def direction_covariance(
        self, pose: ArmPose, point: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Covariance (3, 3), rad², of the unit vector from a point (3,) to the lamp."""
        numbers = self.parameters.as_array()
        sigmas = np.sqrt(np.diagonal(self.covariance))
        jacobian = np.zeros((3, len(numbers)))
        for number in np.flatnonzero(sigmas > 0):
            step = np.zeros(len(numbers))
            step[number] = 0.02 * sigmas[number]
            ends = [
                self.parameters.moved(sign * step).lamp(pose).directions(point) for sign in (1, -1)
            ]
            jacobian[:, number] = (ends[0] - ends[1]) / (2 * step[number])
        return np.asarray(jacobian @ self.covariance @ jacobian.T)

    def direction_sigma_deg(self, pose: ArmPose, point: NDArray[np.float64]) -> float:
        """Standard error of the direction to the lamp along its worst axis, degrees."""
        worst = np.linalg.eigvalsh(self.direction_covariance(pose, point))[-1]
        return float(np.degrees(np.sqrt(worst)))


def fit_light_arm(
    poses: Sequence[ArmPose],
    highlights: Sequence[SphereHighlights],
    shading: TargetShading,
    lens: Lens,
) -> LightArm:
    """Fit the arm and its lamp.

    Parameters
    ----------
    poses : sequence of ArmPose
        As the arm reports them.
    highlights : sequence of SphereHighlights
        Of two spheres or more.
    shading : TargetShading
    lens : Lens
        Of the camera.

    Returns
    -------
    LightArm

    Raises
    ------
    CalibrationError
        Too little was seen, shapes do not fit, or the fit does not determine the directions.
    """
    _check(poses, highlights, shading)
    problem = ArmProblem(tuple(poses), tuple(highlights), shading, lens)
    start = initial_arm(
        problem.poses,
        problem.spots,
        level=_usual_level(shading),
        target=shading.points.mean(axis=0),
    )
    numbers = np.concatenate([start.as_array(), np.zeros(3 * len(highlights))])
    # First the highlights tell where the lamp is, and then the target what it sends.
    base = problem.around(start).of_highlights()
    numbers = base.minimise(numbers)
    misses = base.misses(numbers)
    wild = np.sqrt(np.nansum(misses**2, axis=2)) > _OUTLIER_SIGMAS * max(
        1.0, nan_robust_sigma(misses)
    )
    if wild.any():
        base = base.of_highlights(wild)
        numbers = base.minimise(numbers)
    placed = numbers
    lamp = base.of_lamp()
    arm, _ = lamp.split(placed)
    numbers = placed.copy()
    numbers[: len(arm.as_array())] += _lamp_step(arm, problem.poses, shading)
    numbers = lamp.minimise(numbers)
    for _ in range(_WEIGHTINGS):
        lit = lamp.without_shadows(numbers)
        if lit is lamp:
            break
        lamp = lit
        numbers = lamp.minimise(numbers)
    # A target that agrees with the highlights tells of the place too. One that does not errs alike
    # under all poses, which no weight of single samples accounts for: it would move the arm. Where
    # the highlights leave the arm is no place to ask: the lamp's numbers go far astray with it.
    for everything in (lamp.of_all(1.0), lamp.of_all(1.0).of_any_law()):
        try:
            together = everything.minimise(numbers, rounds=_TRIAL_ROUNDS)
        except CalibrationError:
            # So far from the truth that no step helps; how far, its excess says.
            together = numbers
        excess = everything.shading_excess(together, placed)
        radius = everything.radius_error(together)
        if excess == 1:
            return _result(everything, everything, together, excess=excess, radius=radius)
    # What is left has no known form; it is noise to a joint fit, if that leaves the highlights be.
    for _ in range(_WEIGHTINGS):
        everything = everything.of_all(excess)
        together = everything.minimise(together)
        left = everything.of_all(1.0).shading_excess(together, placed)
        if left > 0.5 * excess:
            break
        excess = left
    radius = everything.radius_error(together)
    if everything.agrees(together, placed):
        return _result(everything, everything, together, excess=excess, radius=radius)
    numbers = _with_lamp_of(together, numbers, everything)
    return _result(everything, base, numbers, excess=excess, radius=radius)


def _with_lamp_of(
    together: NDArray[np.float64], numbers: NDArray[np.float64], problem: ArmProblem
) -> NDArray[np.float64]:
    """Numbers with the lamp of others, as bright on the target's middle as there."""
    middle = problem.shading.points.mean(axis=0)
    squares = [
        np.sum((problem.split(n)[0].positions(problem.poses) - middle) ** 2, axis=1)
        for n in (numbers, together)
    ]
    mixed = numbers.copy()
    mixed[LAMP] = together[LAMP]
    mixed[INTENSITY] += np.mean(np.log(squares[0] / squares[1]))
    return mixed


def _check(
    poses: Sequence[ArmPose], highlights: Sequence[SphereHighlights], shading: TargetShading
) -> None:
    if len(highlights) < 2:
        raise CalibrationError(
            f"{len(highlights)} mirror spheres: a lamp close by is found from two or more"
        )
    if len(poses) < _LEAST_POSES:
        raise CalibrationError(
            f"{len(poses)} poses of the light arm: {_LEAST_POSES} or more are needed"
        )
    azimuth, elevation = np.array([[pose.azimuth, pose.elevation] for pose in poses]).T
    across = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1) * np.cos(elevation)[:, np.newaxis]
    spread = np.linalg.svd(across - across.mean(axis=0), compute_uv=False)
    if spread[1] < _LEAST_SPREAD * np.sqrt(len(poses)):
        raise CalibrationError(
            "the poses of the light arm are too alike: spread them over azimuth and elevation"
        )
    for number, one in enumerate(highlights, start=1):
        seen = np.isfinite(one.pixels)
        if one.pixels.shape != (len(poses), 2) or not one.sigma_px > 0:
            raise CalibrationError(
                f"sphere {number}: a pixel per pose and a positive standard error are needed"
            )
        if seen.all(axis=1).sum() < _LEAST_POSES:
            raise CalibrationError(
                f"sphere {number} shows the lamp at {int(seen.all(axis=1).sum())} poses, and "
                f"{_LEAST_POSES} are needed: turn it or choose poses that it reflects"
            )
    count = len(shading.points)
    if shading.radiance.shape != (len(poses), count, 3) or shading.sigma.shape != (
        shading.radiance.shape
    ):
        raise CalibrationError("the target's radiance is one RGB value per pose and point")
    known = np.isfinite(shading.radiance)
    if known.sum() < 100 or not (shading.sigma[known] > 0).all():
        raise CalibrationError("the white target was hardly seen, or its errors are not positive")
    if not (np.isfinite(shading.points).all() and np.isfinite(shading.normal).all()):
        raise CalibrationError("the white target has points that are not finite")


def _usual_level(shading: TargetShading) -> NDArray[np.float64]:
    level = np.nanmedian(shading.radiance, axis=(0, 1)) * np.pi / shading.albedo
    if not (level > 0).all():
        raise CalibrationError("the white target is dark: was the lamp lit, and black subtracted?")
    return np.asarray(level)


def _lamp_step(
    arm: ArmParameters, poses: Sequence[ArmPose], shading: TargetShading
) -> NDArray[np.float64]:
    """Step of an arm's numbers to the lamp that explains the target best: linear in logarithms."""
    numbers = arm.as_array()
    places, axes = arm.positions(poses)[:, np.newaxis], arm.axes(poses)[:, np.newaxis]
    towards = places - shading.points
    distance = np.linalg.norm(towards, axis=-1)
    facing = towards @ shading.normal / distance
    from_axis = -np.sum(towards * axes, axis=-1) / distance
    lit = ((facing > 0.05) & (from_axis > 0.05))[..., np.newaxis]
    share = np.where(lit[..., 0], distance**2 / np.where(lit[..., 0], facing, 1), 1.0)
    light = shading.radiance * share[..., np.newaxis] * np.pi / shading.albedo
    use = lit & np.isfinite(light) & (light > 0)
    count = use.sum(axis=(0, 1))
    if not count.all():
        return np.zeros_like(numbers)
    value = np.where(use, np.log(np.where(use, light, 1.0)), 0.0)
    slope = np.where(use, np.log(np.where(lit[..., 0], from_axis, 1.0))[..., np.newaxis], 0.0)
    # With gains that are not known, a point is compared with itself under other poses.
    over = 0 if shading.gains_unknown else (0, 1)
    seen = np.maximum(use.sum(axis=over, keepdims=True), 1)
    off = [np.where(use, a - a.sum(axis=over, keepdims=True) / seen, 0) for a in (value, slope)]
    exponent = np.sum(off[0] * off[1]) / max(float(np.sum(off[1] ** 2)), 1e-12)
    exponent = float(np.clip(exponent, *_EXPONENTS))
    level = (value.sum(axis=(0, 1)) - exponent * slope.sum(axis=(0, 1))) / count
    return replace(arm, exponent=exponent, intensity=np.exp(level)).as_array() - numbers


def _covariance(
    problem: ArmProblem, placing: ArmProblem, numbers: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Covariance of all numbers, where ``placing`` tells how well all but the lamp's are known.

    The lamp's numbers are those that suit the target best with the arm where it is, and so move
    with it.
    """
    of_place = _inverse(placing.jacobian(numbers))
    if placing is problem:
        return of_place
    jacobian = problem.jacobian(numbers)
    is_lamp = np.zeros(len(numbers), np.bool_)
    is_lamp[LAMP] = True
    of_lamp = _inverse(jacobian[:, is_lamp])
    follows = np.eye(len(numbers))[:, ~is_lamp]
    follows[is_lamp] = -of_lamp @ jacobian[:, is_lamp].T @ jacobian[:, ~is_lamp]
    covariance = follows @ of_place[np.ix_(~is_lamp, ~is_lamp)] @ follows.T
    covariance[np.ix_(is_lamp, is_lamp)] += of_lamp
    return np.asarray(covariance)


def _inverse(jacobian: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of numbers by the derivatives of residuals of unit variance."""
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0] = 1.0
    normal = (jacobian / scale).T @ (jacobian / scale)
    inverse = np.linalg.pinv(normal, rcond=1e-13, hermitian=True)
    return np.asarray(inverse / np.outer(scale, scale))


def _result(
    problem: ArmProblem,
    placing: ArmProblem,
    numbers: NDArray[np.float64],
    *,
    excess: float,
    radius: tuple[float, float],
) -> LightArm:
    from scipy.stats import chi2

    misses = placing.misses(numbers, rejected=True)
    arm, _ = problem.split(numbers)
    # Numbers count from the start's pose; the covariance is to count from the arm's own.
    same = placing is problem
    problem = problem.around(arm)
    placing = problem if same else placing.around(arm)
    numbers = np.concatenate([arm.as_array(), numbers[len(arm.as_array()) :]])
    covariance = _covariance(problem, placing, numbers)
    kept = problem.misses(numbers)
    total, freedom = float(np.nansum(kept**2)), int(np.isfinite(kept).sum()) - 10
    inflation = 1.0
    if freedom > 0 and chi2.sf(total, freedom) < CHANCE:
        inflation = total / freedom
    squares = np.nansum(misses**2, axis=(1, 2)) / inflation
    seen = np.isfinite(misses).sum(axis=(1, 2))
    chance = CHANCE / len(problem.poses)
    suspect = np.flatnonzero((seen > 0) & (chi2.sf(squares, np.maximum(seen, 1)) < chance))
    count = len(arm.as_array())
    fitted = LightArm(
        arm,
        covariance[:count, :count] * inflation,
        problem.poses,
        problem.misses_deg(numbers),
        tuple(int(n) for n in suspect),
        inflation,
        excess,
        problem.target.gains(arm) if problem.shading.gains_unknown else None,
        problem.target.misfit(arm),
        problem.sphere_shift_sigmas(numbers),
        radius[0],
        radius[1] * float(np.sqrt(inflation)),
        matt=problem.matt,
        placed_by_highlights=not same,
    )
    middle = problem.shading.points.mean(axis=0)
    worst = max(fitted.direction_sigma_deg(pose, middle) for pose in problem.poses)
    if not worst <= _LARGEST_SIGMA_DEG:
        raise CalibrationError(
            f"light directions are known to {worst:.2g}° only: photograph more poses, spread over "
            "azimuth and elevation, and put the spheres farther apart"
        )
    return fitted
