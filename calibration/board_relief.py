"""A board as a test surface: reconstruct it densely, and lay its relief over that of other views.

A plane tells little of a calibration by itself, because a real board is none. But its relief is the
same in every view. Each view is reconstructed with a calibration that has not seen it, put into the
board's frame by its corners, and averaged onto a grid by a Gaussian; what differs between the
views is the calibration's error and the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from acquisition.correspondence import CorrespondenceMap
from calibration.boards import Chessboard
from calibration.errors import CalibrationError
from calibration.rig_geometry import RigGeometry
from calibration.triangulation import reconstruct_points

PITCH_MM = 0.25
SIGMA_MM = 1.5
_CORNER_WINDOW_PX = 12
_WHITE_SHARE = 0.5
_LEAST_CORNERS_SHARE = 0.5


@dataclass(frozen=True)
class BoardRelief:
    """A board reconstructed from one view.

    Attributes
    ----------
    height_mm : (rows, cols) float64 array
        Over the rectangle of the corners, on a grid of :data:`PITCH_MM`, plane removed.
    noise_mm : float
        White noise of single heights on the white part, from second differences along rows.
    predicted_noise_mm : float
        What the variances of the decoded coordinates predict for it.
    plane_rms_mm : float
        Single heights on the white part against their plane, noise and relief together.
    scale_error : float
        Length of the board's diagonals over the nominal, less one; where an outer corner is not
        seen, the spread of the corners.
    """

    height_mm: NDArray[np.float64]
    noise_mm: float
    predicted_noise_mm: float
    plane_rms_mm: float
    scale_error: float

    @property
    def noise_over_predicted(self) -> float:
        """Observed noise over predicted."""
        return self.noise_mm / self.predicted_noise_mm


@dataclass(frozen=True)
class Repeatability:
    """How reliefs of one board agree.

    Attributes
    ----------
    difference_mm : (views, rows, cols) float64 array
        Each relief less the mean of the others, plane removed.
    rms_mm : (views,) float64 array
    detrended_rms_mm : (views,) float64 array
        With a quadratic removed as well: what no lens model could bend.
    """

    difference_mm: NDArray[np.float64]
    rms_mm: NDArray[np.float64]
    detrended_rms_mm: NDArray[np.float64]


def reconstruct_board(
    correspondence: CorrespondenceMap,
    corners: NDArray[np.float64],
    board: Chessboard,
    rig: RigGeometry,
    *,
    start_mm: float,
) -> BoardRelief:
    """Reconstruct a board densely.

    Parameters
    ----------
    correspondence : CorrespondenceMap
    corners : (rows, columns, 2) array
        In the camera's full frame, at least half of them seen.
    board : Chessboard
    rig : RigGeometry
    start_mm : float
        First guess of the distance.

    Raises
    ------
    CalibrationError
        Corners missing, or not reconstructed.
    """
    points, variance = reconstruct_points(correspondence, rig, start_mm=start_mm)
    found = _corner_points(points, variance, corners, correspondence.origin, rig)
    known = np.isfinite(found).all(axis=-1)
    if known.sum() < _LEAST_CORNERS_SHARE * known.size:
        raise CalibrationError(
            f"the relief of a board takes most of its corners decoded, not {int(known.sum())} of "
            f"{known.size}"
        )
    turn, shift = _board_frame(found[known], board.points[known])
    on_board = points @ turn.T + shift
    spread = variance * (np.nan_to_num(points / points[..., 2:]) @ turn[2]) ** 2
    white = correspondence.ambient > _WHITE_SHARE * np.nanpercentile(correspondence.ambient, 95)
    inside = _inside(on_board, board, margin_mm=2.0)
    height = np.where(white & inside, on_board[..., 2], np.nan)
    plane = on_board[white & inside]
    terms = np.column_stack([np.ones(len(plane)), plane[:, :2]])
    left = plane[:, 2] - terms @ np.linalg.lstsq(terms, plane[:, 2], rcond=None)[0]
    return BoardRelief(
        _gridded(on_board, spread, board),
        _white_noise(height),
        float(np.sqrt(np.nanmedian(spread[white & inside]))),
        float(np.std(left)),
        _scale_error(found, board.points),
    )


def compare_reliefs(reliefs: list[BoardRelief]) -> Repeatability:
    """Hold each view's relief against the mean of the others.

    Raises
    ------
    CalibrationError
        Fewer than two, or of different boards.
    """
    maps = [relief.height_mm for relief in reliefs]
    if len(maps) < 2 or len({m.shape for m in maps}) != 1:
        raise CalibrationError("reliefs of one board from two views at least can be compared")
    differences, rms, detrended = [], [], []
    for number, relief in enumerate(maps):
        others = np.mean([m for n, m in enumerate(maps) if n != number], axis=0)
        difference = _without_polynomial(relief - others, 1)
        differences.append(difference)
        rms.append(np.sqrt(np.nanmean(difference**2)))
        detrended.append(np.sqrt(np.nanmean(_without_polynomial(difference, 2) ** 2)))
    return Repeatability(np.array(differences), np.array(rms), np.array(detrended))


def _corner_points(
    points: NDArray[np.float64],
    variance: NDArray[np.float64],
    corners: NDArray[np.float64],
    origin: tuple[int, int],
    rig: RigGeometry,
) -> NDArray[np.float64]:
    """Corners in space: depth of a local plane on the corner's ray."""
    corners = corners - np.asarray(origin, np.float64)
    depths = np.full(corners.shape[:2], np.nan)
    reach = _CORNER_WINDOW_PX
    for index in np.ndindex(corners.shape[:2]):
        x, y = corners[index]
        if not np.isfinite((x, y)).all():
            continue
        top, left = max(0, int(y) - reach), max(0, int(x) - reach)
        window = np.s_[top : int(y) + reach + 2, left : int(x) + reach + 2]
        good = np.isfinite(points[window][..., 2]) & (variance[window] > 0)
        if good.sum() < reach**2:
            continue
        row, col = np.nonzero(good)
        design = np.column_stack([np.ones(len(row)), col + left - x, row + top - y])
        weight = 1 / np.sqrt(variance[window][good])
        depths[index] = np.linalg.lstsq(
            design * weight[:, np.newaxis], points[window][good][:, 2] * weight, rcond=None
        )[0][0]
    return depths[..., np.newaxis] * rig.camera.unproject(corners + origin)


