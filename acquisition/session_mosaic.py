"""The mosaic of a session's frames: what its plan says, and what the frames look like."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import SessionError
from acquisition.frame_files import Samples
from acquisition.merged_photographs import photograph_brackets
from acquisition.plan import PlannedFrame, Purpose
from acquisition.session import Session
from devices.bayer import BayerPattern

# Of the photographs, which differ in their light alone.
_LOOKED_AT = 3
# Grids of a monochrome sensor differ by its fixed pattern, 1 to 2 % at the most.
_LEAST_DIFFERENCE = 0.05
_LEAST_SIGMAS = 6.0


def mosaic_of(session: Session, asked: BayerPattern | None = None) -> BayerPattern | None:
    """Order of the colours of a session's camera.

    Parameters
    ----------
    session : Session
    asked : BayerPattern, optional
        What somebody says that it is: needed where the plan does not say, as those of earlier
        versions and of imported captures without a mosaic.

    Returns
    -------
    BayerPattern or None
        From the first pixel of the full frame; None if monochrome or not known.

    Raises
    ------
    SessionError
        The plan says otherwise.
    """
    recorded = session.plan.camera.mosaic
    if None not in (recorded, asked) and recorded is not asked:
        raise SessionError(
            f"{session.path} was recorded by a camera with a mosaic of {recorded}, not {asked}: "
            "leave --mosaic out"
        )
    return recorded or asked


def warning_of_colours(session: Session, mosaic: BayerPattern | None) -> str | None:
    """What to be warned of if photographs that are taken for grey look as if they had a mosaic.

    Parameters
    ----------
    session : Session
        Of photographs.
    mosaic : BayerPattern or None
        By which they are read.

    Returns
    -------
    str or None
        None if there is nothing to be warned of.

    Raises
    ------
    SessionError
        A frame was altered.
    """
    if mosaic is not None:
        return None
    differences = [_difference(session, bracket) for bracket in _some_brackets(session)]
    largest = max(differences, default=0.0)
    if largest < _LEAST_DIFFERENCE:
        return None
    return (
        f"the photographs of {session.path} are taken for grey, but the light of their even and "
        f"odd rows and columns differs by {100 * largest:.0f} %, as through a colour mosaic: "
        "name the order of its colours with --mosaic"
    )


def _some_brackets(session: Session) -> list[list[PlannedFrame]]:
    brackets = photograph_brackets(session)
    return brackets[:: max(1, len(brackets) // _LOOKED_AT)][:_LOOKED_AT]


def _difference(session: Session, bracket: list[PlannedFrame]) -> float:
    """By how much the four grids' means differ, over their mean; 0 where noise explains it."""
    for frame in sorted(bracket, key=lambda f: session.exposure_s(f.id) or 0.0, reverse=True):
        image = session.read_frame(frame.id)
        squares = _squares(image)
        usable = (squares < session.plan.saturation_level).all(axis=1)
        if 2 * usable.sum() < len(squares):
            continue
        light = squares[usable] - _dark_level(session, frame)
        grids = light.mean(axis=0)
        spread = float(grids.max() - grids.min())
        # Within a square the painting differs little: what does is noise and texture.
        noise = (light - light.mean(axis=1, keepdims=True)).std(axis=0).max()
        if spread < _LEAST_SIGMAS * float(noise) / np.sqrt(len(light)):
            return 0.0
        return spread / max(float(grids.mean()), 1.0)
    return 0.0


def _squares(image: Samples) -> NDArray[np.float32]:
    """Samples of each square of two by two pixels, (squares, 4)."""
    rows, cols = (size // 2 * 2 for size in image.shape)
    folded = image[:rows, :cols].reshape(rows // 2, 2, cols // 2, 2)
    return folded.transpose(0, 2, 1, 3).reshape(-1, 4).astype(np.float32)


def _dark_level(session: Session, lit: PlannedFrame) -> float:
    """Median of the frame without light from the same place at the nearest exposure."""
    dark = [
        frame
        for frame in session.frames
        if frame.purpose is Purpose.DARK and frame.camera_position == lit.camera_position
    ]
    wanted = session.exposure_s(lit.id) or 0.0
    nearest = min(dark, key=lambda f: abs((session.exposure_s(f.id) or 0.0) - wanted), default=None)
    return 0.0 if nearest is None else float(np.median(session.read_frame(nearest.id)))
