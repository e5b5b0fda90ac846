"""One response for fringes that were distorted in different ways, on a real capture.

The capture shows a plane under two three-step fringes, pre-distorted with gammas of 0.75 and 1.25.
Their phases alone tell the response of display and camera together; what it makes of either phase
is subtracted. A fine Gray code, which takes no part in that but for the fringe's order, is what the
phases are held against; it is itself good to about 0.02 rad.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.capture_description import read_description
from acquisition.correspondence import CorrespondenceMap
from acquisition.decoding import DecodingOptions, decode
from acquisition.errors import DecodingError
from acquisition.foreign_capture import find_capture, read_picture
from acquisition.fringes import Fringe, find_fringes
from acquisition.harmonics import error_orders, series_along_lines
from acquisition.patterns import Axis, Gray, PhaseShift
from acquisition.plan import Plan, PlannedFrame
from acquisition.projector_response import ProjectorResponse, phase_error_of
from acquisition.response_measurement import FringeEvidence, response_of_fringes
from workstation.benchmark_records import Record, Sense

CAPTURE = "kamino410_gamma_plane"
_DESCRIPTIONS = Path(__file__).parents[2] / "fixtures" / "captures"
_GAMMAS = (0.75, 1.25)
_BOUND_RAD = 0.03
_LINES = 96


def gamma_record(folder: Path) -> Record:
    """Phase error of two pre-distorted fringes, compensated by one response.

    Parameters
    ----------
    folder : Path
        The capture.
    """
    capture = find_capture(folder, read_description(_DESCRIPTIONS / f"{CAPTURE}.toml"))
    frames = {key: read_picture(path) for key, path in capture.files.items()}
    gray = tuple(frame for frame in capture.plan.frames if isinstance(frame.pattern, Gray))
    reference = decode(_with(capture.plan, gray), frames.__getitem__)
    fringes: list[Fringe] = []
    found: list[CorrespondenceMap] = []
    for gamma in _GAMMAS:
        steps = tuple(
            frame
            for frame in capture.plan.frames
            if isinstance(frame.pattern, PhaseShift) and frame.pattern.gamma == gamma
        )
        plan = _with(capture.plan, (*steps, *gray))
        fringes.append(find_fringes(plan)[0])
        options = DecodingOptions(compensate_harmonics=False)
        found.append(decode(plan, frames.__getitem__, options))
    evidence = [_evidence(*pair) for pair in zip(fringes, found, strict=True)]
    response = response_of_fringes(evidence)
    raw = [_phase_error(f, None, d, reference) for f, d in zip(fringes, found, strict=True)]
    left = [_phase_error(f, response, d, reference) for f, d in zip(fringes, found, strict=True)]
    return Record(
        name="gamma.phase_error_rad",
        value=max(left),
        unit="rad",
        bound=_BOUND_RAD,
        sense=Sense.AT_MOST,
        runs=len(left),
        note=f"worse of two pre-distortions by one response: {left[0]:.4f} and {left[1]:.4f}, raw "
        f"{raw[0]:.3f} and {raw[1]:.3f}; against a Gray code good to 0.02 rad",
    )


def _with(plan: Plan, frames: tuple[PlannedFrame, ...]) -> Plan:
    return plan.model_copy(update={"frames": frames})


def _turns(fringe: Fringe, found: CorrespondenceMap) -> NDArray[np.float64]:
    """Raw phase of every pixel in turns; NaN where it is not decoded."""
    coordinate = found.axes[Axis.COLUMN].coordinate
    return np.asarray(coordinate / fringe.period_px + fringe.origin_rad / (2 * np.pi))


def _evidence(fringe: Fringe, found: CorrespondenceMap) -> FringeEvidence:
    turns = np.mod(np.where(found.valid, _turns(fringe, found), 0.0), 1.0)
    rows = np.unique(np.linspace(0, len(turns) - 1, _LINES).astype(np.intp))
    series = series_along_lines([turns[rows]], [found.valid[rows]], error_orders(fringe)[:3])
    if series is None:
        raise DecodingError(f"the fringe of period {fringe.period_px:g} px shows no harmonics")
    return FringeEvidence(fringe, series)


def _phase_error(
    fringe: Fringe,
    response: ProjectorResponse | None,
    found: CorrespondenceMap,
    reference: CorrespondenceMap,
) -> float:
    """RMS of a fringe's phase less that of the reference, rad."""
    both = found.valid & reference.valid
    turns = _turns(fringe, found)[both]
    apart = turns - _turns(fringe, reference)[both]
    # Bits read wrongly put the reference off by whole halves of its panel.
    near = np.abs(apart) < 0.25
    error = 2 * np.pi * apart
    if response is not None:
        orders = error_orders(fringe)
        series = phase_error_of(
            response, shifts_rad=fringe.shifts_rad, gamma=fringe.gamma, orders=orders
        )
        for order, (cosine, sine) in zip(orders, series, strict=True):
            angle = 2 * np.pi * order * turns
            error = error - cosine * np.cos(angle) - sine * np.sin(angle)
    return float(np.sqrt(np.mean(error[near] ** 2)))
