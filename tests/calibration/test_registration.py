from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acquisition.decoding import decode
from acquisition.patterns import Axis
from acquisition.photograph_plan import PhotographChoices, plan_photographs
from acquisition.plan import Purpose
from acquisition.recording import record_plan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from calibration.code_blocks import find_blocks
from calibration.code_pairs import CodePairs, pair_by_code
from calibration.errors import CalibrationError, RegistrationError
from calibration.lens import Lens, compose, invert, rotation, rt_from_matrix, transform
from calibration.pose_fit import fit_pose
from calibration.registration import RegistrationOptions, register_photographs, register_view
from calibration.rig_geometry import RigGeometry
from devices.simulated.optics import SimulatedLens
from devices.simulated.rig import SimulatedRig
from devices.simulated.scene import SimulatedScene
from devices.simulated.scene_objects import PlacedSurface, Wall
from devices.simulated.sensor import Sensor
from devices.simulated.surface import Surface
from workstation.benchmarks.analytic_scans import surface_rig
from workstation.benchmarks.simulated_photographs import (
    OTHER_LENS,
    RIG,
    VIEWS,
    looking_from,
    photograph,
)

HERE = np.zeros(6)
LEFT = VIEWS["left"]


def half(correspondence, columns):
    """The same without what is decoded outside of some columns."""
    rejection = correspondence.rejection.copy()
    rejection[:, : columns.start] = 1
    rejection[:, columns.stop :] = 1
    return replace(correspondence, rejection=rejection)


def error_of(view, true):
    return compose(true, invert(view.rt_cam_rig))


@pytest.fixture(scope="module")
def scan():
    return photograph(HERE, seed=0)


@pytest.fixture(scope="module")
def shot():
    return photograph(LEFT, seed=5)


@pytest.fixture(scope="module")
def other_shot():
    return photograph(LEFT, seed=6, lens=OTHER_LENS)


