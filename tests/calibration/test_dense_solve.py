from __future__ import annotations

import numpy as np
import pytest

from calibration.board_surface import SplineGrid
from calibration.boards import Chessboard
from calibration.dense_solve import solve_densely
from calibration.errors import CalibrationError
from calibration.lens import Lens, compose, rt_from_matrix, transform
from calibration.rig_geometry import RigGeometry
from calibration.surface_samples import SurfaceSamples

BOARD = Chessboard(columns=8, rows=6, square_mm=10.0)
SHEAR = 1e-3
TURN = np.array([3e-4, 0.0, 1e-4, 0.0, 0.0, 0.0])
NOISE_PX = 0.02
RIG = RigGeometry(
    Lens("LENSMODEL_OPENCV4", np.array([2000.0, 2000, 800, 600, -0.08, 0.1, 0, 0]), 1600, 1200),
    Lens("LENSMODEL_OPENCV4", np.array([1900.0, 1900, 640, 850, -0.03, 0.02, 0, 0]), 1280, 800),
    np.array([0.2, 0.25, 0.0, -140.0, -40.0, 70.0]),
)
TILTS = ((0.4, 0.1, 0.0), (-0.3, 0.35, 0.1), (0.1, -0.4, -0.1), (-0.1, 0.05, 1.5))


def relief(places):
    x, y = places.T
    return 0.3 * np.exp(-(((x - 25) / 9) ** 2) - ((y - 30) / 7) ** 2) - 0.2 * np.exp(
        -(((x - 60) / 8) ** 2) - ((y - 20) / 12) ** 2
    )


def poses():
    import cv2

    middle = BOARD.points.reshape(-1, 3).mean(axis=0)
    found = []
    for number, tilt in enumerate(TILTS):
        turn = np.asarray(cv2.Rodrigues(np.array(tilt))[0], np.float64)
        found.append(rt_from_matrix(turn, np.array([0, 0, 330.0 + 25 * number]) - turn @ middle))
    return np.array(found)


def simulated(rng, *, drift):
    """Corners and samples of a sheared, blistered board; the projector turned at one pose."""
    corners, samples = [], []
    x, y = np.meshgrid(np.linspace(-6, 76, 30), np.linspace(-6, 56, 23))
    places = np.column_stack([x.ravel(), y.ravel()])
    surface = np.column_stack([places, relief(places)])
    printed = BOARD.points.reshape(-1, 3).copy()
    printed[:, 0] += SHEAR * printed[:, 1]
    printed[:, 2] = relief(printed[:, :2])
    for number, pose in enumerate(poses()):
        moved = compose(drift * (number == 1), RIG.rt_proj_cam)
        seen = RIG.camera.project(transform(pose, printed))
        corners.append((seen + rng.normal(0, NOISE_PX, seen.shape)).reshape(6, 8, 2))
        here = transform(pose, surface)
        lit = RIG.projector.project(transform(moved, here))
        lit = lit + rng.normal(0, NOISE_PX, lit.shape)
        tile = (places // 20 + 1).astype(int) @ [1, 100]
        samples.append(
            SurfaceSamples(RIG.camera.project(here), lit, np.full(lit.shape, NOISE_PX**2), tile)
        )
    return corners, samples


def started(rng):
    step = np.zeros(len(RIG.parameters))
    step[[0, 1, 2, 3, 8, 9, 10, 11]] = rng.normal(0, 4, 8)
    step[-6:] = rng.normal(0, [1e-3] * 3 + [0.3] * 3)
    return RIG.moved(step), poses() + rng.normal(0, [1e-3] * 3 + [0.2] * 3, (4, 6))


@pytest.fixture(scope="module")
def solved():
    rng = np.random.default_rng(2)
    corners, samples = simulated(rng, drift=TURN)
    return solve_densely(*started(rng), BOARD, corners, samples)


def test_lenses_are_found_within_their_uncertainty(solved):
    # The mean drift of the projector cannot be told from its pose.
    error = (solved.rig.parameters - RIG.parameters)[:16]
    sigma = np.sqrt(np.diag(solved.rig.covariance))[:16]
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 1.6
    assert np.abs(error[:2]).max() < 3
    assert sigma[0] < 3


def test_relief_and_shear_of_the_board_are_found(solved):
    rng = np.random.default_rng(0)
    places = rng.uniform([0, 0], [70, 50], (500, 2))
    error = solved.grid.heights(solved.relief, places)[:, 0] - relief(places)
    x, y = (places / 50).T
    # A bow is what lenses of four poses leave open.
    slow = np.column_stack([np.ones(500), x, y, x * x, x * y, y * y])
    assert np.std(error - slow @ np.linalg.lstsq(slow, error, rcond=None)[0]) < 0.01
    d = solved.displacement_mm
    x, y = (BOARD.points[..., k] - BOARD.points[..., k].mean() for k in (0, 1))
    shear = np.sum(d[..., 0] * y) / np.sum(y * y) + np.sum(d[..., 1] * x) / np.sum(x * x)
    assert abs(shear - SHEAR) < 0.15 * SHEAR


def test_a_projector_that_moved_between_two_poses_is_told(solved):
    # Turn and shift look alike: what they do to the projector's picture is what is told.
    point = transform(RIG.rt_proj_cam, np.array([0.0, 0.0, 350.0]))
    still = RIG.projector.project(point)
    moved = [RIG.projector.project(transform(d, point)) - still for d in solved.drift]
    true = RIG.projector.project(transform(TURN, point)) - still
    found = moved[1] - np.mean([moved[0], moved[2], moved[3]], axis=0)
    # Along the columns it would be taken for a shift of the board.
    assert abs(true[1]) > 0.5
    assert abs(found[1] - true[1]) < 0.25 * abs(true[1])
    np.testing.assert_allclose(solved.sample_rms_px, NOISE_PX, rtol=0.15)


def test_two_poses_are_refused(solved):
    corners, samples = simulated(np.random.default_rng(0), drift=0 * TURN)
    with pytest.raises(CalibrationError, match="three of each are needed"):
        solve_densely(RIG, poses()[:2], BOARD, corners[:2], samples[:2])


def test_slopes_of_a_surface_are_the_derivatives_of_its_height():
    grid = SplineGrid.over(BOARD, knots_per_square=2)
    rng = np.random.default_rng(1)
    coefficients = rng.normal(size=grid.size)
    places = rng.uniform([-12, -12], [92, 72], (50, 2))
    found = grid.heights(coefficients, places)
    for axis in (0, 1):
        step = np.eye(2)[axis] * 1e-4
        rise = grid.heights(coefficients, places + step) - grid.heights(coefficients, places - step)
        np.testing.assert_allclose(found[:, 1 + axis], rise[:, 0] / 2e-4, atol=1e-5)
    plane = grid.start_mm + grid.pitch_mm * np.stack(
        np.meshgrid(np.arange(grid.columns), np.arange(grid.rows)), axis=-1
    ).reshape(-1, 2)
    np.testing.assert_allclose(grid.heights(plane[:, 0], places)[:, 0], places[:, 0], atol=1e-9)
    np.testing.assert_allclose(grid.roughness() @ plane[:, 0], 0, atol=1e-9)
