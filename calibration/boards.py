"""Calibration boards: their geometry, and their corners in a picture.

A board is a grid of corners between squares. Corner (row, column) lies at column · square,
row · square, 0 in the board's frame, in millimetres. A plain chessboard is seen whole or not at
all; a ChArUco board numbers its corners by markers, so part of it is enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError

_LEAST_CORNERS = 6
_REFINEMENT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-4)


@dataclass(frozen=True, kw_only=True)
class Chessboard:
    """A board of squares.

    Attributes
    ----------
    columns, rows : int
        Inner corners.
    square_mm : float
        Side of a square: it gives the calibration its scale.
    square_sigma_mm : float
        Standard error of ``square_mm``; it ends as a scale error of everything measured.
    """

    columns: int
    rows: int
    square_mm: float
    square_sigma_mm: float = 0.0

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(
                f"a board of {self.columns}×{self.rows} inner corners is too small; take one of "
                "at least 3×3"
            )
        if not (np.isfinite(self.square_mm) and self.square_mm > 0):
            raise CalibrationError(f"squares of {self.square_mm} mm: the side must be positive")
        if not (np.isfinite(self.square_sigma_mm) and self.square_sigma_mm >= 0):
            raise CalibrationError("the standard error of a square must be zero or positive")

    @property
    def points(self) -> NDArray[np.float64]:
        """(rows, columns, 3) corners of the flat board in its own frame, mm."""
        col, row = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        flat = np.stack([col, row, np.zeros_like(col)], axis=-1)
        return np.asarray(flat * float(self.square_mm), np.float64)


@dataclass(frozen=True, kw_only=True)
class CharucoBoard(Chessboard):
    """A chessboard with markers in its white squares.

    Attributes
    ----------
    marker_mm : float
        Side of a marker.
    dictionary : str
        OpenCV's name of the marker dictionary, ``DICT_5X5_250`` say.
    legacy : bool
        Whether a board with an even number of rows starts with a white square, as OpenCV before
        4.6 printed it.
    """

    marker_mm: float
    dictionary: str = "DICT_5X5_250"
    legacy: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.marker_mm < self.square_mm:
            raise CalibrationError(
                f"markers of {self.marker_mm} mm in squares of {self.square_mm} mm"
            )
        if not hasattr(cv2.aruco, self.dictionary):
            raise CalibrationError(f"OpenCV has no marker dictionary {self.dictionary!r}")

    @property
    def opencv(self) -> cv2.aruco.CharucoBoard:
        """The board as OpenCV draws and finds it."""
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        size = (self.columns + 1, self.rows + 1)
        board = cv2.aruco.CharucoBoard(size, self.square_mm, self.marker_mm, markers)
        board.setLegacyPattern(self.legacy)
        return board


def detect_corners(
    image: NDArray[np.generic], board: Chessboard, *, name: str = "the picture"
) -> NDArray[np.float64]:
    """Find a board's corners to a fraction of a pixel.

    Parameters
    ----------
    image : (rows, cols) array
        Grey picture of any scale.
    board : Chessboard or CharucoBoard
    name : str
        What to call the picture in an error.

    Returns
    -------
    (rows, columns, 2) float64 array
        Pixels (column, row) of the board's corners; NaN where a ChArUco corner is not seen, or
        where no edges meet near the place at which the board has one.

    Raises
    ------
    CalibrationError
        The board is not found, or is too blurred.
    """
    grey = np.asarray(image)
    if grey.ndim != 2 or not grey.size:
        raise CalibrationError(f"{name}: corners are found in grey pictures, not {grey.shape}")
    levels = np.asarray(grey, np.float32)
    if not np.isfinite(levels).all():
        raise CalibrationError(f"{name}: the picture holds values that are not finite")
    low, high = float(levels.min()), float(np.percentile(levels, 99.8))
    if not high > low:
        raise CalibrationError(f"{name}: no board is seen, the picture is uniform")
    levels = np.clip((levels - low) * (255 / (high - low)), 0, 255).astype(np.float32)
    eight_bit = levels.astype(np.uint8)
    find = _charuco_corners if isinstance(board, CharucoBoard) else _chessboard_corners
    coarse = find(eight_bit, board)
    if coarse is None:
        raise CalibrationError(
            f"{name}: no board of {board.columns}×{board.rows} inner corners is seen; check the "
            "number of corners (not squares), the light, and that nothing covers the board"
        )
    seen = np.isfinite(coarse[..., 0])
    window = int(np.clip(0.12 * _spacing(coarse), 2, 12))
    pixels = np.full(coarse.shape, np.nan)
    pixels[seen] = _refined(levels, coarse[seen], window)
    if np.isfinite(pixels[..., 0]).sum() < _LEAST_CORNERS:
        raise CalibrationError(
            f"{name}: a board is seen, but its edges meet nowhere sharply enough; check the focus"
        )
    return pixels


def _refined(
    levels: NDArray[np.float32], start: NDArray[np.float64], window: int
) -> NDArray[np.float64]:
    """Corners (n, 2) where the edges in a window around them meet; NaN where none do.

    OpenCV gives back the start itself where the corner lies outside of the window. From a larger
    one, which may hold parts of a marker, it is found well enough to start from again.
    """
    found = _within(levels, start, window)
    astray = ~np.isfinite(found[:, 0])
    if astray.any():
        nearer = _within(levels, start[astray], 2 * window)
        there = np.isfinite(nearer[:, 0])
        closer = _within(levels, nearer[there], window)
        # Of a blurred board a small window holds too little.
        nearer[there] = np.where(np.isfinite(closer), closer, nearer[there])
        found[astray] = nearer
    return found


def _within(
    levels: NDArray[np.float32], start: NDArray[np.float64], window: int
) -> NDArray[np.float64]:
    at = np.ascontiguousarray(start, np.float32).reshape(-1, 1, 2)
    # In place.
    moved = cv2.cornerSubPix(levels, at.copy(), (window, window), (-1, -1), _REFINEMENT)
    stayed = (moved == at).all(axis=(1, 2))
    return np.where(stayed[:, np.newaxis], np.nan, moved.reshape(-1, 2).astype(np.float64))


def _chessboard_corners(image: NDArray[np.uint8], board: Chessboard) -> NDArray[np.float64] | None:
    flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    found, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=flags)
    if not found:
        found, corners = cv2.findChessboardCorners(image, (board.columns, board.rows))
    if not found:
        return None
    return np.asarray(corners, np.float64).reshape(board.rows, board.columns, 2)


def _charuco_corners(image: NDArray[np.uint8], board: Chessboard) -> NDArray[np.float64] | None:
    assert isinstance(board, CharucoBoard)
    detector = cv2.aruco.CharucoDetector(board.opencv)
    corners, ids, _, _ = detector.detectBoard(image)
    if ids is None or len(ids) < _LEAST_CORNERS:
        return None
    pixels = np.full((board.rows * board.columns, 2), np.nan)
    pixels[np.ravel(ids)] = np.asarray(corners, np.float64).reshape(-1, 2)
    return pixels.reshape(board.rows, board.columns, 2)


def _spacing(corners: NDArray[np.float64]) -> float:
    """Smallest usual distance of neighbouring corners in pixels."""
    gaps = [np.linalg.norm(np.diff(corners, axis=axis), axis=-1) for axis in (0, 1)]
    usual = [np.nanpercentile(gap, 10) for gap in gaps if np.isfinite(gap).any()]
    return float(min(usual)) if usual else 20.0
