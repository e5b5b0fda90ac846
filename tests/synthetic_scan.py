"""Made-up scans for the tests: plans of patterns, and frames of known coordinates."""

from __future__ import annotations

import numpy as np

from acquisition.patterns import Axis, Gray, PhaseShift, pattern_profile
from acquisition.plan import Crop, Imager, Plan, PlannedFrame


def make_plan(
    patterns: list,
    *,
    width: int = 320,
    height: int = 240,
    projector: tuple[int, int] = (512, 320),
    saturation: int = 1023,
) -> Plan:
    return Plan(
        camera=Imager(width=width, height=height),
        projector=Imager(width=projector[0], height=projector[1]),
        crop=Crop(column=0, row=0, width=width, height=height),
        saturation_level=saturation,
        frames=tuple(PlannedFrame(id=f"{i:04d}", pattern=p) for i, p in enumerate(patterns)),
        source="test",
    )


def fringe_patterns(axis: Axis, *, period: float, steps: int, **extra: float) -> list[PhaseShift]:
    return [
        PhaseShift(axis=axis, period_px=period, shift_rad=2 * np.pi * k / steps, **extra)
        for k in range(steps)
    ]


def gray_patterns(axis: Axis, *, step: float, bits: int, inverse: bool = False) -> list[Gray]:
    return [Gray(axis=axis, bit=b, bits=bits, step_px=step, inverse=inverse) for b in range(bits)]


def expose(
    plan: Plan,
    coordinates: dict[Axis, np.ndarray],
    *,
    mean: float = 400.0,
    modulation: float = 300.0,
    sigma: float = 0.0,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Frames of a plan where each pixel sees the given projector coordinates."""
    random = np.random.default_rng(seed)
    frames = {}
    for frame in plan.frames:
        axis = getattr(frame.pattern, "axis", Axis.COLUMN)
        at = coordinates.get(axis, np.zeros((plan.crop.height, plan.crop.width)))
        level = mean + modulation * (2 * pattern_profile(frame.pattern, at) - 1)
        noisy = level + random.normal(0, sigma, level.shape) if sigma else level
        frames[frame.id] = np.clip(np.round(noisy), 0, 1023).astype(np.uint16)
    return frames
