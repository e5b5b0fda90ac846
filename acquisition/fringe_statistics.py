r"""What a sample of the pixels tells of a fringe: harmonics, and systematic disagreement.

*Residual of a fit.* For noise alone, the sum of squared residuals of N steps is, in variances of a
sample, chi-square with N - 3 degrees of freedom. Photon noise makes the samples' variances unequal;
the limit is then taken from a gamma distribution of equal mean and variance (Satterthwaite), at the
phase where the tail is longest. Harmonics of the projector's response leave a residual in
proportion to the modulation, the same all over the picture: its size is read off the median pixel,
and added. A pixel beyond both is lit by more than one fringe.

*Steps that contradict one another.* Harmonic h leaves a residual of order h in the phase. Frames
out of order, or one that is dark, leave one of orders 0 and 1, or more than any harmonics do.

*Disagreement of two fringes.* Noise has a known spread; harmonics of either fringe and errors of
the description shift the coarse coordinate systematically and by a bounded amount, read off the
median deviation. For a sinusoid the amplitude is √2 times the standard deviation.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import special

from acquisition.frame_files import Samples
from acquisition.fringes import Fringe
from acquisition.robust_spread import MEDIAN_TO_SIGMA
from acquisition.unwrapping import certainty_sigmas

# The noise model itself is taken to be known to so much.
_NOISE_MARGIN = 1.05
# With three steps the samples that are wrong also tell the variance by photon noise: when they err
# by four standard deviations they understate one by up to this.
_THREE_STEPS_MARGIN = 1.1
# What float32 leaves of a squared modulation.
_ROUNDING = 4e-6
_LEAST_PIXELS = 50
# Mean squares of a residual, per step and in squared modulations, that harmonics do not leave (a
# response to the power of three leaves 0.08), and from which the order is looked at.
_LARGEST_RESIDUAL = 0.12
_SUSPECT_RESIDUAL = 0.005
_PHASE_BINS = 16
_MANY_PERIODS = 8
_LEAST_OF_A_BIN = 8


def squares_limit(fringe: Fringe, false_alarm: float) -> float:
    """Sum of squared residuals that noise exceeds with a probability, in variances of a sample.

    Infinite where there are no more steps than unknowns.
    """
    if fringe.steps <= 3:
        return float("inf")
    return _squares_limit(tuple(fringe.shifts_rad), false_alarm)


@lru_cache(maxsize=64)
def _squares_limit(shifts: tuple[float, ...], false_alarm: float) -> float:
    delta = np.array(shifts)
    design = np.stack([np.ones_like(delta), np.cos(delta), np.sin(delta)], axis=1)
    remainder = np.eye(len(delta)) - design @ np.linalg.pinv(design)
    largest = 0.0
    for phase in np.linspace(0, 2 * np.pi, 32, endpoint=False):
        for contrast in (0.0, 1.0):
            spread = remainder * (1 + contrast * np.cos(phase + delta))
            mean, square = np.trace(spread), np.trace(spread @ spread)
            if mean > 1e-9:
                limit = square / mean * special.chdtri(mean**2 / square, false_alarm)
                largest = max(largest, float(limit))
    return _NOISE_MARGIN * largest


@lru_cache(maxsize=64)
def _median_of_chi_square(degrees_of_freedom: int) -> float:
    return float(special.chdtri(degrees_of_freedom, 0.5))


def residual_harmonics(
    squares: NDArray[np.floating],
    modulation: NDArray[np.floating],
    noise_variance: NDArray[np.floating],
    *,
    degrees_of_freedom: int,
) -> float:
    """Root of the squared residuals that harmonics leave, in modulations.

    Parameters
    ----------
    squares, modulation, noise_variance : (n,) arrays
        Sum of squared residuals, modulation, and variance of a sample, of pixels in good light.
    degrees_of_freedom : int
        Of the residuals.

    Returns
    -------
    float
        At the phase where it is largest: with one degree of freedom that is twice, in squares, what
        the median phase leaves.
    """
    if degrees_of_freedom < 1 or len(squares) < _LEAST_PIXELS:
        return float(np.sqrt(_ROUNDING))
    excess = squares - _median_of_chi_square(degrees_of_freedom) * noise_variance
    typical = max(0.0, _middle(excess / modulation**2))
    return float(np.sqrt(2 * typical + _ROUNDING))


def steps_contradict(fringe: Fringe, samples: Samples, residual: float, extent: int) -> bool:
    """Whether the frames of a fringe are not the steps that they are taken for.

    Parameters
    ----------
    fringe : Fringe
    samples : (steps, n) array
        Of pixels in good light.
    residual : float
        From :func:`residual_harmonics`.
    extent : int
        Pixels of the panel along the fringe's axis.
    """
    typical = residual**2 / 2 / fringe.steps
    if typical < _SUSPECT_RESIDUAL or samples.shape[1] < _LEAST_PIXELS:
        return False
    if typical > _LARGEST_RESIDUAL:
        return True
    level, c, s = fringe.fit.solution @ samples
    left = (samples - fringe.fit.design @ np.stack([level, c, s])) / np.hypot(c, s)
    place = (np.arctan2(s, c) / (2 * np.pi) % 1 * _PHASE_BINS).astype(np.intp) % _PHASE_BINS
    count = np.bincount(place, minlength=_PHASE_BINS)
    met = count >= _LEAST_OF_A_BIN
    if met.sum() < _PHASE_BINS / 2:
        # Over a small part of the period one order passes for another. Of a fringe of which the
        # panel shows many a part would not be seen alone.
        return fringe.period_px < extent / _MANY_PERIODS
    by_phase = np.stack([np.bincount(place, row, _PHASE_BINS)[met] / count[met] for row in left])
    angle = 2 * np.pi * (np.flatnonzero(met) + 0.5) / _PHASE_BINS
    of_steps = _unexplained(by_phase.T, [np.ones(len(angle)), np.cos(angle), np.sin(angle)])
    of_harmonics = [wave(order * angle) for order in (2, 3) for wave in (np.cos, np.sin)]
    return of_steps < 0.5 * _unexplained(by_phase.T, of_harmonics)


def _unexplained(observed: NDArray[np.float64], terms: list[NDArray[np.float64]]) -> float:
    """Sum of squares that least squares leaves."""
    design = np.stack(terms, axis=1)
    solution = np.linalg.lstsq(design, observed, rcond=None)[0]
    return float(((observed - design @ solution) ** 2).sum())


def disagreement_limit(fringe: Fringe, false_alarm: float) -> float:
    """Standard deviations by which noise makes two fringes disagree with a probability."""
    sigmas = np.sqrt(_NOISE_MARGIN) * certainty_sigmas(false_alarm)
    return float(sigmas * (_THREE_STEPS_MARGIN if fringe.steps == 3 else 1.0))


def systematic_disagreement(
    apart: NDArray[np.floating], variance: NDArray[np.floating], *, largest: float
) -> float:
    """Amplitude of the disagreement of two coordinates that noise does not explain.

    Parameters
    ----------
    apart, variance : (n,) arrays
        Disagreement, and its variance by noise.
    largest : float
        The amplitude is at most this.
    """
    if len(apart) < _LEAST_PIXELS:
        return 0.0
    spread = MEDIAN_TO_SIGMA * _middle(np.abs(apart))
    excess = spread**2 - _middle(variance)
    return min(largest, float(np.sqrt(2 * max(0.0, excess))))


def _middle(values: NDArray[np.floating]) -> float:
    """Median, of an even number the upper one; without what numpy's checks cost."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])
