"""The contact sheet: every frame of a session in one picture, with what can be told at a glance.

Under each frame stand its number, exposure and share of saturated samples; under fringes, their
modulation too. Frames that were left out of a bracket have an empty place. Brightness is shown by
its square root, which is about how eyes and screens see it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from acquisition.atomic_files import write_bytes
from acquisition.errors import SessionError
from acquisition.frame_files import Samples
from acquisition.fringes import find_fringes
from acquisition.patterns import Gray, PhaseShift, Uniform
from acquisition.plan import PlannedFrame, Purpose
from acquisition.session import CONTACT_SHEET_FILE, Session

_THUMBNAIL_PX = 160
_LINE_PX = 13
_LINES = 3
_GAP_PX = 6
# Samples of a frame that its modulation is told from, about.
_SAMPLES = 20_000
_PAPER = 24
_INK = 220


@dataclass(frozen=True)
class FrameFigures:
    """What a contact sheet says of a frame.

    Attributes
    ----------
    id : str
    exposure_s : float or None
    saturated : float
        Share of its samples that are saturated.
    modulation : float or None
        Median over the frame of its fringe's amplitude, as a share of what saturates; None where
        the frame is no step of a fringe.
    """

    id: str
    exposure_s: float | None
    saturated: float
    modulation: float | None


def draw_contact_sheet(session: Session) -> tuple[NDArray[np.uint8], list[FrameFigures]]:
    """Draw the contact sheet of a session, reading each frame once and holding one at a time.

    Parameters
    ----------
    session : Session

    Returns
    -------
    (rows, cols) uint8 array
    list of FrameFigures
        Of the recorded frames, in the order of the plan.

    Raises
    ------
    SessionError
        A frame was altered or is missing.
    """
    thumbnails, figures = _look_at(session)
    frames = session.plan.frames
    height, width = _place_px(session)
    columns = min(len(frames), max(6, math.ceil(math.sqrt(len(frames) * height / width))))
    return _lay_out(session, frames, thumbnails, figures, columns), figures


def draw_contact_sheets(
    session: Session, *, columns: int, rows: int
) -> tuple[list[NDArray[np.uint8]], list[FrameFigures]]:
    """Draw a session on sheets that can be read on a page, in the order of the plan.

    Parameters
    ----------
    session : Session
    columns, rows : int
        Of frames on a sheet, at most.

    Returns
    -------
    list of (rows, cols) uint8 arrays
    list of FrameFigures
        Of the recorded frames, in the order of the plan.

    Raises
    ------
    SessionError
        A frame was altered or is missing.
    """
    thumbnails, figures = _look_at(session)
    frames, count = session.plan.frames, columns * rows
    sheets = [
        _lay_out(session, frames[n : n + count], thumbnails, figures, columns)
        for n in range(0, len(frames), count)
    ]
    return sheets, figures


def write_contact_sheet(session: Session) -> list[FrameFigures]:
    """Draw a session's contact sheet into its folder; the manifest does not cover it.

    Parameters
    ----------
    session : Session

    Returns
    -------
    list of FrameFigures

    Raises
    ------
    SessionError
        A frame was altered, or the picture cannot be written.
    """
    sheet, figures = draw_contact_sheet(session)
    file: Path = session.path / CONTACT_SHEET_FILE
    done, encoded = cv2.imencode(".png", sheet)
    if not done:
        raise SessionError(f"{file}: {sheet.shape[1]}×{sheet.shape[0]} is too large for a PNG")
    try:
        write_bytes(file, encoded.tobytes())
    except OSError as error:
        raise SessionError(
            f"{file} cannot be written ({error.strerror}); the session itself is complete"
        ) from error
    return figures


def _look_at(session: Session) -> tuple[dict[str, NDArray[np.uint8]], list[FrameFigures]]:
    """Thumbnails and figures of the recorded frames."""
    plan = session.plan
    rows, cols = _thumbnail_px(session)
    samples: dict[str, Samples] = {}
    thumbnails: dict[str, NDArray[np.uint8]] = {}
    measured: list[tuple[PlannedFrame, float]] = []
    for frame in session.frames:
        image = session.read_frame(frame.id)
        share = np.sqrt(np.minimum(image / plan.saturation_level, 1.0).astype(np.float32))
        small = cv2.resize(share, (cols, rows), interpolation=cv2.INTER_AREA)
        thumbnails[frame.id] = np.round(255 * small).astype(np.uint8)
        measured.append((frame, float(np.mean(image >= plan.saturation_level))))
        if isinstance(frame.pattern, PhaseShift):
            samples[frame.id] = _sparse(image)
    modulation = _modulations(session, samples)
    return thumbnails, [
        FrameFigures(frame.id, session.exposure_s(frame.id), saturated, modulation.get(frame.id))
        for frame, saturated in measured
    ]


def _thumbnail_px(session: Session) -> tuple[int, int]:
    """Rows and columns of a thumbnail."""
    crop = session.plan.crop
    scale = _THUMBNAIL_PX / max(crop.width, crop.height)
    return max(1, round(crop.height * scale)), max(1, round(crop.width * scale))


def _place_px(session: Session) -> tuple[int, int]:
    """Rows and columns that a thumbnail takes with its lines."""
    return _thumbnail_px(session)[0] + _LINES * _LINE_PX + _GAP_PX, _THUMBNAIL_PX + _GAP_PX


def _sparse(image: Samples) -> Samples:
    """Some samples of a frame, spread over it, at the same places in every frame."""
    step = max(1, math.isqrt(image.size // _SAMPLES))
    return image[step // 2 :: step, step // 2 :: step].copy()


def _modulations(session: Session, samples: dict[str, Samples]) -> dict[str, float]:
    """Median amplitude of the fringe that each frame is a step of, by frame id."""
    found: dict[str, float] = {}
    plan = session.plan
    for place in plan.camera_positions or (None,):
        steps = tuple(
            f for f in session.frames if f.id in samples and f.camera_position in (place, None)
        )
        if not steps:
            continue
        for fringe in find_fringes(plan.model_copy(update={"frames": steps})):
            if fringe.steps < 3:
                continue
            stack = np.stack([samples[i] for i in fringe.frame_ids]).astype(np.float64)
            _, cosine, sine = np.tensordot(fringe.solution, stack, axes=1)
            amplitude = float(np.median(np.hypot(cosine, sine))) / plan.saturation_level
            found.update(dict.fromkeys(fringe.frame_ids, amplitude))
    return found


def _lay_out(
    session: Session,
    frames: Sequence[PlannedFrame],
    thumbnails: dict[str, NDArray[np.uint8]],
    figures: list[FrameFigures],
    columns: int,
) -> NDArray[np.uint8]:
    told = {one.id: one for one in figures}
    (tall, wide), (height, width) = _thumbnail_px(session), _place_px(session)
    rows = math.ceil(len(frames) / columns)
    sheet = np.full((rows * height + _GAP_PX, columns * width + _GAP_PX), _PAPER, np.uint8)
    for number, frame in enumerate(frames):
        top = number // columns * height + _GAP_PX
        left = number % columns * width + _GAP_PX
        if frame.id in thumbnails:
            sheet[top : top + tall, left : left + wide] = thumbnails[frame.id]
        else:
            cv2.rectangle(sheet, (left, top), (left + wide - 1, top + tall - 1), (70,), 1)
        for line, text in enumerate(_caption(session, frame, told.get(frame.id)), start=1):
            place = (left, top + tall + line * _LINE_PX - 3)
            cv2.putText(sheet, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.34, (_INK,), 1, cv2.LINE_AA)
    return sheet


def _caption(session: Session, frame: PlannedFrame, figures: FrameFigures | None) -> list[str]:
    """Lines under a frame; the font has ASCII alone."""
    title = f"{frame.id} {_kind(frame)}"
    place = (frame.camera_position or "").encode("ascii", "replace").decode()
    if figures is None:
        skipped = session.skipped.get(frame.id)
        why = "not recorded" if skipped is None else f"not needed: {skipped.pixels} px"
        asked = "" if frame.exposure_s is None else f"{1000 * frame.exposure_s:.4g} ms  "
        return [title, asked + place, why]
    exposure = "" if figures.exposure_s is None else f"{1000 * figures.exposure_s:.4g} ms  "
    lines = [title, f"{exposure}sat {_percent(figures.saturated)}  {place}"]
    if figures.modulation is not None:
        lines.append(f"modulation {_percent(figures.modulation)}")
    elif frame.arm_pose is not None:
        azimuth, elevation = np.degrees((frame.arm_pose.azimuth, frame.arm_pose.elevation))
        lines.append(f"az {azimuth:.0f} el {elevation:.0f}")
    return lines


def _kind(frame: PlannedFrame) -> str:
    pattern = frame.pattern
    if isinstance(pattern, PhaseShift):
        return f"{pattern.axis} {pattern.period_px:.4g} px {math.degrees(pattern.shift_rad):.0f}"
    if isinstance(pattern, Gray):
        return f"{pattern.axis} bit {pattern.bit + 1}{' inv' if pattern.inverse else ''}"
    if isinstance(pattern, Uniform):
        return {0.0: "black", 1.0: "white"}.get(pattern.level, f"grey {pattern.level:g}")
    return {Purpose.PHOTOGRAPH: "photo", Purpose.REFERENCE_POSE: "ref"}.get(
        frame.purpose, str(frame.purpose)
    )


def _percent(share: float) -> str:
    return f"{100 * share:.2g}%" if share else "0"
