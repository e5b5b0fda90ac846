"""A flat white target under a light arm's lamp: what is seen of it, and what it should send.

See :mod:`calibration.light_arm` for the model of the arm and what is made of the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import robust_sigma
from calibration.arm_geometry import ArmParameters
from calibration.incidence_law import TERMS, incidence_factor
from calibration.lamp import fall_off
from devices.interfaces import ArmPose

# Chance below which a misfit is not taken for noise.
CHANCE = 1e-4
_LEAST_GAIN = 1e-6
_SHADOW_SIGMAS = 6.0
_LEAST_SHADOW = 0.03
# More samples off than this share are no shadow.
_SHADOWED = 0.05


def shadow_depth(off: NDArray[np.float64]) -> float:
    """By how much a sample of the target must be off to be in a shadow, as a logarithm.

    Parameters
    ----------
    off : (n,) float64 array
        Logarithms of samples over what light without shadows would make of them.
    """
    return max(_SHADOW_SIGMAS * robust_sigma(off), _LEAST_SHADOW)


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
class LitTarget:
    """A target's shading held against lamps: their light, its law and its gains.

    Attributes
    ----------
    shading : TargetShading
    poses : sequence of ArmPose
        Under which it was seen.
    matt : bool
        Whether the target follows Lambert's law; otherwise it departs from it by the incidence.
    excess : float
        By which the variances of the radiance are scaled.
    """

    shading: TargetShading
    poses: Sequence[ArmPose]
    matt: bool = True
    excess: float = 1.0

    def radiance(self, arm: ArmParameters) -> NDArray[np.float64]:
        """Radiance (poses, points, 3) with the law of incidence and the gains that suit it best."""
        predicted = self._by_incidence(arm)
        if self.shading.gains_unknown:
            predicted = predicted * self._gains_of(predicted)[:, np.newaxis]
        return predicted

    def residuals(self, arm: ArmParameters) -> NDArray[np.float64]:
        """(poses, points, 3) over their standard errors; NaN where not known."""
        shading = self.shading
        predicted = self.radiance(arm)
        return np.asarray((predicted - shading.radiance) / (shading.sigma * np.sqrt(self.excess)))

    def gains(self, arm: ArmParameters) -> NDArray[np.float64]:
        """Factors (points,) of the target's points that suit an arm best, 1 on average."""
        return self._gains_of(self._by_incidence(arm))

    def misfit(self, arm: ArmParameters) -> float:
        """Root mean square of the target's radiance over that predicted, less one."""
        predicted = self.radiance(arm)
        seen = np.isfinite(self.shading.radiance) & (predicted > 0)
        if not seen.any():
            return float("nan")
        off = self.shading.radiance[seen] / predicted[seen] - 1
        return float(np.sqrt(np.mean(off**2)))

    def without_shadows(self, arm: ArmParameters) -> TargetShading:
        """The shading without the few samples that no lamp explains: a shadow is upon them.

        The same object where there are none. At the target's corners a shadow on a point or two
        looks like a bend of the light, as long as each pose is looked at by itself.
        """
        shading = self.shading
        predicted = replace(self, matt=False).radiance(arm)
        known = np.isfinite(shading.radiance) & (shading.radiance > 0) & (predicted > 0)
        off = np.log(np.where(known, shading.radiance, 1) / np.where(known, predicted, 1))
        far = known & (np.abs(off) > shadow_depth(off[known]))
        if not 0 < far.sum() < _SHADOWED * known.sum():
            return shading
        seen = np.where(far.any(axis=2, keepdims=True), np.nan, shading.radiance)
        return replace(shading, radiance=seen)

    def excess_over_noise(self, arm: ArmParameters, *, pull: float, lamp_numbers: int) -> float:
        """By how much the target is off beyond what noise explains, mean square; 1 if by chance.

        A likelihood ratio (S. S. Wilks, 1938): what the sum of squares of an arm fitted to
        everything is beyond that of one fitted without the target, with as many degrees of freedom
        as the target has samples, less the lamp's numbers and the law's. A target of another law is
        off by something smooth, which neighbouring points share; so what is off in level, slope and
        bend at each pose is held against noise by itself too, and the larger ratio counts.

        Parameters
        ----------
        arm : ArmParameters
            Fitted to everything.
        pull : float
            By how much the sum of squares of all else grows as the target is listened to.
        lamp_numbers : int
            How many of the arm's numbers the target alone determines.
        """
        from scipy.stats import chi2

        residuals = self.residuals(arm)
        known = np.isfinite(residuals)
        poses = int(known.any(axis=(1, 2)).sum())
        free = 1 if self.shading.gains_unknown else 0
        alike = 1 / 3 if self.shading.is_monochrome else 1.0
        smooth = _smooth_parts(self.shading.points, residuals)
        total = pull + float(np.sum(residuals[known] ** 2))
        shared = pull + float(smooth @ smooth)
        fitted = lamp_numbers + (0 if self.matt else TERMS)
        count = alike * known.sum() - free * len(self.shading.points) - fitted
        smooth_count = len(smooth) * (1 - free / max(poses, 1)) - fitted
        ratios = [1.0]
        for found, freedom in ((total, count), (shared, smooth_count)):
            if chi2.sf(found, max(freedom, 1.0)) < CHANCE:
                ratios.append(found / max(freedom, 1.0))
        return max(ratios)

    def _by_incidence(self, arm: ArmParameters) -> NDArray[np.float64]:
        """Radiance (poses, points, 3) with the law of incidence that suits it best."""
        shading = self.shading
        places = arm.positions(self.poses)[:, np.newaxis]
        axes = arm.axes(self.poses)[:, np.newaxis]
        towards = places - shading.points
        cosine = np.maximum(towards @ shading.normal, 0) / np.linalg.norm(towards, axis=-1)
        light = fall_off(places, axes, arm.exponent, shading.points) * cosine
        if not self.matt:
            seen, weight = self._logarithms
            lit = light > 0
            light = light * incidence_factor(
                cosine,
                np.where(lit, seen - np.log(np.where(lit, light, 1.0)), 0.0),
                np.where(lit, weight, 0.0),
                by_point=shading.gains_unknown,
            )
        return np.asarray(light[..., np.newaxis] * arm.intensity * (shading.albedo / np.pi))

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

    @cached_property
    def _logarithms(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Of the target's radiance, mean over its colours (poses, points), and their weights."""
        seen, sigma = self.shading.radiance, self.shading.sigma
        known = np.isfinite(seen) & (seen > 0)
        seen = np.where(known, seen, 1.0)
        weight = np.where(known, (seen / np.where(known, sigma, 1.0)) ** 2, 0.0)
        total, by_colour = weight.sum(axis=2), weight.sum(axis=(0, 1))
        logs = np.log(seen)
        # Colours weigh otherwise from pose to pose: their levels must not differ.
        logs = logs - (weight * logs).sum(axis=(0, 1)) / np.where(by_colour > 0, by_colour, 1.0)
        mean = (weight * logs).sum(axis=2) / np.where(total > 0, total, 1.0)
        return mean, total


def _smooth_parts(
    points: NDArray[np.float64], residuals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Level, slope and bend of residuals (poses, points, 3) over the target, unit variances."""
    centred = points - points.mean(axis=0)
    _, size, axes = np.linalg.svd(centred, full_matrices=False)
    u, v = (centred @ axes[:2].T / (size[:2] / np.sqrt(len(points)))).T
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    parts = []
    for one in residuals:
        seen = np.isfinite(one).all(axis=1)
        if seen.sum() >= len(terms.T):
            basis, _ = np.linalg.qr(terms[seen])
            parts.append(basis.T @ one[seen].sum(axis=1) / np.sqrt(3))
    return np.concatenate(parts) if parts else np.zeros(0)
