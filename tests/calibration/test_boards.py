from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibration import boards
from calibration.board_views import BoardView
from calibration.boards import CharucoBoard, Chessboard, detect_corners
from calibration.errors import CalibrationError

BOARD = Chessboard(columns=8, rows=5, square_mm=10.0)
CHARUCO = CharucoBoard(columns=8, rows=5, square_mm=10.0, marker_mm=7.0)


def seen_from_aside(drawn, *, scale, size=(640, 480)):
    """A drawn board, whose square is `scale` pixels, as a camera sees it; and the homography."""
    height, width = drawn.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    seen = np.array([[70, 60], [590, 90], [560, 420], [90, 400]], np.float32)
    homography = cv2.getPerspectiveTransform(corners, seen)
    big = cv2.warpPerspective(
        drawn,
        np.diag([4.0, 4, 1]) @ homography,
        (size[0] * 4, size[1] * 4),
        flags=cv2.INTER_AREA,
        borderValue=255,
    )
    small = cv2.resize(cv2.GaussianBlur(big, (0, 0), 4), size, interpolation=cv2.INTER_AREA)
    return small, homography, scale


def true_corners(homography, scale, *, margin):
    # The edge between the pixels p - 1 and p of the drawn board is at p - 0.5.
    grid = np.stack(np.meshgrid(np.arange(1, 9), np.arange(1, 6)), axis=-1) * scale + margin - 0.5
    flat = cv2.perspectiveTransform(grid.reshape(1, -1, 2).astype(float), homography)
    # Four pixels of the large picture, the first at -1.5 of their middle, make one.
    return (flat.reshape(5, 8, 2) * 4 - 1.5) / 4


def drawn_chessboard(scale, margin):
    squares = np.indices((6, 9)).sum(axis=0) % 2 * 255
    drawn = np.kron(squares, np.ones((scale, scale))).astype(np.uint8)
    return np.pad(drawn, margin, constant_values=255)


def test_corners_of_a_chessboard_are_found_to_a_fraction_of_a_pixel():
    picture, homography, scale = seen_from_aside(drawn_chessboard(60, 60), scale=60)
    noisy = picture + np.random.default_rng(0).normal(0, 2, picture.shape)
    found = detect_corners(noisy, BOARD)
    true = true_corners(homography, scale, margin=60)
    if np.linalg.norm(found[0, 0] - true[0, 0]) > 50:
        found = found[::-1, ::-1]
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.08


def test_a_charuco_board_may_be_hidden_in_part():
    drawn = CHARUCO.opencv.generateImage((540, 360), marginSize=0)
    drawn = np.pad(drawn, 60, constant_values=255)
    picture, homography, scale = seen_from_aside(drawn, scale=60)
    true = true_corners(homography, scale, margin=60)
    whole = detect_corners(picture, CHARUCO)
    assert np.isfinite(whole).all()
    assert np.sqrt(np.mean((whole - true) ** 2)) < 0.15
    hidden = picture.copy()
    hidden[:, 420:] = 128
    part = detect_corners(hidden, CHARUCO)
    seen = np.isfinite(part[..., 0])
    assert 6 <= seen.sum() < 40
    assert np.abs(part[seen] - true[seen]).max() < 0.5


def test_a_corner_whose_first_guess_is_far_off_is_found_or_not_there(monkeypatch):
    """OpenCV gives the guess back where the corner lies outside of its window."""
    picture, _, _ = seen_from_aside(drawn_chessboard(60, 60), scale=60)
    right = detect_corners(picture, BOARD)
    guess = right + 0.3
    guess[1, 2] += [6.0, -4.0]  # the window reaches 5 pixels
    guess[3, 4] += 0.5 * (right[3, 5] - right[3, 4]) + 0.5 * (right[4, 4] - right[3, 4])
    monkeypatch.setattr(boards, "_chessboard_corners", lambda image, board: guess)
    found = detect_corners(picture, BOARD)
    assert np.isnan(found[3, 4]).all()  # the middle of a square, where no edges meet
    found[3, 4] = right[3, 4]
    assert np.abs(found - right).max() < 0.02


def test_corners_of_a_blurred_board_are_found_in_the_larger_window():
    picture, homography, scale = seen_from_aside(drawn_chessboard(60, 60), scale=60)
    small = cv2.resize(picture, (320, 240), interpolation=cv2.INTER_AREA)
    found = detect_corners(cv2.GaussianBlur(small, (0, 0), 2.0), BOARD)
    true = (true_corners(homography, scale, margin=60) - 0.5) / 2
    if np.linalg.norm(found[0, 0] - true[0, 0]) > 25:
        found = found[::-1, ::-1]
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.1


@pytest.mark.parametrize(
    ("picture", "why"),
    [
        (np.zeros((50, 60, 3)), "grey pictures"),
        (np.full((50, 60), 7.0), "uniform"),
        (np.full((50, 60), np.nan), "not finite"),
        (np.random.default_rng(0).uniform(size=(200, 300)), "no board of 8×5"),
    ],
)
def test_pictures_without_a_board_are_refused_by_name(picture, why):
    with pytest.raises(CalibrationError, match=f"left.png.*{why}"):
        detect_corners(picture, BOARD, name="left.png")


def test_impossible_boards_are_refused():
    with pytest.raises(CalibrationError, match="too small"):
        Chessboard(columns=2, rows=5, square_mm=10)
    with pytest.raises(CalibrationError, match="must be positive"):
        Chessboard(columns=4, rows=5, square_mm=float("nan"))
    with pytest.raises(CalibrationError, match="markers of 12"):
        CharucoBoard(columns=4, rows=5, square_mm=10, marker_mm=12)
    with pytest.raises(CalibrationError, match="no marker dictionary"):
        CharucoBoard(columns=4, rows=5, square_mm=10, marker_mm=7, dictionary="DICT_X")


def test_views_check_what_they_are_given():
    pixels = np.ones((5, 8, 2))
    with pytest.raises(CalibrationError, match="noise of a corner must be positive"):
        BoardView.of("pose 1", [pixels], sigma_px=0.0)
    with pytest.raises(CalibrationError, match="every lens needs"):
        BoardView("pose 1", (pixels, pixels[:4]), (np.ones((5, 8)), np.ones((5, 8))))
    view = BoardView.of("pose 1", [np.arange(80.0).reshape(5, 8, 2)], sigma_px=0.1)
    np.testing.assert_array_equal(view.turned().turned().pixels[0], view.pixels[0])
