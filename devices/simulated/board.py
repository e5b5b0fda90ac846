"""A flat matt board with a ChArUco or chessboard pattern, drawn by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from devices.errors import DeviceError
from devices.simulated.surface import Surface, code_albedo

_BLACK = 0.04
_WHITE = 0.85


@dataclass(frozen=True, kw_only=True)
class BoardPattern:
    """What is printed on the board.

    Attributes
    ----------
    squares : (int, int)
        Columns and rows of squares.
    square_mm : float
        Side of a square.
    marker_mm : float or None
        Side of the markers in the white squares; None prints a plain chessboard.
    dictionary : int
        OpenCV's number of the markers' dictionary.
    margin_mm : float
        White border.
    """

    squares: tuple[int, int] = (15, 11)
    square_mm: float = 20.0
    marker_mm: float | None = 15.0
    dictionary: int = cv2.aruco.DICT_5X5_1000
    margin_mm: float = 10.0

    def corners_mm(self) -> NDArray[np.float64]:
        """The inner corners (rows, cols, 3) in the board's frame, top row first."""
        cols, rows = self.squares
        x = (np.arange(1, cols) - cols / 2) * self.square_mm
        y = (rows / 2 - np.arange(1, rows)) * self.square_mm
        grid = np.stack(np.meshgrid(x, y), axis=-1)
        return np.concatenate([grid, np.zeros((*grid.shape[:2], 1))], axis=-1)

    def charuco(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's description of the board, for its detector.

        Raises
        ------
        DeviceError
            It is a plain chessboard.
        """
        if self.marker_mm is None:
            raise DeviceError("this board is a plain chessboard, without markers")
        dictionary = cv2.aruco.getPredefinedDictionary(self.dictionary)
        return cv2.aruco.CharucoBoard(self.squares, self.square_mm, self.marker_mm, dictionary)


def make_board(
    pattern: BoardPattern | None = None, *, pitch_mm: float = 0.1, warp_mm: float = 0.0
) -> Surface:
    """The board as a surface, its pattern about the origin.

    Parameters
    ----------
    pattern : BoardPattern, optional
    pitch_mm : float
        Spacing of the grid; a whole number of cells makes a square.
    warp_mm : float
        By which its middle stands out before its edges.

    Raises
    ------
    DeviceError
        The square is not a whole number of cells.
    """
    pattern = pattern or BoardPattern()
    cells = round(pattern.square_mm / pitch_mm)
    if abs(cells * pitch_mm - pattern.square_mm) > 1e-9:
        raise DeviceError(
            f"squares of {pattern.square_mm:g} mm are no whole number of cells of {pitch_mm:g} mm"
        )
    cols, rows = pattern.squares
    if pattern.marker_mm is None:
        black = np.add.outer(np.arange(rows), np.arange(cols)) % 2 == 0
        printed = np.kron(np.where(black, 0, 255).astype(np.uint8), np.ones((cells, cells), "u1"))
    else:
        printed = pattern.charuco().generateImage((cols * cells, rows * cells), None, 0, 1)
    margin = round(pattern.margin_mm / pitch_mm)
    picture = np.pad(printed, margin, constant_values=255)
    size = (picture.shape[1] - 1) * pitch_mm, (picture.shape[0] - 1) * pitch_mm
    height = np.zeros(picture.shape, np.float32)
    if warp_mm:
        u, v = (np.linspace(-1, 1, n) for n in picture.shape[::-1])
        height += (warp_mm * np.outer(1 - v**2, 1 - u**2)).astype(np.float32)
    blank = Surface.uniform(
        height, pitch_mm=pitch_mm, canvas_mm=size, albedo=_WHITE, roughness=0.9, back_mm=-4.0
    )
    code = np.where(picture > 127, code_albedo(_WHITE), code_albedo(_BLACK)).astype(np.uint8)
    blank.albedo[:] = code[..., np.newaxis]
    return blank