def _scale_error(found: NDArray[np.float64], nominal: NDArray[np.float64]) -> float:
    """Relative error of the diagonals, or of the spread of the corners where one is not seen."""
    pairs = ((0, 0, -1, -1), (0, -1, -1, 0))
    diagonal = np.mean([np.linalg.norm(found[a, b] - found[c, d]) for a, b, c, d in pairs])
    if np.isfinite(diagonal):
        return float(diagonal / np.linalg.norm(nominal[-1, -1]) - 1)
    known = np.isfinite(found).all(axis=-1)
    spread = [np.linalg.norm(p[known] - p[known].mean(axis=0)) for p in (found, nominal)]
    return float(spread[0] / spread[1] - 1)


def _board_frame(
    found: NDArray[np.float64], nominal: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation and shift that take points of the camera frame onto the board's (Kabsch 1976)."""
    a, b = found.reshape(-1, 3), nominal.reshape(-1, 3)
    left, _, right = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    proper = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
    turn = left @ proper @ right
    return turn, b.mean(axis=0) - turn @ a.mean(axis=0)


def _inside(
    on_board: NDArray[np.float64], board: Chessboard, *, margin_mm: float
) -> NDArray[np.bool_]:
    far = board.points[-1, -1, :2]
    with np.errstate(invalid="ignore"):
        within = (on_board[..., :2] > -margin_mm) & (on_board[..., :2] < far + margin_mm)
    return np.asarray(within.all(axis=-1))


def _gridded(
    on_board: NDArray[np.float64], spread: NDArray[np.float64], board: Chessboard
) -> NDArray[np.float64]:
    """Heights averaged by inverse variance under a Gaussian, plane removed."""
    margin = 3 * SIGMA_MM
    inside = _inside(on_board, board, margin_mm=margin - PITCH_MM) & (spread > 0)
    far = board.points[-1, -1, :2]
    cols, rows = (int(np.ceil((size + 2 * margin) / PITCH_MM)) for size in far)
    cell = np.round((on_board[inside][:, :2] + margin) / PITCH_MM).astype(int)
    place = np.clip(cell[:, 1], 0, rows - 1) * cols + np.clip(cell[:, 0], 0, cols - 1)
    weight = 1 / spread[inside]
    total = np.bincount(place, weight, rows * cols).reshape(rows, cols)
    sums = np.bincount(place, weight * on_board[inside][:, 2], rows * cols).reshape(rows, cols)
    width = SIGMA_MM / PITCH_MM
    with np.errstate(divide="ignore", invalid="ignore"):
        smooth = gaussian_filter(sums, width) / gaussian_filter(total, width)
    border = round(margin / PITCH_MM)
    return _without_polynomial(smooth[border:-border, border:-border], 1)


def _without_polynomial(height: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    v, u = np.meshgrid(*(np.linspace(-1, 1, n) for n in height.shape), indexing="ij")
    terms = [u**p * v**q for p in range(degree + 1) for q in range(degree + 1 - p)]
    design = np.stack([t.ravel() for t in terms], axis=1)
    known = np.isfinite(height.ravel())
    fit = np.linalg.lstsq(design[known], height.ravel()[known], rcond=None)[0]
    return height - (design @ fit).reshape(height.shape)


def _white_noise(height: NDArray[np.float64]) -> float:
    second = height[:, 2:] - 2 * height[:, 1:-1] + height[:, :-2]
    second = second[np.isfinite(second)]
    return float(1.4826 * np.median(np.abs(second)) / np.sqrt(6))
