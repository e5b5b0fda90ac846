"""A board as a test surface: reconstruct it densely, and lay its relief over that of other views.

A plane tells little of a calibration by itself, because a real board is none. But its relief is the
same in every view. Each view is reconstructed with a calibration that has not seen it, put into the
board's frame by its corners, and averaged onto a grid by a Gaussian; what differs between the
views is the calibration's error and the noise.

Rays that pass beside a tilted board meet a wall where the board's columns and rows would be, so
what belongs to it is told in the picture: pixels inside the outline of its corners' rectangle. Of
these, points far off the surface that the others form are something before the board.

Where both axes were decoded, only that along the baseline is asked for depth. The other tells
hardly anything of it, but if camera and projector have moved since by some ten-thousandths of a
radian the two disagree by a pixel, and variances that follow the fringes weave that into the
surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from acquisition.correspondence import CorrespondenceMap
from acquisition.patterns import Axis
from acquisition.robust_spread import robust_sigma
from calibration.boards import Chessboard
from calibration.errors import CalibrationError
from calibration.lens import transform
from calibration.rig_geometry import RigGeometry
from calibration.triangulation import reconstruct_points

PITCH_MM = 0.25
SIGMA_MM = 1.5
_CORNER_WINDOW_PX = 12
# Of a square, by which the board surely reaches beyond its outermost corners.
_RIM_SHARE = 0.75
_ON_EDGE = 16
# Points farther off a quadratic through the others are not of the board.
_OFF_SIGMAS = 8.0
_LEAST_OFF_MM = 0.05
# Of the points inside the outline, how many may be off the surface.
_LARGEST_OFF_SHARE = 0.1
_LEAST_WHITE = 100
_FITTED_FIRST = 5000
_ROUNDS = 20
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
    off_share : float
        Share of the points inside the board's outline that are not on its surface and were left
        out: something stands before it, or was decoded wrongly.
    smoothed_noise_mm : float
        What the variances of the decoded coordinates predict for ``height_mm``, root mean square.
    """

    height_mm: NDArray[np.float64]
    noise_mm: float
    predicted_noise_mm: float
    plane_rms_mm: float
    scale_error: float
    off_share: float = 0.0
    smoothed_noise_mm: float = 0.0

    @property
    def noise_over_predicted(self) -> float:
        """Observed noise over predicted."""
        return self.noise_mm / self.predicted_noise_mm

    @property
    def plane_over_noise(self) -> float:
        """Deviation of single heights from their plane over the predicted noise."""
        return self.plane_rms_mm / self.predicted_noise_mm


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
        Corners missing or not reconstructed, or much of the board hidden.
    """
    single = _along_baseline(correspondence, corners, rig, start_mm)
    points, variance = reconstruct_points(single, rig, start_mm=start_mm)
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
    pictured = _outline(board, turn, shift, rig, correspondence) & np.isfinite(on_board[..., 2])
    near = pictured & _on_surface(on_board, pictured)
    off_share = 1 - near.sum() / max(int(pictured.sum()), 1)
    if off_share > _LARGEST_OFF_SHARE:
        raise CalibrationError(
            f"{off_share:.0%} of the points inside the board's outline are not on its surface: "
            "something hides it, or its fringes were decoded wrongly"
        )
    on_board = np.where(near[..., np.newaxis], on_board, np.nan)
    white = correspondence.ambient > _WHITE_SHARE * np.nanpercentile(correspondence.ambient, 95)
    flat = white & _inside(on_board, board, margin_mm=2.0)
    plane = on_board[flat]
    if len(plane) < _LEAST_WHITE:
        raise CalibrationError(f"{len(plane)} pixels of the board's white part were decoded")
    terms = np.column_stack([np.ones(len(plane)), plane[:, :2]])
    left = plane[:, 2] - terms @ np.linalg.lstsq(terms, plane[:, 2], rcond=None)[0]
    height, smoothed_noise = _gridded(on_board, spread, board)
    return BoardRelief(
        height,
        _white_noise(np.where(flat, on_board[..., 2], np.nan)),
        float(np.sqrt(np.nanmedian(spread[flat]))),
        float(np.std(left)),
        _scale_error(found, board.points),
        float(off_share),
        smoothed_noise,
    )


def _along_baseline(
    correspondence: CorrespondenceMap,
    corners: NDArray[np.float64],
    rig: RigGeometry,
    start_mm: float,
) -> CorrespondenceMap:
    """With the one axis that moves more when a point in the board's middle moves on its ray."""
    ray = rig.camera.unproject(np.nanmean(corners, axis=(0, 1)))
    ends = np.outer([start_mm, 1.01 * start_mm], ray / ray[2])
    moved = np.abs(np.diff(rig.projector.project(transform(rig.rt_proj_cam, ends)), axis=0)[0])
    by_axis = dict(zip((Axis.COLUMN, Axis.ROW), moved, strict=True))
    axis = max(correspondence.axes, key=lambda axis: by_axis[axis])
    return replace(correspondence, axes={axis: correspondence.axes[axis]})


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


