from __future__ import annotations

import mrcal
import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.mrcal_covariance import parameter_covariance, projection_covariance
from calibration.mrcal_solution import load_solution, save_lens, stored_views
from calibration.mrcal_solve import resolve, solve_lenses, solve_without
from workstation.benchmarks.simulated_boards import BOARD, CAMERA, PROJECTOR, simulate_boards

IMAGERS = [CAMERA, PROJECTOR]
MODEL = "LENSMODEL_OPENCV4"


@pytest.fixture(scope="module")
def exact():
    boards = simulate_boards(8, seed=3, noise_px=1e-6)
    return boards, solve_lenses(boards.views, BOARD, IMAGERS, model=MODEL, board_warp=False)


@pytest.fixture(scope="module")
def noisy():
    boards = simulate_boards(10, seed=4)
    return boards, solve_lenses(boards.views, BOARD, IMAGERS, model=MODEL)


def test_exact_corners_give_the_true_lenses_also_one_with_its_centre_off_the_panel(exact):
    boards, solution = exact
    for lens, true in zip(solution.lenses, boards.lenses, strict=True):
        core = true.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        np.testing.assert_allclose(lens.intrinsics[:4], core, rtol=2e-5)
        np.testing.assert_allclose(lens.intrinsics[4:], true.distortion, atol=2e-5)
    np.testing.assert_allclose(
        solution.rt_lens_ref[1], boards.lenses[1].rt_lens_ref, rtol=1e-4, atol=1e-4
    )
    np.testing.assert_allclose(solution.rt_ref_board, boards.rt_ref_board, rtol=1e-3, atol=1e-3)
    assert solution.lenses[1].intrinsics[3] > PROJECTOR.height


def test_the_noise_is_found_and_corrected_for_what_was_fitted(noisy):
    _, solution = noisy
    assert solution.sigma0 == pytest.approx(1, abs=4 / np.sqrt(2 * solution.degrees))
    assert solution.sigma0 > solution.weighted_rms


def test_observations_are_not_modified(noisy):
    boards, solution = noisy
    before = [pixels.copy() for view in boards.views for pixels in view.pixels]
    solve_lenses(boards.views, BOARD, IMAGERS, model=MODEL)
    inputs = solution.optimization_inputs["frames_rt_toref"].copy()
    resolve(solution)
    after = [pixels for view in boards.views for pixels in view.pixels]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old, new)
    np.testing.assert_array_equal(solution.optimization_inputs["frames_rt_toref"], inputs)


def test_a_gross_corner_is_left_out_and_known(noisy):
    boards, _ = noisy
    views = list(boards.views)
    shift = np.zeros((2, BOARD.rows, BOARD.columns, 2))
    row, column = np.argwhere(views[2].seen[0])[5]
    shift[0, row, column] = 4.0
    views[2] = views[2].moved(shift)
    solution = solve_lenses(views, BOARD, IMAGERS, model=MODEL)
    assert np.argwhere(solution.outliers).tolist() == [[2, 0, row, column]]
    assert np.linalg.norm(solution.residuals_px[2, 0, row, column]) == pytest.approx(5.6, abs=0.6)


def test_a_saved_lens_carries_what_it_was_solved_from(noisy, tmp_path):
    boards, solution = noisy
    save_lens(solution, 1, tmp_path / "projector.cameramodel")
    lens, pose = Lens.load(tmp_path / "projector.cameramodel")
    np.testing.assert_allclose(lens.intrinsics, solution.lenses[1].intrinsics)
    np.testing.assert_allclose(pose, solution.rt_lens_ref[1])
    again = resolve(load_solution(tmp_path / "projector.cameramodel", names=solution.names))
    assert again.rms_per_point_px == pytest.approx(solution.rms_per_point_px, rel=1e-6)
    for view, stored in zip(boards.views, stored_views(again), strict=True):
        np.testing.assert_allclose(np.stack(stored.pixels), np.stack(view.pixels), atol=1e-9)


def test_a_model_without_inputs_is_refused(tmp_path, rig_geometry):
    rig_geometry.camera.save(tmp_path / "bare.cameramodel")
    with pytest.raises(CalibrationError, match="does not say what it was solved from"):
        load_solution(tmp_path / "bare.cameramodel")
    (tmp_path / "torn.cameramodel").write_text("{ 'lensmodel': ")
    with pytest.raises(CalibrationError, match="not a readable camera model"):
        load_solution(tmp_path / "torn.cameramodel")


def test_a_solve_without_a_view_is_that_of_the_others(noisy):
    boards, solution = noisy
    without = solve_without(solution, {"pose 3"}, boards.views, outlier_sigmas=5.0)
    fresh = solve_lenses(
        [v for v in boards.views if v.name != "pose 3"], BOARD, IMAGERS, model=MODEL
    )
    np.testing.assert_allclose(
        without.lenses[0].intrinsics[:4], fresh.lenses[0].intrinsics[:4], rtol=1e-5
    )


def test_covariance_of_parameters_is_what_mrcal_propagates_to_pixels(noisy):
    _, solution = noisy
    covariance = parameter_covariance(solution)
    assert np.linalg.eigvalsh(covariance).min() > -1e-9
    # By another way: dense inverse of mrcal's own Jacobian.
    inputs = solution.optimization_inputs
    _, _, jacobian, _ = mrcal.optimizer_callback(**inputs)
    dense = jacobian.toarray()
    inverse = np.linalg.inv(dense.T @ dense)
    observed = dense[: mrcal.num_measurements_boards(**inputs)]
    packed = solution.sigma0**2 * inverse @ (observed.T @ observed) @ inverse
    scale = np.ones(len(packed))
    mrcal.unpack_state(scale, **inputs)
    expected = packed * np.outer(scale, scale)
    np.testing.assert_allclose(covariance[:22, :22], expected[:22, :22], rtol=1e-5)
    points = np.array([[0.0, 0, 700], [100, 50, 700]])
    assert (np.linalg.eigvalsh(projection_covariance(solution, 0, points)) > 0).all()


def test_too_few_views_and_unknown_models_are_refused(noisy):
    boards, _ = noisy
    with pytest.raises(CalibrationError, match="three at least"):
        solve_lenses(boards.views[:2], BOARD, IMAGERS, model=MODEL)
    with pytest.raises(CalibrationError, match="no lens model 'LENSMODEL_NONE'"):
        solve_lenses(boards.views, BOARD, IMAGERS, model="LENSMODEL_NONE")
