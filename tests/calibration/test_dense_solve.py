from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from blistered_board import (
    BOARD,
    NOISE_PX,
    RIG,
    SHEAR,
    TURN,
    aligned_poses,
    poses,
    relief,
    simulated,
    started,
)

from calibration.board_surface import SplineGrid
from calibration.dense_solve import solve_densely
from calibration.errors import CalibrationError
from calibration.lens import compose, invert, transform


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
    error = solved.heights(places) - relief(places)
    x, y = (places / 50).T
    # A bow is what lenses of four poses leave open.
    slow = np.column_stack([np.ones(500), x, y, x * x, x * y, y * y])
    assert np.std(error - slow @ np.linalg.lstsq(slow, error, rcond=None)[0]) < 0.01


def test_how_askew_the_board_is_printed_is_told_with_its_standard_error(solved):
    shear, stretch = solved.skew.sigma
    assert abs(solved.skew.shear - SHEAR) < 3 * shear < 0.15 * SHEAR
    assert abs(solved.skew.stretch) < 3 * stretch


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


def test_motion_is_told_for_each_pose_with_its_standard_error(solved):
    motion = solved.motion()
    lit = transform(compose(RIG.rt_proj_cam, poses()[1]), BOARD.points)
    # Three of four poses share the rest: of the mean the turn is off by three quarters.
    shift = RIG.projector.project(transform(0.75 * TURN, lit)) - RIG.projector.project(lit)
    true = np.sqrt(np.mean(np.sum(shift**2, axis=-1)))
    assert abs(motion.moved_px[1] - true) < 3 * motion.moved_sigma_px[1] < 0.5 * true
    assert np.argmax(motion.turn_rad) == 1
    assert abs(motion.turn_rad[1] - 0.75 * np.linalg.norm(TURN)) < 3 * motion.turn_sigma_rad[1]


def test_error_bars_hold_of_a_projector_that_moved_ten_times_as_far_as_is_usual():
    rng = np.random.default_rng(3)
    drifts = rng.normal(0, [1e-3] * 3 + [0.3] * 3, (4, 6))
    corners, samples = simulated(rng, drift=drifts)
    solved = solve_densely(*started(rng), BOARD, corners, samples)
    error = (solved.rig.parameters - RIG.parameters)[:16]
    covariance = solved.rig.covariance[:16, :16]
    # The mean over sixteen squares; a hundredth of chance is beyond 2.
    assert error @ np.linalg.solve(covariance, error) / 16 < 2
    motion, apart = solved.motion(), drifts - drifts.mean(axis=0)
    for number, pose in enumerate(poses()):
        lit = transform(compose(RIG.rt_proj_cam, pose), BOARD.points)
        shift = RIG.projector.project(transform(apart[number], lit)) - RIG.projector.project(lit)
        true = np.sqrt(np.mean(np.sum(shift**2, axis=-1)))
        assert abs(motion.moved_px[number] - true) < 4 * motion.moved_sigma_px[number]


def test_projection_errs_as_much_as_its_covariance_says(solved):
    white = []
    for number, (lens, true) in enumerate(
        zip(solved.lenses, (RIG.camera, RIG.projector), strict=True)
    ):
        x, y = np.meshgrid(np.linspace(-0.1, 0.1, 5), np.linspace(-0.1, 0.1, 5))
        points = 370 * np.stack([x, y, np.ones_like(x)], axis=-1)
        carried = []
        for pose, truth in zip(solved.rt_cam_board, aligned_poses(), strict=True):
            # Of the projector's motion the mean is its usual pose.
            usual = compose(TURN / 4, RIG.rt_proj_cam)
            to = compose(usual, truth) if number else truth
            of = compose(solved.rig.rt_proj_cam, pose) if number else pose
            carried.append(transform(compose(to, invert(of)), points))
        error = true.project(np.mean(carried, axis=0)) - lens.project(points)
        root = np.linalg.cholesky(solved.projection_covariance(number, points))
        white.append(np.linalg.solve(root, error[..., np.newaxis]))
    # One solve is one draw of some twenty parameters.
    assert 0.4 < np.sqrt(np.mean(np.square(white))) < 1.8


def test_two_poses_are_refused(solved):
    corners, samples = simulated(np.random.default_rng(0), drift=0 * TURN)
    with pytest.raises(CalibrationError, match="three of each are needed"):
        solve_densely(RIG, poses()[:2], BOARD, corners[:2], samples[:2])


def _without_corners(corners, samples):
    return [np.full_like(corners[0], np.nan), *corners[1:]], samples


def _with_a_variance_of_nothing(corners, samples):
    variance = samples[0].variance.copy()
    variance[3] = np.nan
    return corners, [replace(samples[0], variance=variance), *samples[1:]]


def _all_alike(corners, samples):
    return corners[:1] * 4, samples[:1] * 4


@pytest.mark.parametrize(
    ("spoilt", "message"),
    [
        (_without_corners, "view 1 has 0 corners"),
        (_with_a_variance_of_nothing, "view 1 has blocks of the surface without"),
        (_all_alike, "tilted to all four sides"),
    ],
)
def test_views_that_determine_nothing_are_refused(spoilt, message):
    rng = np.random.default_rng(0)
    corners, samples = spoilt(*simulated(rng, drift=0 * TURN))
    rig, start = started(rng)
    if spoilt is _all_alike:
        start = start[[0, 0, 0, 0]]
    with pytest.raises(CalibrationError, match=message):
        solve_densely(rig, start, BOARD, corners, samples)


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
