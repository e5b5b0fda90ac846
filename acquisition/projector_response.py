r"""The projector's response: what light a level gives, and what level gives the light of a pattern.

A fringe is a sinusoid in light. A projector that answers a level l with light R(l) is shown
:math:`R^{-1}(p)` of a pattern p, and the fringe is one again.

The response is measured on uniform greys: light over that of white, black subtracted, is the same
for every pixel, whatever it sees. Where a capture has no greys, its fringes tell: each makes the
phase err by a series that follows from the response (:mod:`acquisition.harmonics` finds the
series), and one response has to explain them all. Light is known by fringes up to a factor and an
offset only, which do not matter to phases.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

LEVELS = 256
_SAMPLES = 720


class ProjectorResponse(BaseModel):
    """Light by level.

    Attributes
    ----------
    light : tuple of float
        At levels evenly spaced from 0 to 1: rising from 0, which is black, to 1, which is white.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    light: Annotated[tuple[float, ...], Field(min_length=2, max_length=LEVELS)]

    @model_validator(mode="after")
    def _rises(self) -> ProjectorResponse:
        if self.light[0] != 0 or self.light[-1] != 1:
            raise ValueError("a response begins at 0, black, and ends at 1, white")
        if not (np.diff(self.light) > 0).all():
            raise ValueError("a response rises from level to level")
        return self

    def light_of(self, level: NDArray[np.float64]) -> NDArray[np.float64]:
        """Light (...) of levels from 0 to 1, by a monotone cubic through what is known."""
        from scipy.interpolate import PchipInterpolator

        known = np.linspace(0, 1, len(self.light))
        return np.asarray(PchipInterpolator(known, self.light)(np.clip(level, 0, 1)))

    def level_of(self, light: NDArray[np.float64]) -> NDArray[np.float64]:
        """Levels (...) from 0 to 1 that give light from 0 to 1."""
        levels, given = _inverse(self.light)
        return np.interp(light, given, levels)


@lru_cache(maxsize=8)
def _inverse(light: tuple[float, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    levels = np.linspace(0, 1, 16 * LEVELS)
    return levels, ProjectorResponse(light=light).light_of(levels)


def phase_error_of(
    response: ProjectorResponse,
    *,
    shifts_rad: NDArray[np.float64],
    gamma: float,
    orders: Sequence[int],
) -> NDArray[np.float64]:
    """What a response makes of the phase of evenly shifted steps.

    Parameters
    ----------
    response : ProjectorResponse
    shifts_rad : (steps,) array
    gamma : float
        Power by which the fringe was pre-distorted.
    orders : sequence of int
        Of the series in the raw phase.

    Returns
    -------
    (orders, 2) float64 array
        Cosine and sine coefficients, rad.
    """
    phase = np.linspace(0, 2 * np.pi, _SAMPLES, endpoint=False)
    profile = (0.5 + 0.5 * np.cos(phase[:, np.newaxis] + shifts_rad)) ** gamma
    raw = np.angle(response.light_of(profile) @ np.exp(-1j * shifts_rad))
    error = np.angle(np.exp(1j * (raw - phase)))
    waves = [wave(order * raw) for order in orders for wave in (np.cos, np.sin)]
    found = np.linalg.lstsq(np.stack(waves, axis=1), error, rcond=None)[0]
    return np.asarray(found.reshape(-1, 2))
