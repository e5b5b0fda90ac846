"""Compile the kernels of decoding once, at set-up, so that no first scan waits for them."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from acquisition.decoding import DecodingOptions, decode
from acquisition.patterns import Axis, Gray, Pattern, PhaseShift, pattern_profile
from acquisition.plan import Crop, Imager, Plan, PlannedFrame

_SIZE = (64, 48)
_PANEL = (128, 96)


def compile_decoding() -> None:
    """Decode small made-up scans of every kind, in each of the sample types that cameras deliver.

    Raises
    ------
    DecodingError
        Never, unless decoding is broken.
    """
    columns = [*_fringe(128.0, 8), *_fringe(16.0, 8)]
    brackets = [*_fringe(128.0, 4), *_fringe(16.0, 4)]
    by_level = [*_fringe(16.0, 4), *_code(4, 8.0, inverse=False)]
    alone = [*_code(7, 1.0, inverse=False), *_code(7, 1.0, inverse=True)]
    for kind in (np.uint8, np.uint16):
        _decode(columns, (None,), kind, DecodingOptions(compensate_harmonics=True))
        _decode(brackets, (1.0, 0.5), kind)
        _decode([*by_level, *_code(4, 8.0, inverse=True)], (None,), kind)
        _decode(by_level, (None,), kind)
        _decode(alone, (None,), kind)


def _fringe(period_px: float, steps: int) -> list[Pattern]:
    return [
        PhaseShift(axis=Axis.COLUMN, period_px=period_px, shift_rad=2 * np.pi * step / steps)
        for step in range(steps)
    ]


def _code(bits: int, step_px: float, *, inverse: bool) -> list[Pattern]:
    return [
        Gray(axis=Axis.COLUMN, bit=bit, bits=bits, step_px=step_px, inverse=inverse)
        for bit in range(bits)
    ]


def _decode(
    patterns: list[Pattern],
    exposures: tuple[float | None, ...],
    kind: DTypeLike,
    options: DecodingOptions | None = None,
) -> None:
    width, height = _SIZE
    shown = [(pattern, exposure) for exposure in exposures for pattern in patterns]
    plan = Plan(
        camera=Imager(width=width, height=height),
        projector=Imager(width=_PANEL[0], height=_PANEL[1]),
        crop=Crop(column=0, row=0, width=width, height=height),
        saturation_level=255,
        frames=tuple(
            PlannedFrame(id=f"{number:04d}", pattern=pattern, exposure_s=exposure)
            for number, (pattern, exposure) in enumerate(shown)
        ),
        source="compilation",
    )
    truth = np.floor(np.linspace(4.0, 120.0, width)) + np.zeros((height, 1))
    truth[20, 30] = np.floor(truth[20, 30] - 40)  # so that the neighbours are looked at
    random = np.random.default_rng(0)
    frames = {
        frame.id: np.round(
            (exposure or 1.0) * (30 + 180 * pattern_profile(pattern, truth))
            + random.normal(0, 1.5, truth.shape)
        ).astype(kind)
        for frame, (pattern, exposure) in zip(plan.frames, shown, strict=True)
    }
    decode(plan, frames.__getitem__, options)
