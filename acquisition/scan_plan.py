"""Planning a structured-light scan: which patterns, in which order."""

from __future__ import annotations

import math

import numpy as np

from acquisition.errors import SessionError
from acquisition.patterns import BLACK, WHITE, Axis, Gray, PhaseShift, Uniform
from acquisition.plan import Crop, Imager, Plan, PlannedFrame

_LONGEST_CODE = 24


def plan_structured_light(
    *,
    camera_size: tuple[int, int],
    projector_size: tuple[int, int],
    saturation_level: int,
    exposure_s: float,
    axes: tuple[Axis, ...] = (Axis.COLUMN, Axis.ROW),
    periods_px: tuple[float, ...] = (24.0,),
    steps: int = 8,
    source: str = "rig",
) -> Plan:
    """Plan a scan by phase shift: white, black, then every axis from coarse to fine.

    The fringe order comes from the longest period where that covers the panel, and from Gray code
    otherwise. Gray cells are half a period wide, so that a bit read wrongly at its own edge does
    not change the order.

    Parameters
    ----------
    camera_size, projector_size : (int, int)
        Width and height in pixels.
    saturation_level : int
        Sensor number at which the camera saturates.
    exposure_s : float
        Exposure of every frame.
    axes : tuple of Axis
        Coordinates to encode, each once.
    periods_px : tuple of float
        Fringe periods on the panel in any order; the finest carries the precision. With noise
        σ_φ of the phase, a step of ratio r between neighbouring periods is taken wrongly with
        probability erfc(π / (√2 σ_φ √(1 + r²))).
    steps : int
        Phase steps of every fringe, three or more.
    source : str
        Kept in the plan.

    Returns
    -------
    Plan

    Raises
    ------
    SessionError
        Too few steps, an exposure that is not positive, no axis or one named twice, or periods
        that are missing, repeated, or too short for the panel to show.
    """
    _check(axes, periods_px, steps, exposure_s)
    patterns: list[PhaseShift | Gray | Uniform] = [WHITE, BLACK]
    for axis in axes:
        for period in sorted(periods_px, reverse=True):
            patterns.extend(
                PhaseShift(axis=axis, period_px=period, shift_rad=2 * np.pi * step / steps)
                for step in range(steps)
            )
        extent = projector_size[0 if axis is Axis.COLUMN else 1]
        if max(periods_px) < extent:
            patterns.extend(_gray_code(axis, extent, max(periods_px) / 2))
    width, height = camera_size
    return Plan(
        camera=Imager(width=width, height=height),
        projector=Imager(width=projector_size[0], height=projector_size[1]),
        crop=Crop(column=0, row=0, width=width, height=height),
        saturation_level=saturation_level,
        frames=tuple(
            PlannedFrame(id=f"{number:04d}", pattern=pattern, exposure_s=exposure_s)
            for number, pattern in enumerate(patterns)
        ),
        source=source,
    )


def _gray_code(axis: Axis, extent: int, step_px: float) -> list[Gray]:
    """Bits of a code with a cell for every ``step_px`` of the panel, most significant first."""
    # The first cell starts half a pixel before the first pixel's centre: one cell more.
    cells = math.ceil(extent / step_px) + 1
    bits = max(1, math.ceil(math.log2(cells)))
    if bits > _LONGEST_CODE:
        raise SessionError(
            f"a Gray code of {bits} bits would be needed for the {axis}s; choose a longer period"
        )
    return [Gray(axis=axis, bit=bit, bits=bits, step_px=step_px) for bit in range(bits)]


def _check(
    axes: tuple[Axis, ...], periods_px: tuple[float, ...], steps: int, exposure_s: float
) -> None:
    if steps < 3:
        raise SessionError(f"{steps} phase steps do not determine a phase; plan three or more")
    if not (math.isfinite(exposure_s) and exposure_s > 0):
        raise SessionError(f"an exposure of {exposure_s} s cannot be planned; it must be positive")
    if not axes or len(set(axes)) < len(axes):
        raise SessionError("a scan encodes each axis once, and one at least")
    if not periods_px or len(set(periods_px)) < len(periods_px):
        raise SessionError("a scan needs at least one fringe period, and each only once")
    short = [period for period in periods_px if not (math.isfinite(period) and period > 2)]
    if short:
        raise SessionError(
            f"a fringe of period {short[0]:g} px cannot be shown; a panel resolves more than 2 px"
        )
