r"""The projector's response with its errors: by how much it bends fringes, before and after.

:mod:`acquisition.response_measurement` finds the response that a recording compensates. Here greys
that were shown again and again say how sure it is: light of each level with its standard error, the
exponent of the power law nearest to it, and the harmonics that it leaves in the phase of N steps,
:math:`\delta\varphi = \sum_k a_k \cos k\varphi + b_k \sin k\varphi` with k a multiple of N.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.projector_response import ProjectorResponse, phase_error_of
from calibration.errors import CalibrationError
from calibration.photon_transfer import Measured

_LEAST_LEVELS = 5
_LIT = 0.05
_LEAST_PIXELS = 100
_DRAWS = 64
_HARMONICS = 2


@dataclass(frozen=True)
class ResponseReport:
    """A projector's response.

    Attributes
    ----------
    response : ProjectorResponse
    levels : (n,) float64 array
        From 0 to 1.
    light : (n,) float64 array
        Of each, from 0 for black to 1 for white.
    sigma : (n,) float64 array
        Standard errors; those of black and white are 0 by definition.
    gamma : Measured
        Exponent of the nearest power law.
    deviation : float
        RMS by which the light is no power of the level.
    """

    response: ProjectorResponse
    levels: NDArray[np.float64]
    light: NDArray[np.float64]
    sigma: NDArray[np.float64]
    gamma: Measured
    deviation: float

    def harmonics(
        self, *, steps: int, compensated: bool = False, seed: int = 0
    ) -> tuple[Measured, ...]:
        """Amplitudes of the phase's errors by orders N and 2 N, rad.

        Parameters
        ----------
        steps : int
            N, 3 or more.
        compensated : bool
            Whether the fringes are shown through the inverse of the measured response: then what is
            left is what its errors leave.
        seed : int
            Of the draws by which errors are propagated.
        """
        if steps < 3:
            raise CalibrationError(f"{steps} steps determine no phase; show 3 or more")
        random = np.random.default_rng(seed)
        draws = [self._drawn(random) for _ in range(_DRAWS)]
        truth = np.array([_amplitudes(one, steps, None) for one in draws])
        if not compensated:
            value, sigma = _amplitudes(self.response, steps, None), truth.std(axis=0, ddof=1)
            return tuple(Measured(float(v), float(s)) for v, s in zip(value, sigma, strict=True))
        left = np.array([_amplitudes(one, steps, self.response) for one in draws])
        return tuple(
            Measured(float(v), float(s))
            for v, s in zip(np.sqrt((left**2).mean(axis=0)), left.std(axis=0, ddof=1), strict=True)
        )

    def _drawn(self, random: np.random.Generator) -> ProjectorResponse:
        """A response that the measurement would allow as well."""
        light = self.light + random.normal(0, 1, self.light.shape) * self.sigma
        return ProjectorResponse(light=_rising(light))


def report_response(
    greys: Mapping[float, Sequence[NDArray[np.generic]]], *, saturation_level: float
) -> ResponseReport:
    """Report the response by frames of uniform greys.

    Parameters
    ----------
    greys : mapping of float to sequence of (rows, cols) arrays
        Two frames or more of each level; levels evenly spaced from 0 to 1.
    saturation_level : float
        Sensor number from which samples are saturated.

    Raises
    ------
    CalibrationError
        Levels that are missing or not even, single frames, too few pixels that are lit and not
        saturated, or light that does not rise with the level.
    """
    levels = np.array(sorted(greys))
    if len(levels) < _LEAST_LEVELS or not np.allclose(levels, np.linspace(0, 1, len(levels))):
        raise CalibrationError(
            f"a response is measured on {_LEAST_LEVELS} greys or more, evenly from 0 to 1"
        )
    stacks = [
        np.stack([np.asarray(f, np.float64) for f in greys[level]]) for level in sorted(greys)
    ]
    if min(len(stack) for stack in stacks) < 2 or len({s.shape[1:] for s in stacks}) != 1:
        raise CalibrationError("each grey is shown in two frames or more, of one size")
    if not all(np.isfinite(stack).all() for stack in stacks):
        raise CalibrationError("a frame of greys has samples that are not finite")
    black, white = stacks[0].mean(axis=0), stacks[-1].mean(axis=0)
    told = (stacks[-1].max(axis=0) < saturation_level) & (white - black > _LIT * saturation_level)
    if told.sum() < _LEAST_PIXELS:
        raise CalibrationError(
            f"{int(told.sum())} pixels are lit and not saturated, and {_LEAST_PIXELS} are needed: "
            "choose another exposure"
        )
    # Sums over the lit pixels, frame by frame: the light of each frame with its flicker.
    each = [stack[:, told].sum(axis=1) for stack in stacks]
    means = np.array([frames.mean() for frames in each])
    freedom = sum(len(frames) - 1 for frames in each)
    # Relative scatter of frames, shared by all levels: a few frames of one tell it badly.
    noise = sum(float(np.sum((f / f.mean() - 1) ** 2)) for f in each) / freedom
    errors = means * np.sqrt(noise / np.array([len(frames) for frames in each]))
    span = means[-1] - means[0]
    light = (means - means[0]) / span
    # All levels share the errors of black and white.
    covariance = np.diag(errors**2)
    covariance += np.outer(1 - light, 1 - light) * errors[0] ** 2
    covariance += np.outer(light, light) * errors[-1] ** 2
    covariance /= span**2
    sigma = np.sqrt(np.diagonal(covariance)).copy()
    sigma[[0, -1]] = 0.0
    if not (np.diff(light) > -4 * (sigma[1:] + sigma[:-1])).all() or not span > 0:
        raise CalibrationError(
            "the light does not rise with the level: is the projector in a mode of its own?"
        )
    gamma, deviation = _power_law(levels, light, covariance)
    return ResponseReport(
        ProjectorResponse(light=_rising(light)), levels, light, sigma, gamma, deviation
    )


def _rising(light: NDArray[np.float64]) -> tuple[float, ...]:
    """The light made to rise, from 0 to 1."""
    least = np.arange(len(light)) * 1e-9
    risen = np.maximum.accumulate(np.clip(light, 0.0, 1.0)) + least
    risen = (risen - risen[0]) / (risen[-1] - risen[0])
    risen[0], risen[-1] = 0.0, 1.0
    return tuple(float(value) for value in risen)


def _power_law(
    levels: NDArray[np.float64], light: NDArray[np.float64], covariance: NDArray[np.float64]
) -> tuple[Measured, float]:
    """Exponent by weighted least squares, and RMS of what it leaves."""
    x, y = levels[1:-1], light[1:-1]
    inner = covariance[1:-1, 1:-1]
    weight = 1 / np.maximum(np.diagonal(inner), 1e-18)
    gamma = 1.0
    for _ in range(50):
        slope = x**gamma * np.log(x)
        lever = weight * slope / np.sum(weight * slope**2)
        step = float(lever @ (y - x**gamma))
        gamma = float(np.clip(gamma + step, 0.05, 20))
        if abs(step) < 1e-10:
            break
    left = y - x**gamma
    excess = float(np.sum(weight * left**2)) / max(len(x) - 1, 1)
    error = float(np.sqrt(lever @ inner @ lever * max(1.0, excess)))
    return Measured(gamma, error), float(np.sqrt(np.mean(left**2)))


def _amplitudes(
    response: ProjectorResponse, steps: int, through: ProjectorResponse | None
) -> NDArray[np.float64]:
    """Amplitudes of the orders N and 2 N that a response leaves in the phase, rad."""
    shown = response if through is None else _after(response, through)
    orders = [steps * (number + 1) for number in range(_HARMONICS)]
    shifts = 2 * np.pi * np.arange(steps) / steps
    waves = phase_error_of(shown, shifts_rad=shifts, gamma=1.0, orders=orders)
    return np.asarray(np.hypot(waves[:, 0], waves[:, 1]))


def _after(response: ProjectorResponse, inverse_of: ProjectorResponse) -> ProjectorResponse:
    """What a response gives of levels that another's inverse asks for."""
    light = np.linspace(0, 1, 129)
    return ProjectorResponse(light=_rising(response.light_of(inverse_of.level_of(light))))
