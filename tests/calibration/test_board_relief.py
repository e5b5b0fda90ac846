from __future__ import annotations

import numpy as np
import pytest

from acquisition.correspondence import AxisCoordinate, CorrespondenceMap
from acquisition.patterns import Axis
from calibration.board_relief import (
    compare_reliefs,
    deviation_from_polynomial,
    reconstruct_board,
)
from calibration.boards import Chessboard
from calibration.errors import CalibrationError
from calibration.lens import Lens, compose, rotation, transform
from calibration.rig_geometry import RigGeometry

BOARD = Chessboard(columns=9, rows=6, square_mm=8.0)
SHAPE = 300, 400
DISTANCE_MM = 450.0
WALL_BEHIND_MM = 130.0
SIGMA_PX = 0.02


@pytest.fixture(scope="module")
def rig():
    camera = Lens("LENSMODEL_PINHOLE", np.array([1200.0, 1200.0, 200.0, 150.0]), 400, 300)
    projector = Lens("LENSMODEL_PINHOLE", np.array([900.0, 900.0, 320.0, 200.0]), 640, 400)
    return RigGeometry(camera, projector, np.array([0.0, 0.35, 0.0, -160.0, 0.0, 30.0]))


def seen(rig, *, tilt=(0.0, 0.0), finger=False, turned=0.0, seed=0):
    """What a scan of a tilted board before a wall decodes, and where its corners are.

    The projector has turned across the baseline, and noise follows the fringes.
    """
    pose = np.array([tilt[0], tilt[1], 0.1, 0.0, 0.0, 0.0])
    middle = 0.5 * BOARD.points[-1, -1]
    pose[3:] = [0.0, 0.0, DISTANCE_MM] - rotation(pose) @ middle
    axes = rotation(pose)
    col, row = np.meshgrid(np.arange(SHAPE[1], dtype=float), np.arange(SHAPE[0], dtype=float))
    rays = rig.camera.unproject(np.stack([col, row], axis=-1))
    rays = rays / rays[..., 2:]
    depth = (axes[:, 2] @ pose[3:]) / (rays @ axes[:, 2])
    on_board = (depth[..., np.newaxis] * rays - pose[3:]) @ axes
    far, rim = BOARD.points[-1, -1, :2], BOARD.square_mm
    square = np.floor(on_board[..., :2] / BOARD.square_mm).sum(axis=-1) % 2
    there = ((on_board[..., :2] > -rim) & (on_board[..., :2] < far + rim)).all(axis=-1)
    depth = np.where(there, depth, DISTANCE_MM + WALL_BEHIND_MM)
    white = np.where(there & (square == 0), 100.0, 400.0)
    if finger:
        hidden = (np.abs(on_board[..., 0] - 0.4 * far[0]) < finger) & there
        depth = np.where(hidden, depth - 20.0, depth)
        white = np.where(hidden, 400.0, white)
    points = depth[..., np.newaxis] * rays
    random = np.random.default_rng(seed)
    moved = compose(np.array([turned, 0.0, 0.0, 0.0, 0.0, 0.0]), rig.rt_proj_cam)
    lit = rig.projector.project(transform(moved, points))
    sigma = SIGMA_PX * np.sqrt(1 + 0.8 * np.cos(2 * np.pi * lit / 16.0))
    lit += random.normal(0, 1, lit.shape) * sigma
    axes_seen = {
        axis: AxisCoordinate(
            lit[..., n],
            (sigma[..., n] ** 2).astype(np.float32),
            np.full(SHAPE, 100.0, np.float32),
            16.0,
            0.0,
        )
        for n, axis in enumerate((Axis.COLUMN, Axis.ROW))
    }
    found = CorrespondenceMap(
        axes_seen, white.astype(np.float32), np.zeros(SHAPE, np.uint16), (0, 0), 1.0
    )
    return found, rig.camera.project(transform(pose, BOARD.points))


def relief_of(rig, **how):
    correspondence, corners = seen(rig, **how)
    return reconstruct_board(correspondence, corners, BOARD, rig, start_mm=DISTANCE_MM)


@pytest.mark.parametrize("tilt", [(0.0, 0.5), (0.45, -0.3), (-0.4, 0.0)])
def test_a_board_tilted_before_a_wall_is_reconstructed_without_the_wall(rig, tilt):
    relief = relief_of(rig, tilt=tilt)
    assert relief.plane_over_noise == pytest.approx(1.0, abs=0.1)
    assert relief.off_share < 0.002
    assert abs(relief.scale_error) < 1e-3
    smoothed = np.sqrt(np.mean(relief.height_mm**2))
    assert smoothed == pytest.approx(relief.smoothed_noise_mm, rel=0.25)


def test_boards_at_several_tilts_agree_to_their_noise(rig):
    reliefs = [
        relief_of(rig, tilt=tilt, seed=seed) for seed, tilt in enumerate([(0, 0.4), (0.4, 0)])
    ]
    together = np.hypot(*(relief.smoothed_noise_mm for relief in reliefs))
    assert compare_reliefs(reliefs).rms_mm == pytest.approx(together, rel=0.25)


def test_a_projector_that_has_turned_weaves_no_fringes_into_the_board(rig):
    # Across the baseline, by less than a pixel; what is left besides is smooth.
    relief = relief_of(rig, tilt=(0.0, 0.4), turned=1e-3)
    assert deviation_from_polynomial(relief.height_mm, 3) == pytest.approx(
        relief.smoothed_noise_mm, rel=0.25
    )


def test_a_finger_before_the_board_is_left_out_and_a_hand_refused(rig):
    relief = relief_of(rig, finger=2.0)
    assert 0.03 < relief.off_share < 0.1
    assert relief.plane_over_noise == pytest.approx(1.0, abs=0.1)
    with pytest.raises(CalibrationError, match=r"of the points inside the board's outline"):
        relief_of(rig, finger=6.0)
