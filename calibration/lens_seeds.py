"""First guesses of lenses and board poses, good enough for an optimiser to start from.

Focal lengths and principal points are tried on a grid: a projector's principal point may lie
outside its panel, where closed-form methods (Zhang 2000) and OpenCV's calibration fail. For each
guess, pixels become directions (a pinhole, or the stereographic projection for wide lenses), the
poses follow by OpenCV's ``solvePnP``, and the guess that projects best is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError

_FOCAL_OVER_WIDTH = np.geomspace(0.28, 4.0, 16)
_CENTRES = (0.5, 0.0, 1.0, -0.3, 1.3)
_MOST_VIEWS = 8
_LEAST_POINTS = 6
_WIDEST_SLOPE = 5.0


@dataclass(frozen=True)
class LensSeed:
    """A guess of one lens.

    Attributes
    ----------
    core : (4,) float64 array
        f_x, f_y, c_x, c_y in pixels.
    wide : bool
        Whether the guess is of a stereographic projection instead of a pinhole.
    rt_lens_board : (views, 6) float64 array
        Board poses; NaN where a view has too few corners.
    rms_px : float
        What the guess leaves, over the views that it was made from.
    """

    core: NDArray[np.float64]
    wide: bool
    rt_lens_board: NDArray[np.float64]
    rms_px: float


def seed_lens(
    board: NDArray[np.float64],
    pixels: NDArray[np.float64],
    *,
    width: int,
    height: int,
    wide: bool,
) -> LensSeed:
    """Guess a lens and its board poses.

    Parameters
    ----------
    board : (rows, columns, 3) array
        Corners in the board's frame, mm.
    pixels : (views, rows, columns, 2) array
        Where they are seen, NaN where not.
    width, height : int
        Imager size.
    wide : bool
        Guess a stereographic projection instead of a pinhole.

    Raises
    ------
    CalibrationError
        No view has corners enough.
    """
    points = board.reshape(-1, 3)
    views = pixels.reshape(len(pixels), -1, 2)
    counts = np.isfinite(views[..., 0]).sum(axis=1)
    usable = np.flatnonzero(counts >= _LEAST_POINTS)
    if not len(usable):
        raise CalibrationError(
            f"no view shows {_LEAST_POINTS} corners of the board, so no pose can be found"
        )
    some = usable[np.linspace(0, len(usable) - 1, min(_MOST_VIEWS, len(usable))).astype(int)]
    best = (np.inf, np.zeros(4))
    for focal in _FOCAL_OVER_WIDTH * width:
        for across, down in product(_CENTRES, _CENTRES):
            if across != 0.5 and down != 0.5:
                continue
            core = np.array([focal, focal, across * (width - 1), down * (height - 1)])
            cost = sum(min(_pose(points, views[v], core, wide)[1], 1e12) for v in some)
            if cost < best[0]:
                best = (cost, core)
    core = best[1]
    poses = np.full((len(views), 6), np.nan)
    for view in usable:
        poses[view] = _pose(points, views[view], core, wide)[0]
    return LensSeed(core, wide, poses, float(np.sqrt(best[0] / counts[some].sum())))


def _pose(
    points: NDArray[np.float64], pixels: NDArray[np.float64], core: NDArray[np.float64], wide: bool
) -> tuple[NDArray[np.float64], float]:
    """Board pose for a guessed lens, and the sum of its squared errors in pixels."""
    flat = (pixels - core[2:]) / core[:2]
    if wide:
        # Stereographic: 2 tan(θ/2) from the axis; the slope is tan θ.
        quarter = np.sum(flat**2, axis=-1, keepdims=True) / 4
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = np.where(quarter < 1, flat / (1 - quarter), np.nan)
    with np.errstate(invalid="ignore"):
        good = np.linalg.norm(flat, axis=-1) < _WIDEST_SLOPE
    if good.sum() < _LEAST_POINTS:
        return np.full(6, np.nan), np.inf
    try:
        found, rotation, translation = cv2.solvePnP(
            points[good], flat[good], np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return np.full(6, np.nan), np.inf
    if not found or not np.isfinite(translation).all():
        return np.full(6, np.nan), np.inf
    in_lens = points @ cv2.Rodrigues(rotation)[0].T + translation.ravel()
    seen = np.isfinite(pixels[:, 0])
    projected = _project(in_lens, core, wide)
    cost = float(np.sum((projected - pixels)[seen] ** 2))
    return np.concatenate([rotation.ravel(), translation.ravel()]), cost


def _project(
    points: NDArray[np.float64], core: NDArray[np.float64], wide: bool
) -> NDArray[np.float64]:
    depth = points[:, 2:]
    if wide:
        depth = (np.linalg.norm(points, axis=-1, keepdims=True) + depth) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = np.where(depth > 0, points[:, :2] / depth, 1e6)
    return np.asarray(flat * core[:2] + core[2:])
