"""First guesses of several lenses from the poses of a board, and of the poses between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acquisition.plan import Imager
from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.errors import CalibrationError
from calibration.lens import compose, invert, transform
from calibration.lens_seeds import LensSeed, seed_lens

# Pixels that a guessed pinhole may leave, beyond which a wide lens is tried, over the diagonal.
_POOR_SEED = 0.02


def discord_of_views(
    views: list[BoardView], board: Chessboard, imagers: list[Imager]
) -> NDArray[np.float64]:
    """How far each view is from the pose between the first two lenses that most views agree on.

    From first guesses alone, so that a view which would lead the solve astray is known before it.

    Returns
    -------
    (views,) float64 array
        Mean displacement of the board's outer corners over its diagonal; NaN where a view is not
        seen by both.
    """
    check_views(views, board, imagers)
    pixels = [np.stack([view.pixels[k] for view in views]) for k in range(2)]
    seeds = seed_lenses(board, pixels, imagers[:2], stereographic=False)
    both, apart = _poses_apart(board, seeds[0].rt_lens_board, seeds[1].rt_lens_board)
    discord = np.full(len(views), np.nan)
    agreed = int(np.argmin(np.median(apart, axis=1)))
    discord[both] = apart[agreed] / np.linalg.norm(board.points[-1, -1])
    return discord


def check_views(views: list[BoardView], board: Chessboard, imagers: list[Imager]) -> None:
    """Refuse views from which nothing can be solved.

    Raises
    ------
    CalibrationError
        Fewer than three, or one that does not fit board or lenses, or shows next to nothing.
    """
    if len(views) < 3:
        raise CalibrationError(
            f"{len(views)} views of the board: a calibration takes three at least, better ten, "
            "with different tilts"
        )
    for view in views:
        if len(view.pixels) != len(imagers):
            raise CalibrationError(
                f"{view.name}: seen by {len(view.pixels)} lenses, {len(imagers)} are calibrated"
            )
        if view.pixels[0].shape[:2] != (board.rows, board.columns):
            raise CalibrationError(
                f"{view.name}: {view.pixels[0].shape[:2]} corners, the board has "
                f"{(board.rows, board.columns)}"
            )
        for number, seen in enumerate(view.seen):
            if 0 < seen.sum() < 6 or (number == 0 and not seen.any()):
                raise CalibrationError(
                    f"{view.name}: lens {number + 1} sees {int(seen.sum())} corners; leave the "
                    "view out or record it again"
                )


def seed_lenses(
    board: Chessboard,
    pixels: list[NDArray[np.float64]],
    imagers: list[Imager],
    *,
    stereographic: bool,
) -> list[LensSeed]:
    """Guesses of pinholes, or of stereographic lenses where those do better or are asked for.

    Parameters
    ----------
    board : Chessboard
    pixels : list of (views, rows, columns, 2) array
        Corners by lens; NaN where one is not seen.
    imagers : list of Imager
    stereographic : bool

    Raises
    ------
    CalibrationError
        No view has corners enough.
    """

    def of(wide: bool) -> list[LensSeed]:
        return [
            seed_lens(board.points, p, width=i.width, height=i.height, wide=wide)
            for p, i in zip(pixels, imagers, strict=True)
        ]

    if stereographic:
        return of(True)
    seeds = of(False)
    diagonals = [np.hypot(i.width, i.height) for i in imagers]
    if any(s.rms_px > _POOR_SEED * d for s, d in zip(seeds, diagonals, strict=True)):
        wide = of(True)
        if sum(s.rms_px for s in wide) < sum(s.rms_px for s in seeds):
            return wide
    return seeds


def relative_pose(
    board: Chessboard, first: NDArray[np.float64], other: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The pose between two lenses that most views agree on, of those that each view gives.

    Parameters
    ----------
    board : Chessboard
    first, other : (views, 6) array
        Poses of the board before each lens; NaN where it is not seen.

    Returns
    -------
    (6,) float64 array
        From the first lens's frame to the other's.

    Raises
    ------
    CalibrationError
        No view is seen by both.
    """
    both, apart = _poses_apart(board, first, other)
    agreed = both[int(np.argmin(np.median(apart, axis=1)))]
    return compose(other[agreed], invert(first[agreed]))


def _poses_apart(
    board: Chessboard, first: NDArray[np.float64], other: NDArray[np.float64]
) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
    """Views with both poses; mm by which the pose between lenses of one misplaces another's board.

    Rows of the second are the views that give the pose, columns those that it is tried on.
    """
    both = np.flatnonzero(np.isfinite(first[:, 0]) & np.isfinite(other[:, 0]))
    if not len(both):
        raise CalibrationError("no view of the board is seen by both camera and projector")
    corners = board.points[:: board.rows - 1, :: board.columns - 1].reshape(-1, 3)
    here = [transform(first[v], corners) for v in both]
    there = [transform(other[v], corners) for v in both]
    apart = np.empty((len(both), len(both)))
    for row, v in enumerate(both):
        rt = compose(other[v], invert(first[v]))
        apart[row] = [
            np.linalg.norm(transform(rt, a) - b, axis=-1).mean()
            for a, b in zip(here, there, strict=True)
        ]
    return both, apart
