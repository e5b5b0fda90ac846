from __future__ import annotations

import numpy as np

from calibration.board_shape import similarities, solve_with_shape
from calibration.mrcal_solve import solve_lenses
from workstation.benchmarks.simulated_boards import BOARD, CAMERA, PROJECTOR, simulate_boards

SHEAR = 1e-3


def test_the_shear_of_a_print_is_found_and_not_taken_for_lenses():
    points = BOARD.points.copy()
    points[..., 0] += SHEAR * points[..., 1]
    boards = simulate_boards(6, seed=3, noise_px=0.03, board_points=points)
    square = solve_lenses(boards.views, BOARD, [CAMERA, PROJECTOR], model="LENSMODEL_OPENCV4")
    solution, shape = solve_with_shape(square, boards.views)
    x, y = (BOARD.points[..., k] - BOARD.points[..., k].mean() for k in (0, 1))
    dx, dy = shape.displacement_mm[..., 0], shape.displacement_mm[..., 1]
    # A turn moves both alike, so only the sum is the board's.
    found = np.sum(dx * y) / np.sum(y * y) + np.sum(dy * x) / np.sum(x * x)
    assert abs(found - SHEAR) < 0.1 * SHEAR
    true = boards.lenses[0].matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    errors = [np.abs(s.lenses[0].intrinsics[:4] - true).max() for s in (square, solution)]
    assert errors[1] < 0.3 * errors[0]
    assert solution.rms_per_coordinate_px < 0.035


def test_pose_and_size_of_the_board_are_no_displacements():
    places = np.random.default_rng(0).uniform(0, 100, (30, 2))
    same = similarities(places).reshape(-1, 4)
    np.testing.assert_allclose(same.T @ same, np.eye(4), atol=1e-12)
    angle, scale = 1e-3, 2e-3
    turned = np.column_stack([-places[:, 1], places[:, 0]]) * angle + scale * places + [3.0, -2.0]
    left = turned.ravel() - same @ (same.T @ turned.ravel())
    np.testing.assert_allclose(left, 0, atol=1e-12)
    sheared = np.column_stack([places[:, 1], places[:, 0]]).ravel()
    assert np.linalg.norm(sheared - same @ (same.T @ sheared)) > 0.3 * np.linalg.norm(sheared)
