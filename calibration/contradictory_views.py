"""Views that contradict the others: corners counted from another end, or a rig that was moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acquisition.plan import Imager
from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.cross_validation import fit_board_pose
from calibration.errors import CalibrationError
from calibration.mrcal_solution import LensSolution
from calibration.mrcal_solve import solve_lenses
from calibration.view_seeds import discord_of_views

_LEAST_VIEWS = 3
# A view is out of line when, held out, it leaves this many times what the others leave.
_CONTRADICTION = 4.0
_LEAST_GAIN = 1.5
# First guesses of a view that is counted wrongly are off by half the board, of others by a few
# hundredths of it.
_DISCORD = 0.25


@dataclass(frozen=True)
class RejectedView:
    """A view that was left out.

    Attributes
    ----------
    name : str
    rms_px : float
        What it leaves against the calibration by the others, per point.
    why : str
    """

    name: str
    rms_px: float
    why: str


def without_contradictions(
    views: list[BoardView], board: Chessboard, imagers: list[Imager], *, model: str
) -> tuple[list[BoardView], tuple[RejectedView, ...]]:
    """Views that agree, by leaving out the worst as long as the others fit much better for it.

    Parameters
    ----------
    views, board, imagers
        As for :func:`~calibration.mrcal_solve.solve_lenses`.
    model : str
        The simplest lens model that may be right.

    Returns
    -------
    kept : list of BoardView
    rejected : tuple of RejectedView
    """
    kept, discordant = _without_discord(views, board, imagers)
    rejected: list[RejectedView] = []

    def solve(some: list[BoardView]) -> LensSolution:
        return solve_lenses(some, board, imagers, model=model, outlier_sigmas=np.inf)

    solution = solve(kept)
    while len(kept) > _LEAST_VIEWS:
        per_view = np.sqrt(np.nanmean(solution.residuals_px**2, axis=(1, 2, 3, 4)))
        worst = int(np.argmax(per_view))
        others = np.delete(per_view, worst)
        if per_view[worst] < 1.5 * np.median(others):
            break
        rest = kept[:worst] + kept[worst + 1 :]
        without = solve(rest)
        left = _left_by(without, kept[worst])
        usual = without.rms_per_point_px
        gain = solution.rms_per_point_px / usual
        if not (gain > _LEAST_GAIN and left > _CONTRADICTION * usual):
            break
        rejected.append(
            RejectedView(
                kept[worst].name,
                left,
                f"its corners are {left:.2f} px off the calibration by the other views, which "
                f"leave {usual:.2f} px themselves: corners counted from another end, another "
                "board, or a rig that was moved",
            )
        )
        kept, solution = rest, without
    for view in discordant:
        left = _left_by(solution, view)
        rejected.append(
            RejectedView(
                view.name,
                left,
                "camera and projector see its board at poses that contradict those of the other "
                "views: corners counted from another end in one of them, or a rig that was moved",
            )
        )
    return kept, tuple(rejected)


def _without_discord(
    views: list[BoardView], board: Chessboard, imagers: list[Imager]
) -> tuple[list[BoardView], list[BoardView]]:
    """Views whose first guesses agree, and those that would lead the solve astray."""
    discord = discord_of_views(views, board, imagers)
    limit = max(_DISCORD, 4 * float(np.nanmedian(discord)))
    kept = [v for v, apart in zip(views, discord, strict=True) if not apart > limit]
    # Where many disagree the guesses are bad, not the views.
    if len(kept) < max(_LEAST_VIEWS, 0.75 * len(views)):
        return list(views), []
    return kept, [v for v, apart in zip(views, discord, strict=True) if apart > limit]


def _left_by(solution: LensSolution, view: BoardView) -> float:
    try:
        return fit_board_pose(
            solution.lenses, solution.rt_lens_ref, view, solution.board_points
        ).rms_per_point_px
    except CalibrationError:
        return float("inf")
