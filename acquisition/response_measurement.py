"""Measuring a projector's response, from uniform greys or from what fringes show of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import DecodingError
from acquisition.frame_stream import ReadFrame
from acquisition.fringes import Fringe
from acquisition.harmonics import PhaseSeries
from acquisition.patterns import Uniform
from acquisition.plan import Plan
from acquisition.projector_response import LEVELS, ProjectorResponse, phase_error_of

# Of the ceiling, for white less black of a pixel that tells the response.
_LIT = 0.1
_LEAST_PIXELS = 100
# Segments of a response that fringes tell, and how little reason they need to differ.
_SEGMENTS = 6
_SMOOTHNESS = 1.0
# What no smooth response explains of a phase error, rad.
_MODEL_ERROR_RAD = 0.002
# By which light must rise from one level to the next.
_LEAST_RISE = 1e-6


def measure_response(plan: Plan, read_frame: ReadFrame) -> ProjectorResponse:
    """The response by uniform greys, from black to white in even steps.

    Parameters
    ----------
    plan : Plan
        With frames of :class:`~acquisition.patterns.Uniform` patterns.
    read_frame : callable
        Takes a frame id to its samples.

    Returns
    -------
    ProjectorResponse

    Raises
    ------
    DecodingError
        Levels that are missing or not even, too few pixels that are lit and not saturated, or light
        that does not rise with the level.
    """
    from scipy.interpolate import PchipInterpolator

    exposures = sorted(
        {f.exposure_s or 0.0 for f in plan.frames if isinstance(f.pattern, Uniform)}, reverse=True
    )
    for exposure_s in exposures:
        greys = _greys(plan, exposure_s)
        white = read_frame(greys[1.0]).astype(np.float64)
        black = read_frame(greys[0.0]).astype(np.float64)
        told = (white < plan.saturation_level) & (white - black > _LIT * plan.saturation_level)
        if np.count_nonzero(told) >= max(_LEAST_PIXELS, 0.02 * told.size):
            break
    else:
        raise DecodingError(
            "no exposure of the greys has pixels that are lit well and not saturated; take them "
            "at other exposures"
        )
    full = (white - black)[told].sum()
    light = [
        (read_frame(name)[told] - black[told]).sum() / full for _, name in sorted(greys.items())
    ]
    rises = np.diff(light)
    if rises.min() < -0.01:
        level = sorted(greys)[int(np.argmin(rises)) + 1]
        raise DecodingError(
            f"grey {level:g} is darker than the one before it: the projector does not show what it "
            "is given; see that its dynamic contrast is off"
        )
    rising = np.cumsum(np.concatenate([[0.0], np.maximum(rises, _LEAST_RISE)]))
    # A panel rounds what it is shown.
    levels = np.array(sorted(greys))
    shown = np.round((LEVELS - 1) * levels) / (LEVELS - 1)
    even = PchipInterpolator(shown, rising / rising[-1])(levels)
    return ProjectorResponse(light=(0.0, *(float(v) for v in even[1:-1]), 1.0))


def _greys(plan: Plan, exposure_s: float) -> dict[float, str]:
    """Uniform frames of an exposure, by level."""
    greys = {
        frame.pattern.level: frame.id
        for frame in plan.frames
        if isinstance(frame.pattern, Uniform) and (frame.exposure_s or 0.0) == exposure_s
    }
    levels = sorted(greys)
    even = len(levels) > 2 and np.allclose(levels, np.linspace(0, 1, len(levels)), atol=1e-6)
    if not even:
        raise DecodingError(
            f"the levels {', '.join(f'{level:g}' for level in levels)} tell no response; it takes "
            "greys in even steps from black to white (impasto scan --greys)"
        )
    return greys


@dataclass(frozen=True)
class FringeEvidence:
    """What a fringe shows of the response.

    Attributes
    ----------
    fringe : Fringe
        With steps spread evenly.
    series : PhaseSeries
        Error of its phase; see :func:`~acquisition.harmonics.series_along_lines`.
    """

    fringe: Fringe
    series: PhaseSeries


def response_of_fringes(evidence: Sequence[FringeEvidence]) -> ProjectorResponse:
    """One response that explains the phase errors of several fringes.

    Parameters
    ----------
    evidence : sequence of FringeEvidence
        Fringes of different periods tell the same; pre-distorted ones tell more.

    Returns
    -------
    ProjectorResponse
        Smooth where the fringes do not tell.

    Raises
    ------
    DecodingError
        There is no fringe.
    """
    from scipy.optimize import least_squares

    if not evidence:
        raise DecodingError("no fringe tells anything of the projector's response")

    def residuals(rises: NDArray[np.float64]) -> NDArray[np.float64]:
        response = _response(rises)
        apart = [_apart(response, each) for each in evidence]
        return np.concatenate([*apart, _SMOOTHNESS * np.diff(rises), [0.1 * rises.mean()]])

    return _response(least_squares(residuals, np.zeros(_SEGMENTS)).x)


def _response(log_rises: NDArray[np.float64]) -> ProjectorResponse:
    rises = np.exp(log_rises - log_rises.max()) + _LEAST_RISE
    light = np.cumsum(np.concatenate([[0.0], rises]))
    return ProjectorResponse(light=tuple(float(v) for v in light / light[-1]))


def _apart(response: ProjectorResponse, evidence: FringeEvidence) -> NDArray[np.float64]:
    """Coefficients that a response predicts less those found, in standard deviations."""
    series, fringe = evidence.series, evidence.fringe
    predicted = phase_error_of(
        response, shifts_rad=fringe.shifts_rad, gamma=fringe.gamma, orders=series.orders
    )
    found = 2 * np.pi * np.stack([series.cosine, series.sine], axis=1)
    sigma = np.hypot(2 * np.pi * series.sigma, _MODEL_ERROR_RAD)
    return np.asarray(((predicted - found) / sigma[:, np.newaxis]).ravel())
