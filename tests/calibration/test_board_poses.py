import numpy as np
import pytest

from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.cross_validation import fit_board_pose
from calibration.lens import Lens, transform

BOARD = Chessboard(columns=12, rows=9, square_mm=8.0)
LENS = Lens.from_opencv(
    np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]), np.zeros(5), width=640, height=480
)
POSE = np.array([0.3, -0.2, 0.1, -40.0, -30.0, 400.0])
SIGMA_PX = 0.05


def view_of(corners_off, *, step=25):
    """A view with noise, and some corners, every so many, that were found two pixels beside."""
    pixels = LENS.project(transform(POSE, BOARD.points))
    pixels = pixels + np.random.default_rng(0).normal(0, SIGMA_PX, pixels.shape)
    pixels.reshape(-1, 2)[: corners_off * step : step] += [1.6, -1.2]
    return BoardView.of("board", [pixels], sigma_px=SIGMA_PX)


def fitted(corners_off, *, step=25, **options):
    view = view_of(corners_off, step=step)
    return fit_board_pose((LENS,), np.zeros((1, 6)), view, BOARD.points, **options)


@pytest.mark.parametrize("corners_off", [0, 1, 3])
def test_a_corner_found_wrongly_says_nothing_about_a_pose(corners_off):
    found = fitted(corners_off, outlier_sigmas=5.0)
    assert found.weighted_rms == pytest.approx(1.0, abs=0.1)
    assert np.isnan(found.residuals_px[0, ..., 0]).sum() == corners_off
    np.testing.assert_allclose(found.rt_ref_board[3:], POSE[3:], atol=0.05)
    if corners_off:
        assert fitted(corners_off).weighted_rms > 1.5


def test_a_pose_that_many_corners_contradict_is_as_bad_as_it_is():
    found = fitted(12, step=9, outlier_sigmas=5.0)
    assert found.weighted_rms > 5
    assert np.isfinite(found.residuals_px).all()


def test_a_board_that_is_bent_in_one_corner_is_as_bad_as_it_is():
    """Neighbours are not found wrongly together."""
    bent = BOARD.points.copy()
    bent[:2, :2, 2] += 4.0
    pixels = LENS.project(transform(POSE, bent))
    pixels = pixels + np.random.default_rng(0).normal(0, SIGMA_PX, pixels.shape)
    view = BoardView.of("board", [pixels], sigma_px=SIGMA_PX)
    found = fit_board_pose((LENS,), np.zeros((1, 6)), view, BOARD.points, outlier_sigmas=5.0)
    assert found.weighted_rms > 5
