"""A view of a board, measured in a picture and in the code that the projector shows on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from acquisition.patterns import Axis
from calibration.board_coordinates import projector_coordinates
from calibration.board_views import BoardView
from calibration.boards import Chessboard, detect_corners
from calibration.errors import CalibrationError
from calibration.phase_errors import PhaseErrors, compensate_phase_errors


@dataclass(frozen=True)
class MeasuredView:
    """A board's view, measured.

    Attributes
    ----------
    view : BoardView
        Camera first, projector second.
    correspondence : CorrespondenceMap
        With phase errors compensated, if asked.
    phase_errors : dict
        :class:`~calibration.phase_errors.PhaseErrors` by axis; empty if not asked for.
    """

    view: BoardView
    correspondence: CorrespondenceMap
    phase_errors: dict[Axis, PhaseErrors]


def measure_view(
    name: str,
    picture: NDArray[np.generic],
    correspondence: CorrespondenceMap,
    board: Chessboard,
    *,
    camera_sigma_px: float = 0.1,
    compensate_phases: bool = True,
) -> MeasuredView:
    """Find a board's corners in camera and projector.

    Parameters
    ----------
    name : str
        What the view is called in reports.
    picture : (rows, cols) array
        The board in even light, of the same crop as the correspondence map.
    correspondence : CorrespondenceMap
        Decoded along both axes.
    board : Chessboard or CharucoBoard
    camera_sigma_px : float
        First guess of the noise of a corner in the picture.
    compensate_phases : bool
        Whether periodic errors and the bias at edges are estimated and subtracted.

    Raises
    ------
    CalibrationError
        The board is not found, or not decoded.
    """
    if picture.shape != correspondence.shape:
        raise CalibrationError(
            f"{name}: a picture of {picture.shape} with a correspondence map of "
            f"{correspondence.shape}"
        )
    corners = detect_corners(picture, board, name=name) + np.asarray(correspondence.origin, float)
    errors: dict[Axis, PhaseErrors] = {}
    if compensate_phases:
        correspondence, errors = compensate_phase_errors(correspondence, corners, name=name)
    found = projector_coordinates(correspondence, corners, name=name)
    view = BoardView(
        name,
        (corners, found.pixels),
        (
            np.full(corners.shape[:2], camera_sigma_px),
            found.sigma_px(camera_sigma_px=camera_sigma_px),
        ),
    )
    return MeasuredView(view, correspondence, errors)
