"""Rays against heights sampled densely; the paintings and the board."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage

from devices.errors import DeviceError
from devices.simulated.board import BoardPattern, make_board
from devices.simulated.oil_painting import paint_oil
from devices.simulated.ray_kernels import MaximumPyramid
from devices.simulated.rig import build_rig
from devices.simulated.scene_objects import PlacedSurface, Wall
from devices.simulated.settings import PaintingKind, SimulationSettings
from devices.simulated.surface import Surface
from devices.simulated.torture_piece import CARBON_BLACK, CLIFF_MM, GOLD, make_torture_piece
from devices.simulated.truth import truth_of


def rough_surface(rows=37, cols=53, seed=0):
    height = np.random.default_rng(seed).uniform(0, 2, (rows, cols)).astype(np.float32)
    return Surface.uniform(height, pitch_mm=0.5, canvas_mm=(10, 10), back_mm=-3.0)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def first_meeting(surface, origin, ray, far):
    """Where a densely sampled ray first goes below the surface, or beside it into the solid."""
    x, y = surface.grid_mm()
    t = np.linspace(0, far, 400_001)
    at = origin + t[:, None] * ray
    inside = (np.abs(at[:, 0]) <= x[-1]) & (np.abs(at[:, 1]) <= y[0])
    below = np.zeros(len(t), bool)
    height = surface.height_at(at[inside, 0], at[inside, 1])
    below[inside] = (at[inside, 2] <= height) & (at[inside, 2] >= surface.back_mm)
    return t[below.argmax()] if below.any() else np.nan


@pytest.mark.parametrize("shape", [(37, 53), (2, 2), (3, 64), (65, 33)])
def test_rays_meet_the_first_of_many_peaks(shape):
    surface = rough_surface(*shape)
    thing = PlacedSurface(surface)
    random = np.random.default_rng(1)
    x, y = surface.grid_mm()
    origin = np.array([3.0, -2.0, 9.0])
    ground = random.uniform([-x[-1] - 2, -y[0] - 2, -1], [x[-1] + 2, y[0] + 2, 1], (60, 3))
    rays = unit(ground - origin)
    found = thing.cast(origin, rays)
    far = 30.0
    for ray, distance in zip(rays, found, strict=True):
        expected = first_meeting(surface, origin, ray, far)
        if np.isnan(expected) or np.isnan(distance):
            # A touch may be too short for the samples.
            assert np.isnan(expected)
            if np.isfinite(distance):
                at = origin + distance * ray
                inside = (np.abs(at[:2]) <= (x[-1], y[0])).all()
                assert not inside or at[2] - surface.height_at(at[:1], at[1:2]) < 1e-9
        else:
            assert distance == pytest.approx(expected, abs=2 * far / 400_000)


def test_the_pyramid_holds_the_maximum_of_every_square():
    surface = rough_surface(37, 53)
    pyramid = MaximumPyramid.of(surface.height)
    for level in range(1, len(pyramid.starts)):
        rows, cols = pyramid.shapes[level]
        size = 2**level
        for j, i in ((0, 0), (rows - 1, cols - 1), (rows // 2, cols // 2)):
            square = surface.height[j * size : (j + 1) * size + 1, i * size : (i + 1) * size + 1]
            assert pyramid.maxima[pyramid.starts[level] + j * cols + i] == square.max()
    assert tuple(pyramid.shapes[-1]) == (1, 1)


def test_a_placed_surface_is_the_same_surface_elsewhere():
    surface = rough_surface()
    pose = np.array([0.3, -0.2, 0.1, 5.0, -7.0, 20.0])
    rotation = cv2.Rodrigues(pose[:3])[0]
    here, there = PlacedSurface(surface), PlacedSurface(surface).placed(pose)
    origin = np.array([1.0, 2.0, 40.0])
    rays = unit(np.random.default_rng(0).normal(size=(400, 3)) * [0.15, 0.15, 0] + [0, 0, -1])
    moved_origin, moved_rays = rotation @ origin + pose[3:], rays @ rotation.T
    np.testing.assert_allclose(there.cast(moved_origin, moved_rays), here.cast(origin, rays))
    points = origin + here.cast(origin, rays)[:, None] * rays
    points = points[np.isfinite(points[:, 2])]
    assert len(points) > 300
    moved = points @ rotation.T + pose[3:]
    footprints = np.zeros((len(points), 2, 3), np.float32)
    one, other = here.points_at(points, footprints), there.points_at(moved, footprints)
    np.testing.assert_allclose(other.normals, one.normals @ rotation.T, atol=2e-3)
    light = np.array([20.0, 10.0, 15.0])
    same = there.hides(moved, rotation @ light + pose[3:]) == here.hides(points, light)
    assert same.mean() > 0.99


def test_the_wall_is_seen_where_nothing_else_is_and_hides_nothing():
    wall = Wall(-15.0)
    rays = unit(np.array([[0.1, 0.2, -1.0], [0.0, 0.0, 1.0]]))
    distance = wall.cast(np.array([0.0, 0.0, 100.0]), rays)
    assert 100 + distance[0] * rays[0, 2] == pytest.approx(-15)
    assert np.isnan(distance[1])
    assert not wall.hides(np.zeros((3, 3)), np.array([0.0, 0.0, 5.0])).any()


@pytest.fixture(scope="module")
def oil():
    """A corner-size painting of the large one's make."""
    return paint_oil(seed=2, canvas_mm=(120.0, 90.0))


