r"""Photon transfer: what a sensor's numbers mean, from pairs of frames of even light.

The variance of a sample is :math:`\sigma_r^2 + K (m - b)` at mean m: photons are counted, K numbers
to each electron (J. R. Janesick, *Photon Transfer*, SPIE 2007; EMVA standard 1288). Two frames of
the same light tell it without the sensor's fixed pattern, which their difference takes out. The
black level b comes from frames without light, the linearity from means against exposure times, the
full well from where the numbers end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.sample_noise import SampleNoise
from calibration.errors import CalibrationError

_QUANTISATION = 1 / 12
_LEAST_PIXELS = 400
_LEAST_LEVELS = 4
# Share of samples at the highest number from which that number is the ceiling.
_CEILING_SHARE = 0.02
# Of the ceiling above black: beyond, some samples of a level may already be cut off.
_UNCUT_SIGMAS = 6.0
_ROUNDS = 4


@dataclass(frozen=True)
class FlatPair:
    """Two frames of one light at one exposure.

    Attributes
    ----------
    exposure_s : float
        As the camera applied it.
    first, second : (rows, cols) arrays
        Sensor numbers, of one colour of a mosaic.
    """

    exposure_s: float
    first: NDArray[np.generic]
    second: NDArray[np.generic]


@dataclass(frozen=True)
class Measured:
    """A number with its standard error."""

    value: float
    sigma: float

    def __str__(self) -> str:
        return f"{self.value:.4g} ± {self.sigma:.2g}"


@dataclass(frozen=True)
class PhotonTransfer:
    """A sensor's numbers.

    Attributes
    ----------
    black_level : Measured
        Sensor numbers.
    gain : Measured
        K, sensor numbers per electron.
    read_noise_e : Measured
        Electrons.
    saturation_level : float or None
        Sensor number at which samples end; None if no frame was bright enough.
    full_well_e : Measured or None
        Electrons there.
    levels : (n,) float64 array
        Means above black of the pairs that were used.
    variances : (n,) float64 array
        Temporal variance of a sample there.
    rate : Measured
        Sensor numbers above black per second.
    nonlinearity : (n,) float64 array
        Relative deviation of each level from the line through black.
    nonlinearity_sigma : (n,) float64 array
    excess : float
        Mean square of the variances' misfit over its error; far above 1 is no photon noise.
    """

    black_level: Measured
    gain: Measured
    read_noise_e: Measured
    saturation_level: float | None
    full_well_e: Measured | None
    levels: NDArray[np.float64]
    variances: NDArray[np.float64]
    rate: Measured
    nonlinearity: NDArray[np.float64]
    nonlinearity_sigma: NDArray[np.float64]
    excess: float

    def sample_noise(self) -> SampleNoise:
        """The noise model as decoding and HDR merging take it, by the level above black."""
        read = (self.read_noise_e.value * self.gain.value) ** 2 + _QUANTISATION
        return SampleNoise(read, self.gain.value, "photon transfer")


def measure_photon_transfer(
    pairs: Sequence[FlatPair], darks: Sequence[NDArray[np.generic]]
) -> PhotonTransfer:
    """Measure a sensor.

    Parameters
    ----------
    pairs : sequence of FlatPair
        Of even light, from weak to saturating.
    darks : sequence of (rows, cols) arrays
        Two frames or more without light.

    Returns
    -------
    PhotonTransfer

    Raises
    ------
    CalibrationError
        Too few frames, levels or pixels, frames of different sizes or not finite, frames that are
        no different from one another, or a variance that does not grow with the light.
    """
    _check(pairs, darks)
    black, dark_variance, dark_sigma = _dark(darks)
    saturation = _ceiling(pairs)
    levels, variances, sigmas, exposures, mean_sigmas = _levels(pairs, black, saturation)
    gain, read, excess = _fit_line(levels, variances, sigmas, dark_variance, dark_sigma)
    noise = np.sqrt(max(read.value, 0.0))
    electrons = noise / gain.value
    spread = read.sigma / (2 * max(noise, np.sqrt(read.sigma))) / gain.value
    read_e = Measured(electrons, float(np.hypot(spread, electrons * gain.sigma / gain.value)))
    full = None
    if saturation is not None:
        depth = (saturation - black.value) / gain.value
        relative = np.hypot(gain.sigma / gain.value, black.sigma / (saturation - black.value))
        full = Measured(depth, float(depth * relative))
    rate, off, off_sigma = _linearity(levels, exposures, mean_sigmas, black.sigma)
    return PhotonTransfer(
        black, gain, read_e, saturation, full, levels, variances, rate, off, off_sigma, excess
    )


def _check(pairs: Sequence[FlatPair], darks: Sequence[NDArray[np.generic]]) -> None:
    if len(darks) < 2:
        raise CalibrationError(f"{len(darks)} dark frames: two or more tell the read noise")
    if len(pairs) < _LEAST_LEVELS:
        raise CalibrationError(
            f"{len(pairs)} pairs of flat frames: {_LEAST_LEVELS} levels or more are needed"
        )
    shape = np.shape(darks[0])
    frames = [*darks, *(frame for pair in pairs for frame in (pair.first, pair.second))]
    if any(np.shape(frame) != shape or len(shape) != 2 for frame in frames):
        raise CalibrationError("frames of photon transfer are pictures of one size")
    if shape[0] * shape[1] < _LEAST_PIXELS:
        raise CalibrationError(f"{shape[0]}×{shape[1]} pixels are too few for photon transfer")
    if not all(np.isfinite(frame).all() for frame in frames):
        raise CalibrationError("a frame of photon transfer has samples that are not finite")
    if not all(np.isfinite(pair.exposure_s) and pair.exposure_s > 0 for pair in pairs):
        raise CalibrationError("exposure times are positive and finite")
    for pair in pairs:
        if np.array_equal(pair.first, pair.second) and np.ptp(pair.first):
            raise CalibrationError(
                f"both frames at {pair.exposure_s:g} s are the same one: take two"
            )


def _dark(darks: Sequence[NDArray[np.generic]]) -> tuple[Measured, float, float]:
    """Black level, and the temporal variance of a dark sample with its error."""
    stack = np.stack([np.asarray(frame, np.float64) for frame in darks])
    pixels, count = stack[0].size, len(stack)
    variance = float(stack.var(axis=0, ddof=1).mean())
    # Frames are only as alike as their means.
    means = stack.mean(axis=(1, 2))
    between = max(float(means.var(ddof=1)), variance / pixels)
    sigma = variance * np.sqrt(2 / ((count - 1) * pixels))
    return Measured(float(means.mean()), float(np.sqrt(between / count))), variance, sigma


def _ceiling(pairs: Sequence[FlatPair]) -> float | None:
    brightest = max(pairs, key=lambda pair: pair.exposure_s)
    frame = np.asarray(brightest.first, np.float64)
    top = float(frame.max())
    return top if np.mean(frame >= top) >= _CEILING_SHARE else None


def _levels(
    pairs: Sequence[FlatPair], black: Measured, saturation: float | None
) -> tuple[NDArray[np.float64], ...]:
    """Means, variances, errors of the variances, exposures, errors of the means."""
    found = []
    for pair in sorted(pairs, key=lambda pair: pair.exposure_s):
        first, second = np.asarray(pair.first, np.float64), np.asarray(pair.second, np.float64)
        difference = first - second
        # Light that flickers moves both means; it is no noise of the samples.
        variance = float(difference.var(ddof=1)) / 2
        mean = 0.5 * (first + second)
        if saturation is not None:
            highest = max(float(first.max()), float(second.max()))
            near = mean.mean() + _UNCUT_SIGMAS * np.sqrt(max(variance, 0.0)) >= saturation
            if highest >= saturation or near:
                continue
        pixels = first.size
        flicker = 0.5 * abs(float(difference.mean()))
        sigma_mean = np.hypot(np.sqrt(variance / (2 * pixels)), flicker)
        found.append(
            (
                float(mean.mean()) - black.value,
                variance,
                max(variance, _QUANTISATION) * np.sqrt(2 / (pixels - 1)),
                pair.exposure_s,
                sigma_mean,
            )
        )
    if len(found) < _LEAST_LEVELS - 1:
        raise CalibrationError(
            f"only {len(found)} levels below saturation: take shorter exposures too"
        )
    return tuple(np.array(column) for column in zip(*found, strict=True))


def _fit_line(
    levels: NDArray[np.float64],
    variances: NDArray[np.float64],
    sigmas: NDArray[np.float64],
    dark_variance: float,
    dark_sigma: float,
) -> tuple[Measured, Measured, float]:
    """Gain, and variance of the read noise without quantisation."""
    x = np.concatenate([[0.0], levels])
    y = np.concatenate([[dark_variance], variances]) - _QUANTISATION
    error = np.concatenate([[dark_sigma], sigmas])
    matrix = np.stack([np.ones_like(x), x], axis=1)
    model = np.maximum(y, 0) + _QUANTISATION
    for _ in range(_ROUNDS):
        # By the fitted variance, not the measured one, whose low values would weigh too much.
        relative = error / np.maximum(y + _QUANTISATION, 1e-12)
        sigma = np.maximum(relative * model, 1e-12)
        weighted = matrix / sigma[:, np.newaxis]
        covariance = np.linalg.inv(weighted.T @ weighted)
        read, gain = covariance @ (weighted.T @ (y / sigma))
        model = np.maximum(matrix @ np.array([read, gain]), 0) + _QUANTISATION
    if not gain > 3 * np.sqrt(covariance[1, 1]):
        raise CalibrationError(
            "the samples' variance does not grow with the light: the frames were smoothed or "
            "altered by the camera, or the lamp was not lit"
        )
    misfit = float(np.mean(((y - matrix @ np.array([read, gain])) / sigma) ** 2))
    excess = misfit * len(x) / max(len(x) - 2, 1)
    errors = np.sqrt(np.diagonal(covariance))
    return Measured(float(gain), float(errors[1])), Measured(float(read), float(errors[0])), excess


def _linearity(
    levels: NDArray[np.float64],
    exposures: NDArray[np.float64],
    sigmas: NDArray[np.float64],
    black_sigma: float,
) -> tuple[Measured, NDArray[np.float64], NDArray[np.float64]]:
    sigma = np.hypot(sigmas, black_sigma)
    weight = 1 / np.maximum(sigma, 1e-12) ** 2
    information = float(np.sum(weight * exposures**2))
    rate = float(np.sum(weight * exposures * levels)) / information
    if not rate > 0:
        raise CalibrationError("the light does not grow with the exposure time")
    predicted = rate * exposures
    return (
        Measured(rate, 1 / np.sqrt(information)),
        np.asarray(levels / predicted - 1, np.float64),
        np.asarray(sigma / predicted, np.float64),
    )