def deviation_from_polynomial(height_mm: NDArray[np.float64], degree: int) -> float:
    """Root mean square of a map of heights, a polynomial of a degree removed, mm.

    Parameters
    ----------
    height_mm : (rows, cols) array
        NaN where nothing is known.
    degree : int
        Of both coordinates together.
    """
    return float(np.sqrt(np.nanmean(_without_polynomial(height_mm, degree) ** 2)))


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


def _outline(
    board: Chessboard,
    turn: NDArray[np.float64],
    shift: NDArray[np.float64],
    rig: RigGeometry,
    correspondence: CorrespondenceMap,
) -> NDArray[np.bool_]:
    """Pixels inside the outline of the board's rim, which lies within its outermost squares."""
    rim = min(3 * SIGMA_MM, _RIM_SHARE * board.square_mm)
    right, bottom = board.points[-1, -1, :2] + rim
    along = np.linspace(0, 1, _ON_EDGE, endpoint=False)
    ends = np.array([[-rim, -rim], [right, -rim], [right, bottom], [-rim, bottom]])
    steps = np.roll(ends, -1, axis=0) - ends
    edges = ends[:, np.newaxis] + along[:, np.newaxis] * steps[:, np.newaxis]
    on_rim = np.column_stack([edges.reshape(-1, 2), np.zeros(4 * _ON_EDGE)])
    pixels = rig.camera.project((on_rim - shift) @ turn) - np.asarray(correspondence.origin)
    mask = np.zeros(correspondence.shape, np.uint8)
    cv2.fillPoly(mask, [np.round(pixels).astype(np.int32)], [1.0])
    return mask.astype(bool)


def _on_surface(on_board: NDArray[np.float64], where: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which points lie near the quadratic through most of them, by its robust spread."""
    x, y, z = on_board[where].T
    near = np.zeros(where.shape, np.bool_)
    if len(z) < _LEAST_WHITE:
        return near
    u, v = x / np.ptp(x), y / np.ptp(y)
    terms = np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])
    # Least absolute deviations, by weights, of some of the points: what hides a part does not pull.
    some = slice(None, None, max(1, len(z) // _FITTED_FIRST))
    weight = np.ones(len(z[some]))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)[:, np.newaxis]
        fit = np.linalg.lstsq(terms[some] * root, z[some] * root[:, 0], rcond=None)[0]
        weight = 1 / np.maximum(np.abs(z[some] - terms[some] @ fit), 1e-4)
    for _ in range(3):
        off = z - terms @ fit
        kept = np.abs(off) <= max(_OFF_SIGMAS * robust_sigma(off), _LEAST_OFF_MM)
        fit = np.linalg.lstsq(terms[kept], z[kept], rcond=None)[0]
    near[where] = kept
    return near


def _inside(
    on_board: NDArray[np.float64], board: Chessboard, *, margin_mm: float
) -> NDArray[np.bool_]:
    far = board.points[-1, -1, :2]
    with np.errstate(invalid="ignore"):
        within = (on_board[..., :2] > -margin_mm) & (on_board[..., :2] < far + margin_mm)
    return np.asarray(within.all(axis=-1))


def _gridded(
    on_board: NDArray[np.float64], spread: NDArray[np.float64], board: Chessboard
) -> tuple[NDArray[np.float64], float]:
    """Heights averaged by inverse variance under a Gaussian, plane removed, and their noise."""
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
        under = gaussian_filter(total, width)
        smooth = gaussian_filter(sums, width) / under
        # A Gaussian squared is one narrower by √2, and 4π its variance times smaller in all.
        variance = gaussian_filter(total, width / np.sqrt(2)) / (4 * np.pi * width**2 * under**2)
    border = round(margin / PITCH_MM)
    part = np.s_[border:-border, border:-border]
    noise = float(np.sqrt(np.nanmean(np.where(np.isfinite(smooth), variance, np.nan)[part])))
    return _without_polynomial(smooth[part], 1), noise


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
    return float(robust_sigma(second) / np.sqrt(6))