def canvas_of(surface, name):
    x, y = surface.grid_mm()
    wide, high = surface.canvas_mm
    return getattr(surface, name)[np.ix_(np.abs(y) < high / 2 - 1, np.abs(x) < wide / 2 - 1)]


def test_an_oil_painting_has_strokes_to_three_millimetres_weave_varnish_and_a_frame(oil):
    height = canvas_of(oil, "height")
    assert 2.2 < height.max() <= 3.0
    assert np.median(height) < 1.0
    assert oil.height.max() == pytest.approx(18, abs=0.1)
    assert oil.height[0, 0] == -15
    varnish = canvas_of(oil, "varnish") / 255
    assert 0.25 < varnish.mean() < 0.65
    assert ((varnish < 0.02) | (varnish > 0.98)).mean() > 0.5
    # More relief than a scan's grid of a quarter of a millimetre holds, and slopes like paint's.
    fine = height - ndimage.gaussian_filter(height, 0.25 / oil.pitch_mm)
    assert 0.004 < fine.std() < 0.1
    slope = np.hypot(*np.gradient(height, oil.pitch_mm))
    assert np.quantile(slope, 0.999) > 1.0
    assert np.median(slope) < 0.3


def test_thin_paint_shows_the_weave(oil):
    """The spectrum of heights has the threads' frequency, along rows and along columns."""
    height = canvas_of(oil, "height").astype(float)
    height = height - ndimage.gaussian_filter(height, 8)
    for axis in (0, 1):
        power = (
            np.abs(
                np.fft.rfft(
                    height
                    * np.hanning(height.shape[axis]).reshape((-1, 1) if axis == 0 else (1, -1)),
                    axis=axis,
                )
            )
            ** 2
        ).mean(axis=1 - axis)
        frequency = np.fft.rfftfreq(height.shape[axis], oil.pitch_mm)
        # Threads 0.8 mm apart rise and sink in turn: a period of 1.6 mm.
        at_weave = power[(frequency > 0.56) & (frequency < 0.69)].mean()
        beside = power[(frequency > 0.85) & (frequency < 1.0)].mean()
        assert at_weave > beside


def test_strokes_run_together(oil):
    """Neighbouring gradients agree on an axis far more than chance would have it."""
    height = canvas_of(oil, "height")
    smooth = ndimage.gaussian_filter(height, 2)
    gy, gx = np.gradient(smooth)
    tensor = [ndimage.gaussian_filter(p, 30) for p in (gx * gx, gx * gy, gy * gy)]
    coherence = np.hypot(tensor[0] - tensor[2], 2 * tensor[1]) / (tensor[0] + tensor[2])
    assert np.median(coherence) > 0.25


