from __future__ import annotations

import numpy as np
import pytest

from calibration.board_views import BoardView
from calibration.errors import CalibrationError
from calibration.lens import transform
from calibration.mrcal_solve import solve_lenses
from calibration.triangulation import depth_along_rays
from calibration.uncertainty import rig_covariance, uncertainty_map
from workstation.benchmarks.simulated_boards import (
    BOARD,
    CAMERA,
    PROJECTOR,
    projection_errors,
    simulate_boards,
)

MODEL = "LENSMODEL_OPENCV4"
SEEDS = range(14)


@pytest.fixture(scope="module")
def solved():
    found = []
    for seed in SEEDS:
        boards = simulate_boards(12, seed=seed)
        found.append((boards, solve_lenses(boards.views, BOARD, [CAMERA, PROJECTOR], model=MODEL)))
    return found


@pytest.mark.parametrize("number", [0, 1], ids=["camera", "projector"])
def test_errors_of_projection_are_as_large_as_predicted(solved, number):
    white = [projection_errors(s, boards, number, distance_mm=700.0)[1] for boards, s in solved]
    spread = np.sqrt(np.mean(np.square(white)))
    # Over the image errors are one smooth surface, so a seed is worth a dozen numbers.
    assert spread == pytest.approx(1, abs=0.25)


def test_heights_err_as_much_as_predicted(solved):
    x, y = np.meshgrid(np.linspace(-110, 90, 6), np.linspace(-70, 70, 5))
    true = np.stack([x, y, np.full_like(x, 700.0)], axis=-1).reshape(-1, 3)
    up = np.array([0, 0, -1.0])
    chi2, expected = 0.0, 0.0
    across = np.column_stack([np.ones(len(true)), true[:, :2]])
    keep = np.eye(len(true)) - across @ np.linalg.pinv(across)
    for boards, solution in solved:
        covariance = rig_covariance(solution)
        pixels, coordinates = (lens.project(true) for lens in boards.lenses)
        slopes = covariance.rig.camera.unproject(pixels)[..., :2]
        depth, _ = depth_along_rays(
            covariance.rig, slopes, coordinates, np.ones_like(coordinates), start_mm=690.0
        )
        error = keep @ -depth
        predicted = covariance.height_covariance(true, normal=up)
        np.testing.assert_allclose(predicted @ across, 0, atol=1e-6)
        chi2 += float(error @ error)
        expected += float(np.trace(predicted))
    assert np.sqrt(chi2 / expected) == pytest.approx(1, abs=0.3)


def test_derivative_of_points_by_the_rig_is_that_of_finite_changes(solved):
    covariance = rig_covariance(solved[0][1])
    point = np.array([[20.0, -30, 680]])
    jacobian = covariance.point_jacobian(point)
    # Moving the projector along its baseline scales depth.
    step = np.zeros(len(covariance.covariance))
    step[-6:] = np.r_[0, 0, 0, 1e-4 * covariance.rig.rt_proj_cam[3:]]
    np.testing.assert_allclose(jacobian[0] @ step, 1e-4 * point[0], rtol=1e-4)


def test_a_wrong_square_scales_heights(solved):
    solution = solved[0][1]
    points = np.array([[0.0, 0, 700], [50, 0, 690], [0, 50, 710], [50, 50, 705]])
    up = np.array([0, 0, -1.0])
    without = rig_covariance(solution).height_covariance(points, normal=up, remove_plane=False)
    scaled = rig_covariance(solution, scale_sigma=1e-3)
    added = scaled.height_covariance(points, normal=up, remove_plane=False) - without
    np.testing.assert_allclose(np.sqrt(np.diag(added)), 1e-3 * points[:, 2], rtol=1e-6)
    assert scaled.point_covariance(points).shape == (4, 3, 3)


def test_uncertainty_is_smallest_where_the_boards_were(solved):
    solution = solved[0][1]
    worst = uncertainty_map(solution, 0, distance_mm=700.0).worst_sigma_px
    assert worst[len(worst) // 2, worst.shape[1] // 2] < worst[0, 0]
    with pytest.raises(CalibrationError, match="must be positive"):
        uncertainty_map(solution, 0, distance_mm=0.0)


def test_a_rig_has_two_lenses(solved):
    boards, _ = solved[0]
    alone = [BoardView(v.name, v.pixels[:1], v.sigma_px[:1]) for v in boards.views]
    with pytest.raises(CalibrationError, match="a camera and a projector"):
        rig_covariance(solve_lenses(alone, BOARD, [CAMERA], model=MODEL))


def test_points_on_rays_come_back(solved):
    rig = rig_covariance(solved[0][1]).rig
    true = np.random.default_rng(0).uniform([-90, -60, 600], [90, 60, 800], (50, 3))
    pixels = rig.projector.project(transform(rig.rt_proj_cam, true))
    depth, variance = depth_along_rays(
        rig, true[:, :2] / true[:, 2:], pixels, np.full_like(pixels, 0.04), start_mm=700.0
    )
    np.testing.assert_allclose(depth, true[:, 2], rtol=1e-9)
    assert (variance > 0).all()
