"""Plans and pictures of fringes for the benchmarks of decoding: known coordinates, known noise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from acquisition.frame_files import Samples
from acquisition.patterns import (
    BLACK,
    WHITE,
    Axis,
    Gray,
    Pattern,
    PhaseShift,
    Uniform,
    pattern_profile,
)
from acquisition.plan import Crop, Imager, Plan, PlannedFrame

Truth = dict[Axis, NDArray[np.float64]]


def plan_of(
    patterns: Sequence[Pattern],
    *,
    width: int,
    height: int,
    panel: tuple[int, int],
    saturation: int = 255,
) -> Plan:
    """A plan of patterns for a camera of ``width`` × ``height`` pixels."""
    return Plan(
        camera=Imager(width=width, height=height),
        projector=Imager(width=panel[0], height=panel[1]),
        crop=Crop(column=0, row=0, width=width, height=height),
        saturation_level=saturation,
        frames=tuple(
            PlannedFrame(id=f"{number:04d}", pattern=pattern)
            for number, pattern in enumerate(patterns)
        ),
        source="benchmark",
    )


def fringe_patterns(axis: Axis, periods_px: list[float], steps: int) -> list[PhaseShift]:
    """Fringes of several periods, their phase falling from step to step and π at the origin."""
    return [
        PhaseShift(
            axis=axis,
            period_px=period,
            shift_rad=-2 * math.pi * step / steps,
            origin_rad=-math.pi,
        )
        for period in periods_px
        for step in range(steps)
    ]


def gray_patterns(axis: Axis, bits: int) -> list[Gray]:
    """A Gray code of single pixels, every bit followed by its inverse."""
    return [
        Gray(axis=axis, bit=bit, bits=bits, step_px=1.0, inverse=inverse)
        for bit in range(bits)
        for inverse in (False, True)
    ]


def flats() -> list[Uniform]:
    """A white and a black frame."""
    return [WHITE, BLACK]


def sloping_surface(width: int, height: int, panel: tuple[int, int]) -> Truth:
    """Coordinates that cover most of a panel, a little oblique to it."""
    col, row = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    return {
        Axis.COLUMN: np.asarray(panel[0] * (0.02 + 0.94 * col + 0.02 * row), np.float64),
        Axis.ROW: np.asarray(panel[1] * (0.02 + 0.94 * row + 0.02 * col), np.float64),
    }


def expose(
    plan: Plan,
    truth: Truth,
    *,
    mean: float,
    modulation: float,
    read_sigma: float,
    gain: float = 0.0,
    seed: int = 0,
) -> dict[str, Samples]:
    """Frames of a plan on a uniform surface.

    Parameters
    ----------
    plan : Plan
    truth : dict
        (rows, cols) projector coordinate of each camera pixel, by axis.
    mean, modulation : float
        Of a fringe, in sensor numbers.
    read_sigma, gain : float
        Noise of variance ``read_sigma² + gain * level``.
    seed : int

    Returns
    -------
    dict
        (rows, cols) uint8 array by frame id, uint16 where the sensor's ceiling needs it.
    """
    random = np.random.default_rng(seed)
    shape = (plan.crop.height, plan.crop.width)
    ceiling = plan.saturation_level
    frames: dict[str, Samples] = {}
    for frame in plan.frames:
        pattern = frame.pattern
        assert pattern is not None  # these plans are of patterns
        at = np.zeros(shape) if isinstance(pattern, Uniform) else truth[pattern.axis]
        level = (mean + modulation * (2 * pattern_profile(pattern, at) - 1)).astype(np.float32)
        sigma = np.sqrt(read_sigma**2 + gain * np.maximum(level, 0))
        level += sigma * random.standard_normal(shape, np.float32)
        rounded = np.clip(np.rint(level), 0, ceiling)
        frames[frame.id] = rounded.astype(np.uint8) if ceiling < 256 else rounded.astype(np.uint16)
    return frames
