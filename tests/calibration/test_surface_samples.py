from __future__ import annotations

import numpy as np
import pytest

from acquisition.correspondence import AxisCoordinate, CorrespondenceMap
from acquisition.patterns import Axis
from calibration.errors import CalibrationError
from calibration.surface_samples import sample_surface

SHAPE = (300, 400)
ORIGIN = (40, 20)
SQUARE_PX = 30
SIGMA_PX = 0.2
SLOPES = {Axis.COLUMN: (0.9, 0.1), Axis.ROW: (-0.05, 1.1)}
COL, ROW = np.meshgrid(np.arange(8), np.arange(6))
CORNERS = np.stack([SQUARE_PX * COL + 60.0, SQUARE_PX * ROW + 60.0], axis=-1) + ORIGIN


def chessboard(*, rejection=0):
    """A decoded board whose coordinates are linear in the pixel and wrong on its dark squares."""
    rng = np.random.default_rng(1)
    row, col = np.indices(SHAPE)
    dark = ((row // SQUARE_PX + col // SQUARE_PX) % 2).astype(bool)
    axes = {
        axis: AxisCoordinate(
            a * col + b * row + 50.0 * dark + rng.normal(0, SIGMA_PX, SHAPE),
            np.full(SHAPE, SIGMA_PX**2, np.float32),
            np.full(SHAPE, 50.0, np.float32),
            16.0,
            0.0,
        )
        for axis, (a, b) in SLOPES.items()
    }
    ambient = np.where(dark, 10.0, 100.0).astype(np.float32)
    return CorrespondenceMap(axes, ambient, np.full(SHAPE, rejection, np.uint16), ORIGIN, 1.0)


def test_blocks_of_white_have_the_mean_coordinates_of_their_pixels_and_its_variance():
    samples = sample_surface(chessboard(), CORNERS)
    at = samples.pixels - ORIGIN
    true = np.stack([at @ np.array(SLOPES[axis]) for axis in (Axis.COLUMN, Axis.ROW)], axis=1)
    white = (samples.coordinates - true) / np.sqrt(samples.variance)
    assert 0.9 < np.sqrt(np.mean(white**2)) < 1.1
    assert np.abs(white).max() < 5
    # Nothing of an edge, and nothing far beyond the board.
    assert (np.abs((at + 0.5) % SQUARE_PX - SQUARE_PX / 2) < SQUARE_PX / 2 - 3).all()
    margin = 1.5 * SQUARE_PX
    assert ((samples.pixels > CORNERS[0, 0] - margin).all(axis=1)).all()
    assert ((samples.pixels < CORNERS[-1, -1] + margin).all(axis=1)).all()


def test_a_board_that_is_half_seen_is_sampled_all_over():
    half = CORNERS.copy()
    half[:, 4:] = np.nan
    seen, whole = (sample_surface(chessboard(), corners) for corners in (half, CORNERS))
    assert len(seen.pixels) == len(whole.pixels)


def test_corners_without_neighbours_and_boards_without_code_are_refused():
    apart = np.where(((COL + ROW) % 2)[..., np.newaxis], CORNERS, np.nan)
    with pytest.raises(CalibrationError, match="no two neighbouring corners"):
        sample_surface(chessboard(), apart, name="pose 4")
    with pytest.raises(CalibrationError, match="pose 4: only 0 blocks"):
        sample_surface(chessboard(rejection=1), CORNERS, name="pose 4")
