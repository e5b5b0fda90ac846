"""Whether the lamp has drifted: its reference pose, photographed again and again, compared.

Frames of the same exposure from the same place are compared pixel by pixel, where neither is dark
or saturated; the median of their ratio is the lamp's. Its standard error follows from the spread
of the ratios.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acquisition.frame_files import Samples
from acquisition.plan import PlannedFrame, Purpose
from acquisition.robust_spread import robust_sigma
from acquisition.session import Session

# Below this share of what saturates, noise would decide.
_LEAST_SIGNAL = 0.1
_LEAST_PIXELS = 16


@dataclass(frozen=True)
class DriftSample:
    """The lamp at one moment, over the lamp at the first reference from the same place.

    Attributes
    ----------
    frame_id : str
    camera_position : str or None
    wall_time : float
        When the frame was exposed.
    ratio : float
    standard_error : float
    """

    frame_id: str
    camera_position: str | None
    wall_time: float
    ratio: float
    standard_error: float


def measure_lamp_drift(session: Session) -> list[DriftSample]:
    """Ratios of all frames of the reference pose to the first of their exposure and place.

    Returns
    -------
    list of DriftSample
        Without frames that are too dark or too bright to tell; empty without reference frames.

    Raises
    ------
    SessionError
        A frame was altered.
    """
    first: dict[tuple[str | None, float | None], tuple[Samples, float]] = {}
    found = []
    for frame in session.frames:
        if frame.purpose is not Purpose.REFERENCE_POSE:
            continue
        key = frame.camera_position, frame.exposure_s
        image = session.read_frame(frame.id)
        if key not in first:
            first[key] = image, _black_level(session, frame)
            continue
        ratio = _ratio(image, *first[key], saturation_level=session.plan.saturation_level)
        if ratio is not None:
            wall_time = session.recorded[frame.id].wall_time
            found.append(DriftSample(frame.id, frame.camera_position, wall_time, *ratio))
    return found


def _ratio(
    image: Samples, reference: Samples, black_level: float, *, saturation_level: int
) -> tuple[float, float] | None:
    least = black_level + _LEAST_SIGNAL * (saturation_level - black_level)
    valid = (reference >= least) & (np.maximum(image, reference) < saturation_level)
    if np.count_nonzero(valid) < _LEAST_PIXELS:
        return None
    ratios = (image[valid] - black_level) / (reference[valid] - black_level)
    median = float(np.median(ratios))
    spread = robust_sigma(ratios - median)
    # The median of normal samples has π/2 times the variance of their mean.
    return median, float(np.sqrt(np.pi / 2 / ratios.size)) * spread


def _black_level(session: Session, lit: PlannedFrame) -> float:
    """Median of the dark frame of the same exposure from the same place; 0 without one."""
    for frame in session.frames:
        if (frame.purpose, frame.camera_position, frame.exposure_s) == (
            Purpose.DARK,
            lit.camera_position,
            lit.exposure_s,
        ):
            return float(np.median(session.read_frame(frame.id)))
    return 0.0
