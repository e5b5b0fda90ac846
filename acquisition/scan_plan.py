"""Planning a structured-light scan: which patterns, in which order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from acquisition.errors import SessionError
from acquisition.patterns import BLACK, WHITE, Axis, Gray, PhaseShift, Uniform
from acquisition.plan import Crop, Imager, Metering, Plan, PlannedFrame
from acquisition.projector_response import LEVELS, ProjectorResponse
from devices.bayer import BayerPattern

_LONGEST_CODE = 24


def plan_structured_light(
    *,
    camera_size: tuple[int, int],
    projector_size: tuple[int, int],
    saturation_level: int,
    exposure_s: float | tuple[float, ...],
    axes: tuple[Axis, ...] = (Axis.COLUMN, Axis.ROW),
    periods_px: tuple[float, ...] = (24.0,),
    steps: int = 8,
    inverse: bool = False,
    metering: Metering | None = None,
    response: ProjectorResponse | None = None,
    mosaic: BayerPattern | None = None,
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
    exposure_s : float or tuple of float
        Exposure of every frame, or several: then each pattern is taken at all of them, from short
        to long, before the next is shown.
    axes : tuple of Axis
        Coordinates to encode, each once.
    periods_px : tuple of float
        Fringe periods on the panel in any order; the finest carries the precision. With noise
        σ_φ of the phase, a step of ratio r between neighbouring periods is taken wrongly with
        probability erfc(π / (√2 σ_φ √(1 + r²))).
    steps : int
        Phase steps of every fringe, three or more.
    inverse : bool
        Whether each bit of a Gray code is followed by its inverse, by which a bit is read where
        neither mean nor white and black frames tell.
    metering : Metering, optional
        By what frames that no pixel needs are left out; by default, all are taken.
    response : ProjectorResponse, optional
        Of the projector, by which fringes are compensated.
    mosaic : BayerPattern, optional
        Of the camera; kept in the plan, as is ``source``.
    source : str

    Returns
    -------
    Plan

    Raises
    ------
    SessionError
        Too few steps, an exposure that is not positive, no axis or one named twice, or periods
        that are missing, repeated, or too short for the panel to show.
    """
    exposures = sorted(exposure_s) if isinstance(exposure_s, tuple) else [exposure_s]
    patterns = code_patterns(
        projector_size, axes=axes, periods_px=periods_px, steps=steps, inverse=inverse
    )
    check_exposures(exposures)
    return _plan(
        patterns,
        exposures,
        camera_size=camera_size,
        mosaic=mosaic,
        projector_size=projector_size,
        saturation_level=saturation_level,
        metering=metering,
        response=response,
        source=source,
    )


def plan_greys(
    *,
    camera_size: tuple[int, int],
    projector_size: tuple[int, int],
    saturation_level: int,
    exposure_s: tuple[float, ...],
    greys: int = 17,
    mosaic: BayerPattern | None = None,
    source: str = "rig",
) -> Plan:
    """Plan uniform greys, which tell the projector's response.

    Parameters
    ----------
    camera_size, projector_size, saturation_level, exposure_s, mosaic, source
        As of :func:`plan_structured_light`.
    greys : int
        Levels in even steps from black to white.

    Returns
    -------
    Plan

    Raises
    ------
    SessionError
        Fewer than three levels or more than the panel has, or an exposure that cannot be planned.
    """
    if not 3 <= greys <= LEVELS:
        raise SessionError(f"{greys} greys tell no response; plan 3 to {LEVELS}")
    check_exposures(exposure_s)
    between = [Uniform(level=float(level)) for level in np.linspace(0, 1, greys)[1:-1]]
    return _plan(
        [WHITE, BLACK, *between],
        sorted(exposure_s),
        camera_size=camera_size,
        mosaic=mosaic,
        projector_size=projector_size,
        saturation_level=saturation_level,
        source=source,
    )


def _plan(
    patterns: Sequence[PhaseShift | Gray | Uniform],
    exposures_s: list[float],
    *,
    camera_size: tuple[int, int],
    mosaic: BayerPattern | None,
    projector_size: tuple[int, int],
    **parts: Any,
) -> Plan:
    width, height = camera_size
    shots = [(pattern, exposure) for pattern in patterns for exposure in exposures_s]
    return Plan(
        camera=Imager(width=width, height=height, mosaic=mosaic),
        projector=Imager(width=projector_size[0], height=projector_size[1]),
        crop=Crop(column=0, row=0, width=width, height=height),
        frames=tuple(
            PlannedFrame(id=f"{number:04d}", pattern=pattern, exposure_s=exposure)
            for number, (pattern, exposure) in enumerate(shots)
        ),
        **parts,
    )


def code_patterns(
    projector_size: tuple[int, int],
    *,
    axes: tuple[Axis, ...],
    periods_px: tuple[float, ...],
    steps: int,
    inverse: bool = False,
) -> list[PhaseShift | Gray | Uniform]:
    """Patterns of a scan in their order; see :func:`plan_structured_light`.

    Raises
    ------
    SessionError
        They cannot be shown or decoded.
    """
    _check(axes, periods_px, steps)
    patterns: list[PhaseShift | Gray | Uniform] = [WHITE, BLACK]
    for axis in axes:
        for period in sorted(periods_px, reverse=True):
            patterns.extend(
                PhaseShift(axis=axis, period_px=period, shift_rad=2 * np.pi * step / steps)
                for step in range(steps)
            )
        extent = projector_size[0 if axis is Axis.COLUMN else 1]
        if max(periods_px) < extent:
            for bit in _gray_code(axis, extent, max(periods_px) / 2):
                patterns.append(bit)
                if inverse:
                    patterns.append(bit.model_copy(update={"inverse": True}))
    return patterns


def check_exposures(exposures_s: Sequence[float]) -> None:
    """Refuse exposures that cannot be planned.

    Raises
    ------
    SessionError
        None, one that is not a positive time, or one that occurs twice.
    """
    wrong = [exposure for exposure in exposures_s if not (math.isfinite(exposure) and exposure > 0)]
    if wrong:
        raise SessionError(f"an exposure of {wrong[0]} s cannot be planned; it must be positive")
    if not exposures_s or len(set(exposures_s)) < len(exposures_s):
        raise SessionError("a plan needs at least one exposure, and each only once")


def whole_periods(exposures_s: Sequence[float], period_s: float) -> tuple[float, ...]:
    """Exposures made whole numbers of the projector's frame period, each once, from short to long.

    A projector that dims by switching its light shows a level in the mean over a period only.

    Parameters
    ----------
    exposures_s : sequence of float
    period_s : float
        Time of one projected frame.
    """
    return tuple(sorted({period_s * max(1, round(e / period_s)) for e in exposures_s}))


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


def _check(axes: tuple[Axis, ...], periods_px: tuple[float, ...], steps: int) -> None:
    if steps < 3:
        raise SessionError(f"{steps} phase steps do not determine a phase; plan three or more")
    if not axes or len(set(axes)) < len(axes):
        raise SessionError("a scan encodes each axis once, and one at least")
    if not periods_px or len(set(periods_px)) < len(periods_px):
        raise SessionError("a scan needs at least one fringe period, and each only once")
    short = [period for period in periods_px if not (math.isfinite(period) and period > 2)]
    if short:
        raise SessionError(
            f"a fringe of period {short[0]:g} px cannot be shown; a panel resolves more than 2 px"
        )