def test_the_torture_piece_has_all_that_is_hard():
    piece = make_torture_piece(seed=1)
    height = canvas_of(piece, "height")
    assert (height == -15).sum() * piece.pitch_mm**2 > 100
    paint = height[height > -14]
    assert CLIFF_MM - 1 < paint.max() <= CLIFF_MM + 1e-4
    # Cliffs: millimetres from one texel to the next.
    assert np.diff(canvas_of(piece, "height"), axis=1).max() > 4
    metal, albedo = canvas_of(piece, "metal"), (canvas_of(piece, "albedo") / 255) ** 2
    assert 0.15 < (metal == 255).mean() < 0.4
    np.testing.assert_allclose(albedo[metal == 255].mean(axis=0), GOLD, atol=0.01)
    assert np.median(canvas_of(piece, "roughness")[metal == 255]) == round(255 * 0.08)
    black = np.abs(albedo[..., 1] - CARBON_BLACK) < 0.003
    assert black.mean() > 0.1
    same = make_torture_piece(seed=1)
    np.testing.assert_array_equal(same.height, piece.height)


@pytest.fixture(scope="module")
def board_rig():
    settings = SimulationSettings(
        painting=PaintingKind.BOARD, camera_width=1000, camera_height=750, ambient=0.05
    )
    return build_rig(settings)


@pytest.mark.parametrize("pose", [np.zeros(6), np.array([0.25, -0.3, 0.15, 10.0, -5.0, 30.0])])
def test_the_board_s_corners_are_found_where_they_are(board_rig, pose):
    board_rig.scene.move_subject(pose)
    board_rig.scene.show(np.full((800, 1280), 255, np.uint8))
    image = board_rig.camera.capture(0.03).image
    picture = np.clip(image / 8, 0, 255).astype(np.uint8)
    detector = cv2.aruco.CharucoDetector(BoardPattern().charuco())
    corners, ids, _, _ = detector.detectBoard(picture)
    assert ids is not None
    assert len(ids) > 100
    truth = truth_of(board_rig.scene)
    rotation = cv2.Rodrigues(pose[:3])[0]
    points = BoardPattern().corners_mm().reshape(-1, 3) @ rotation.T + pose[3:]
    expected = truth.camera.project(points)[ids.ravel()]
    # The detector counts from the pixel's corner, and its own refinement is coarse.
    start = (corners - 0.5).astype(np.float32)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    found = cv2.cornerSubPix(picture, start, (4, 4), (-1, -1), criteria)
    error = found.reshape(-1, 2) - expected
    assert np.abs(error.mean(axis=0)).max() < 0.02
    assert np.sqrt((error**2).mean()) < 0.06


def test_a_plain_chessboard_has_no_markers():
    plain = make_board(BoardPattern(marker_mm=None, squares=(6, 5)), pitch_mm=0.5)
    albedo = (plain.albedo[..., 0] / 255) ** 2
    assert set(np.round(np.unique(albedo), 2)) == {0.04, 0.85}
    corner = plain.points_at(BoardPattern(squares=(6, 5)).corners_mm().reshape(-1, 3))
    # A corner lies half-way between black and white.
    np.testing.assert_allclose(corner.albedo, (0.04 + 0.85) / 2, atol=0.01)
    with pytest.raises(DeviceError, match="chessboard"):
        BoardPattern(marker_mm=None).charuco()
    with pytest.raises(DeviceError, match="whole number"):
        make_board(pitch_mm=0.3)


def test_maps_of_different_sizes_are_refused():
    surface = rough_surface()
    with pytest.raises(DeviceError, match="metal map"):
        Surface(
            *(surface.height, surface.albedo, surface.roughness, surface.varnish),
            *(surface.metal[1:], 0.5, (10.0, 10.0)),
        )
    with pytest.raises(DeviceError, match="beyond its edge"):
        surface.height_at(np.array([1e3]), np.array([0.0]))
