"""Projector coordinates of a board's white parts, averaged over blocks of pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from acquisition.correspondence import CorrespondenceMap
from acquisition.patterns import Axis
from calibration.board_surface import MARGIN_SQUARES
from calibration.errors import CalibrationError
from calibration.phase_errors import board_position

_WHITE_SHARE = 0.5
_EDGE_PX = 3
_BLOCK_PX = (4, 12)
_LEAST_FILLED = 0.4
_LEAST_BLOCKS = 100
# Blocks across a tile whose mean tells how far neighbours err alike.
_TILE = 6


@dataclass(frozen=True)
class SurfaceSamples:
    """Projector coordinates of a board's white parts, averaged over blocks of pixels.

    Attributes
    ----------
    pixels : (n, 2) float64 array
        Of the camera, full frame.
    coordinates, variance : (n, 2) float64 arrays
        Projector column and row, and their variances by the noise of the pixels alone.
    tile : (n,) int array
        Which neighbourhood a block belongs to.
    """

    pixels: NDArray[np.float64]
    coordinates: NDArray[np.float64]
    variance: NDArray[np.float64]
    tile: NDArray[np.int_]


def sample_surface(
    correspondence: CorrespondenceMap,
    corners: NDArray[np.float64],
    *,
    block_px: int | None = None,
    name: str = "the view",
) -> SurfaceSamples:
    """Average the projector coordinates of a board's white parts over blocks of pixels.

    Parameters
    ----------
    correspondence : CorrespondenceMap
        Decoded along both axes.
    corners : (rows, columns, 2) array
        In the camera's full frame.
    block_px : int, optional
        Side of a block; by default a quarter of a square in the picture, 4 to 12: the relief is
        smooth over it.
    name : str
        What to call the view in an error.

    Raises
    ------
    CalibrationError
        Too little of the board was seen, or of its white decoded.
    """
    along_rows = np.linalg.norm(np.diff(corners, axis=1), axis=-1)
    if not np.isfinite(along_rows).any():
        raise CalibrationError(
            f"{name}: no two neighbouring corners of a row of the board are seen; show more of it"
        )
    square_px = float(np.nanmedian(along_rows))
    block_px = block_px or int(np.clip(round(square_px / 4), *_BLOCK_PX))
    u, v, _ = board_position(correspondence, corners)
    rows, columns = corners.shape[:2]
    reach = 1 + 1.5 * MARGIN_SQUARES / (np.array([columns, rows]) - 1)
    on_board = (np.abs(u) < reach[0]) & (np.abs(v) < reach[1])
    bright = float(np.nanpercentile(correspondence.ambient[on_board], 95))
    white = on_board & correspondence.valid & (correspondence.ambient > _WHITE_SHARE * bright)
    # Across an edge of the print blur draws a coordinate to the brighter side.
    row, col = np.nonzero(binary_erosion(white, iterations=_EDGE_PX))
    across = correspondence.shape[1] // block_px + 1
    block = (row // block_px) * across + col // block_px
    _, member, count = np.unique(block, return_inverse=True, return_counts=True)

    def mean(values: NDArray[np.generic]) -> NDArray[np.float64]:
        return np.bincount(member, np.asarray(values, np.float64)) / count

    axes = [correspondence.axes[axis] for axis in (Axis.COLUMN, Axis.ROW)]
    pixels = np.stack([mean(col), mean(row)], axis=1)
    coordinates = np.stack([mean(a.coordinate[row, col]) for a in axes], axis=1)
    variance = np.stack([mean(a.variance[row, col]) / count for a in axes], axis=1)
    filled = count > _LEAST_FILLED * block_px**2
    if filled.sum() < _LEAST_BLOCKS:
        raise CalibrationError(
            f"{name}: only {int(filled.sum())} blocks of the board's white were decoded, and "
            f"{_LEAST_BLOCKS} are needed for its shape: white parts lose {_EDGE_PX} pixels at each "
            f"edge, and squares are {square_px:.0f} pixels here. Come nearer, take a board of "
            "larger squares without markers, or check exposure and focus of the fringes"
        )
    tile = (pixels // (_TILE * block_px)).astype(int) @ np.array([1, 10_000])
    return SurfaceSamples(
        (pixels + correspondence.origin)[filled],
        coordinates[filled],
        variance[filled],
        tile[filled],
    )