def test_blocks_tell_coordinates_with_their_variance(scan):
    exact, noisy = find_blocks(photograph(HERE, seed=0, sigma_px=1e-6)), find_blocks(scan)
    assert len(exact) == pytest.approx(len(noisy), rel=0.1)
    at = {tuple(pixel): number for number, pixel in enumerate(exact.pixels)}
    both = [(number, at[p]) for number, p in enumerate(map(tuple, noisy.pixels)) if p in at]
    ours, true = np.array(both).T
    error = noisy.coordinates[ours] - exact.coordinates[true]
    normal = error / np.sqrt(noisy.variance[ours])
    # A noiseless block may be left out as rough, a noisy one smooths over what it cannot see.
    assert np.sqrt(np.mean(np.sort(normal.ravel() ** 2)[: -normal.size // 50])) == pytest.approx(
        0.95, abs=0.06
    )


def test_a_coordinate_is_found_in_its_block():
    blocks = find_blocks(photograph(HERE, seed=0, sigma_px=1e-6, flat=True))
    asked = blocks.pixels + np.array([1.3, -0.7])
    rays = RIG.camera.unproject(asked) * 450.0
    offset, slopes, variance = blocks.locate(
        RIG.projector.project(transform(RIG.rt_proj_cam, rays))
    )
    np.testing.assert_allclose(offset, np.broadcast_to([1.3, -0.7], offset.shape), atol=1e-4)
    assert (variance > 0).all()
    assert slopes.shape == (len(blocks), 2, 2)
    outside, _, _ = blocks.locate(blocks.coordinates + 500.0)
    assert np.isnan(outside).all()


def test_pairs_lie_where_the_photograph_sees_them(scan, shot):
    pairs = pair_by_code(shot, scan, RIG)
    seen, gradient = RIG.camera.project_with_gradient(transform(LEFT, pairs.points))
    assert len(pairs) > 4000

    lever = gradient @ rotation(LEFT)
    covariance = lever @ pairs.covariance @ np.swapaxes(lever, 1, 2)
    residuals = pairs.pixels - seen
    squares = np.einsum(
        "ni,ni->n", residuals, np.linalg.solve(covariance, residuals[..., None])[..., 0]
    )
    # Chi square of two has the mean 2 and the median 1.386.
    assert np.median(squares) == pytest.approx(1.386, rel=0.06)


def test_poses_err_as_much_as_predicted():
    white = []
    for seed in range(2):
        known = photograph(HERE, seed=seed)
        for number, pose in enumerate((VIEWS["left"], VIEWS["right"])):
            view = register_view(photograph(pose, seed=100 + 10 * seed + number), known, RIG)
            error = error_of(view, pose)
            white.append(np.linalg.solve(np.linalg.cholesky(view.covariance), error))
    assert np.sqrt(np.mean(np.square(white))) == pytest.approx(1, abs=0.3)


def test_gross_errors_in_the_code_do_not_matter(scan, shot):
    clean = register_view(shot, scan, RIG)
    wrong = register_view(
        photograph(LEFT, seed=5, wrong=0.2), photograph(HERE, seed=0, wrong=0.2), RIG
    )
    sigma = np.sqrt(np.diagonal(wrong.covariance))
    assert (np.abs(error_of(wrong, LEFT)) < 4.5 * sigma).all()
    assert (sigma < 1.35 * np.sqrt(np.diagonal(clean.covariance))).all()


def test_a_photograph_may_have_another_lens(scan, other_shot):
    view = register_view(other_shot, scan, RIG, lens=OTHER_LENS)
    assert (np.abs(error_of(view, LEFT)) < 4.5 * np.sqrt(np.diagonal(view.covariance))).all()
    assert view.texture_px < 0.01


def test_an_unknown_lens_is_refined(scan, other_shot):
    guess = Lens("LENSMODEL_OPENCV4", np.array([1160.0, 1160, 239.5, 179.5, 0, 0, 0, 0]), 480, 360)
    refined = register_view(
        other_shot, scan, RIG, lens=guess, options=RegistrationOptions(refine_lens=True)
    )
    assert refined.lens.focal_px == pytest.approx(OTHER_LENS.focal_px, rel=0.01)
    # Parameters trade with the pose; what texture needs is where points are seen.
    points = pair_by_code(other_shot, scan, RIG).points[::50]
    true = OTHER_LENS.project(transform(LEFT, points))
    assert np.abs(refined.project(points) - true).max() < 0.02
    assert refined.covariance.shape == (14, 14)


def test_a_wrong_lens_shows_in_the_inflation(scan, other_shot):
    wrong = replace(OTHER_LENS, intrinsics=OTHER_LENS.intrinsics + np.eye(8)[4] * 0.01)
    assert register_view(other_shot, scan, RIG, lens=wrong).inflation > 3
    assert register_view(other_shot, scan, RIG, lens=OTHER_LENS).inflation == 1


def test_errors_of_the_rig_are_told_apart(scan, shot):
    count = len(RIG.parameters)
    along = np.r_[np.zeros(count - 3), [0.2, 0, 0]]
    view = register_view(shot, scan, replace(RIG, covariance=np.diag(along**2)))
    moved = register_view(shot, scan, RIG.moved(along))
    shift = compose(moved.rt_cam_rig, invert(view.rt_cam_rig))
    # What may move one parameter alone moves the pose by one standard error.
    predicted = np.sqrt(np.diagonal(view.rig_covariance))
    np.testing.assert_allclose(np.abs(shift), predicted, rtol=0.1, atol=1e-5)
    assert not moved.rig_covariance.any()


def test_the_canvas_frame_composes(scan, shot):
    view = register_view(shot, scan, RIG)
    rt_rig_canvas = rt_from_matrix(np.diag([1.0, -1, -1]), np.array([5.0, -3, 450]))
    points = np.array([[0.0, 0, 0], [30, 20, 1]])
    through = RIG.camera.project(transform(view.rt_cam_canvas(rt_rig_canvas), points))
    np.testing.assert_allclose(through, view.project(transform(rt_rig_canvas, points)))
    np.testing.assert_allclose(view.position, invert(LEFT)[3:], atol=0.05)
    assert view.texture_covariance(transform(rt_rig_canvas, points)).shape == (2, 2, 2)


def test_a_pose_is_the_same_in_whatever_frame_the_points_are():
    rig = surface_rig(240)
    seen = [
        photograph(pose, seed=seed, rig=rig, lens=rig.camera)
        for seed, pose in enumerate((HERE, LEFT))
    ]
    pairs = pair_by_code(seen[1], seen[0], rig)
    fit = fit_pose(pairs, rig.camera)
    spread = np.linalg.cholesky(fit.covariance)
    random = np.random.default_rng(0)
    for _ in range(3):
        axis = random.normal(size=3)
        turn = axis / np.linalg.norm(axis) * random.uniform(0, np.pi)
        moved = np.concatenate([turn, random.uniform(-1000, 1000, 3)])
        covariance = rotation(moved) @ pairs.covariance @ rotation(moved).T
        elsewhere = CodePairs(transform(moved, pairs.points), covariance, pairs.pixels)
        pose = compose(fit_pose(elsewhere, rig.camera).rt_cam_ref, moved)
        error = compose(pose, invert(fit.rt_cam_ref))
        # A fit ends where a step promises less than 1e-5 of the largest square of an inlier, 16.
        assert np.linalg.norm(np.linalg.solve(spread, error)) < 2 * np.sqrt(16e-5)


def test_too_little_in_common_is_refused(scan, shot):
    left = half(scan, slice(0, 110))
    right = half(shot, slice(370, 480))
    with pytest.raises(RegistrationError, match="pieces of decoded surface"):
        register_view(right, left, RIG)


def test_a_small_plane_piece_is_refused():
    known = half(photograph(HERE, seed=1, flat=True, sigma_px=0.3), slice(220, 260))
    rejection = known.rejection.copy()
    rejection[:160] = rejection[200:] = 1
    known = replace(known, rejection=rejection)
    shot = photograph(looking_from((30.0, 10.0, -40.0)), seed=2, flat=True, sigma_px=0.3)
    options = RegistrationOptions(least_pairs=20)
    with pytest.raises(RegistrationError, match="show more of"):
        register_view(shot, known, RIG, options=options)


def test_codes_that_contradict_one_another_are_refused(scan, shot):
    random = np.random.default_rng(0)
    # Patches put elsewhere: every block is sound, and its place is wrong.
    axes = {}
    order = random.permutation(24 * 32)
    for axis, decoded in shot.axes.items():
        patches = decoded.coordinate.reshape(24, 15, 32, 15).swapaxes(1, 2).reshape(-1, 15, 15)
        mixed = patches[order].reshape(24, 32, 15, 15).swapaxes(1, 2).reshape(360, 480)
        axes[axis] = replace(decoded, coordinate=mixed)
    with pytest.raises(RegistrationError, match="contradict one another"):
        register_view(replace(shot, axes=axes), scan, RIG)


def test_both_axes_are_needed(scan):
    columns = replace(scan, axes={Axis.COLUMN: scan.axes[Axis.COLUMN]})
    with pytest.raises(CalibrationError, match="along both axes"):
        register_view(columns, scan, RIG)


def test_a_lens_of_another_size_is_refused(scan):
    small = replace(RIG.camera, width=240)
    with pytest.raises(RegistrationError, match="its lens is that of"):
        register_view(scan, scan, RIG, lens=small)


def test_a_splined_lens_is_not_refined(scan, shot):
    splined = Lens(
        "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=4_Ny=4_fov_x_deg=40",
        np.r_[RIG.camera.intrinsics[:4], np.zeros(32)],
        480,
        360,
    )
    with pytest.raises(RegistrationError, match="too many parameters"):
        register_view(
            shot,
            scan,
            RIG,
            lens=splined,
            options=RegistrationOptions(refine_lens=True),
        )


@pytest.mark.parametrize("wrong", [{"least_pairs": 3}, {"most_pairs": 20}, {"least_share": 0.0}])
def test_options_make_sense(wrong):
    with pytest.raises(RegistrationError):
        RegistrationOptions(**wrong)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A session of photographs before a relief, from two places; and its rig and scene."""
    x, y = np.meshgrid(np.linspace(-30, 30, 241), np.linspace(24, -24, 193))
    height = (0.6 * np.sin(x / 5) * np.cos(y / 6)).astype(np.float32)
    surface = Surface.uniform(height, pitch_mm=0.25, canvas_mm=(60.0, 48.0), albedo=0.8)
    distortion = (-0.05, 0.02, 3e-4, -2e-4, 0.0)
    front = SimulatedLens.looking_at(
        width=256,
        height=192,
        focal_px=2000.0,
        position=(-20.0, 10.0, 400.0),
        target=(0.0, 0.0, 0.0),
        distortion=distortion,
    )
    projector = SimulatedLens.looking_at(
        width=512,
        height=320,
        focal_px=3000.0,
        position=(150.0, 20.0, 390.0),
        target=(0.0, 0.0, 0.0),
        distortion=distortion,
    )
    cameras = {"front": front, "left": front.moved((-160.0, 30.0, 370.0), (0.0, 0.0, 0.0))}
    scene = SimulatedScene(
        PlacedSurface(surface), (Wall(-15.0),), cameras, projector, sensor=Sensor(bits=12)
    )
    rig = SimulatedRig.of(scene).open()
    choices = PhotographChoices(
        exposures_s=(0.02,), code_exposures_s=(0.03,), poses=1, steps=6, period_px=24.0
    )
    folder = tmp_path_factory.mktemp("photographs") / "session"
    with SessionWriter.create(folder, plan_photographs(rig, choices)) as writer:
        record_plan(writer, rig)
    lenses = [
        Lens.from_opencv(lens.matrix, lens.distortion, width=lens.width, height=lens.height)
        for lens in (front, projector)
    ]
    pose = compose(projector.rt_lens_scene, invert(front.rt_lens_scene))
    geometry = RigGeometry(lenses[0], lenses[1], pose)
    return Session.open(folder), geometry, cameras


def test_every_place_of_a_recorded_session_is_registered(recorded):
    session, rig, cameras = recorded
    plan = session.plan_of(Purpose.CODE, camera_position="front")
    known = decode(plan, session.read_frame)
    views = register_photographs(session, known, rig)
    assert list(views) == ["front", "left"]
    for name, view in views.items():
        true = compose(cameras[name].rt_lens_scene, invert(cameras["front"].rt_lens_scene))
        points = np.array([[0.0, 0, 0], [20, 15, 0], [-20, -10, 0]])
        in_rig = transform(cameras["front"].rt_lens_scene, points)
        seen = rig.camera.project(transform(true, in_rig))
        np.testing.assert_allclose(view.project(in_rig), seen, atol=0.1)


def test_a_place_that_cannot_be_registered_is_named(recorded):
    session, rig, _ = recorded
    known = decode(session.plan_of(Purpose.CODE, camera_position="front"), session.read_frame)
    nowhere = replace(known, rejection=np.ones_like(known.rejection))
    with pytest.raises(RegistrationError, match="photographs from 'front'"):
        register_photographs(session, nowhere, rig)
