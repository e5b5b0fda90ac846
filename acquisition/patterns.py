r"""Structured-light patterns as pure data, and the pictures a projector shows of them.

A pattern is a function of one projector coordinate (``column`` or ``row``), sampled at the
projector's pixel centres, with values from 0 (dark) to 1 (full). The conventions:

* phase shift: :math:`p(x) = \tfrac12 + \tfrac12\cos(2\pi x/\text{period} + \text{origin} +
  \text{shift})`, optionally raised to a power by which the projector's response is pre-distorted;
* Gray code: the cell :math:`c = \lfloor x/\text{step} + \text{offset} \rfloor` is written as
  ``c ^ (c >> 1)`` in ``bits`` bits, of which bit 0 is the most significant.

``x`` runs over pixel centres, so the first pixel is ``x = 0``. A foreign capture that counts
from the pixel's edge says so with ``origin_rad`` or ``offset``.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, model_validator

from acquisition.projector_response import ProjectorResponse


class Axis(StrEnum):
    """The projector coordinate that a pattern encodes."""

    COLUMN = "column"
    ROW = "row"


class _Pattern(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PhaseShift(_Pattern):
    """One step of a phase-shifted fringe.

    Attributes
    ----------
    axis : Axis
        Coordinate along which the fringe varies.
    period_px : float
        Fringe period in projector pixels.
    shift_rad : float
        Phase added in this step.
    origin_rad : float
        Phase at coordinate 0 when the shift is 0.
    gamma : float
        Exponent that was applied to the pattern before projection (1: none).
    """

    kind: Literal["phase_shift"] = "phase_shift"
    axis: Axis
    period_px: float = Field(gt=0)
    shift_rad: float
    origin_rad: float = 0.0
    gamma: float = Field(default=1.0, gt=0)

    @property
    def fringe(self) -> tuple[Axis, float, float, float]:
        """What the steps of one fringe have in common: axis, period, origin and gamma."""
        return (self.axis, self.period_px, self.origin_rad, self.gamma)


class Gray(_Pattern):
    """One bit of a Gray code.

    Attributes
    ----------
    axis : Axis
        Coordinate that is encoded.
    bit : int
        Which bit, 0 being the most significant.
    bits : int
        Length of the code.
    step_px : float
        Width of one cell of the code in projector pixels.
    offset : float
        Added to ``x / step_px`` before the cell number is taken.
    inverse : bool
        Whether this is the complement of the bit.
    """

    kind: Literal["gray"] = "gray"
    axis: Axis
    bit: int = Field(ge=0)
    bits: int = Field(gt=0, le=24)
    step_px: float = Field(gt=0)
    offset: float = 0.0
    inverse: bool = False

    @model_validator(mode="after")
    def _bit_within_code(self) -> Gray:
        if self.bit >= self.bits:
            raise ValueError(f"bit {self.bit} of a code of {self.bits} bits")
        return self

    @property
    def code(self) -> tuple[Axis, int, float, float]:
        """What the bits of one code have in common: axis, length, step and offset."""
        return (self.axis, self.bits, self.step_px, self.offset)


class Uniform(_Pattern):
    """A flat field: white (level 1), black (level 0) or grey."""

    kind: Literal["uniform"] = "uniform"
    level: float = Field(ge=0, le=1)


Pattern = Annotated[PhaseShift | Gray | Uniform, Field(discriminator="kind")]
PATTERN_ADAPTER: TypeAdapter[Pattern] = TypeAdapter(Pattern)

WHITE = Uniform(level=1.0)
BLACK = Uniform(level=0.0)


def pattern_profile(
    pattern: PhaseShift | Gray | Uniform, coordinate: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Value of a pattern at projector coordinates along its axis.

    Parameters
    ----------
    pattern : PhaseShift, Gray or Uniform
        The pattern.
    coordinate : (...) float array
        Projector coordinates in pixels.

    Returns
    -------
    (...) float64 array
        Values from 0 to 1.
    """
    x = np.asarray(coordinate, dtype=np.float64)
    if isinstance(pattern, Uniform):
        return np.full(x.shape, pattern.level)
    if isinstance(pattern, PhaseShift):
        phase = 2 * np.pi * x / pattern.period_px + pattern.origin_rad + pattern.shift_rad
        return (0.5 + 0.5 * np.cos(phase)) ** pattern.gamma
    cell = np.floor(x / pattern.step_px + pattern.offset).astype(np.int64)
    gray = cell ^ (cell >> 1)
    bit = (gray >> (pattern.bits - 1 - pattern.bit)) & 1
    return (bit ^ int(pattern.inverse)).astype(np.float64)


def pattern_image(
    pattern: PhaseShift | Gray | Uniform,
    *,
    width: int,
    height: int,
    response: ProjectorResponse | None = None,
) -> NDArray[np.uint8]:
    """Picture of a pattern for a projector of ``width`` × ``height`` pixels.

    Parameters
    ----------
    pattern : PhaseShift, Gray or Uniform
    width, height : int
    response : ProjectorResponse, optional
        By which fringes are compensated, so that it is their light that is as the pattern says.
        Black, white and Gray code are the same anyway, and other greys are shown as they are: they
        measure the response.

    Returns
    -------
    (height, width) uint8 array
    """
    if isinstance(pattern, Uniform):
        return np.full((height, width), round(255 * pattern.level), dtype=np.uint8)
    along_columns = pattern.axis is Axis.COLUMN
    profile = pattern_profile(pattern, np.arange(width if along_columns else height, dtype=float))
    if response is not None and isinstance(pattern, PhaseShift):
        profile = response.level_of(profile)
    # Where a fringe crosses its middle, half way between two levels, the last bit of a cosine must
    # not decide, which another mathematical library may round otherwise.
    levels = np.round(np.round(255 * profile, 6)).astype(np.uint8)
    line = levels[np.newaxis, :] if along_columns else levels[:, np.newaxis]
    return np.ascontiguousarray(np.broadcast_to(line, (height, width)))


def describe(pattern: PhaseShift | Gray | Uniform) -> str:
    """A pattern in a few words, for people."""
    if isinstance(pattern, Uniform):
        return {0.0: "black", 1.0: "white"}.get(pattern.level, f"grey {pattern.level:g}")
    if isinstance(pattern, PhaseShift):
        shift = np.degrees(pattern.shift_rad)
        return f"{pattern.axis} fringe of {pattern.period_px:g} px at {shift:.0f}°"
    kind = "inverse of " if pattern.inverse else ""
    return f"{kind}{pattern.axis} Gray bit {pattern.bit + 1} of {pattern.bits}"
