from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import ndimage
from synthetic_scan import make_range_image

from calibration.lens import rotation
from fitting.canvas import CanvasOptions, InPlaneAxes, extract_canvas
from fitting.canvas_kernels import find_smooth, heights_above_plane
from fitting.canvas_region import fill_holes
from fitting.errors import FittingError


def weave(x, y):
    return 0.05 * np.sin(x / 2) * np.sin(y / 2)


def framed(relief=weave, *, half=(45.0, 32.0), frame=10.0, at=(0.0, 0.0)):
    """A canvas in a frame 8 mm wide, before a wall."""

    def surface(x, y):
        outside = np.maximum(np.abs(x - at[0]) - half[0], np.abs(y - at[1]) - half[1])
        around = np.where(outside > 8, -20.0, frame)
        return np.where(outside > 0, around, relief(x - at[0], y - at[1]))

    return surface


def check(scene, canvas, *, half=(45.0, 32.0), at=(0.0, 0.0), share=0.99):
    """The mask is the canvas within three millimetres, and its frame is the surface's."""
    outside = np.maximum(np.abs(scene.x - at[0]) - half[0], np.abs(scene.y - at[1]) - half[1])
    inside = (outside < -2.7) & scene.image.valid
    assert canvas.mask[inside].mean() > share
    assert not canvas.mask[outside > 0.3].any()
    axes, truth = rotation(canvas.rt_cam_canvas), rotation(scene.rt_cam_surface)
    assert axes[:, 2] @ truth[:, 2] > np.cos(np.deg2rad(0.5))
    assert np.linalg.det(axes) == pytest.approx(1)
    return axes.T @ truth


def test_the_centre_may_be_a_hole():
    surface = framed()
    scene = make_range_image(lambda x, y: np.where(np.hypot(x, y) < 12, np.nan, surface(x, y)))
    canvas = extract_canvas(scene.image)
    check(scene, canvas)
    assert canvas.outline[96, 128]
    assert not canvas.warnings


def test_the_centre_may_be_on_a_thick_stroke():
    def stroke(x, y):
        return weave(x, y) + np.where((np.abs(x) < 14) & (np.abs(y) < 5), 3.0, 0.0)

    scene = make_range_image(framed(stroke))
    canvas = extract_canvas(scene.image)
    check(scene, canvas, share=0.97)
    assert canvas.mask[(np.abs(scene.x) < 12) & (np.abs(scene.y) < 3)].mean() > 0.99
    assert not canvas.warnings


def test_strokes_that_cut_pieces_off_leave_the_canvas_whole():
    def strokes(x, y):
        ring = np.abs(np.hypot(x - 15, y + 8) - 9) < 1
        corner = np.abs(x + y - 60) < 1.5
        return weave(x, y) + np.where(ring | corner, 4.0, 0.0)

    scene = make_range_image(framed(strokes))
    canvas = extract_canvas(scene.image)
    check(scene, canvas, share=0.93)
    assert canvas.mask[np.hypot(scene.x - 15, scene.y + 8) < 7].mean() > 0.99
    cut_off = (scene.x + scene.y > 65) & (scene.x < 42) & (scene.y < 29)
    assert canvas.mask[cut_off].mean() > 0.9


@pytest.mark.parametrize("at", [(18.0, 10.0), (-25.0, -12.0)])
def test_a_painting_may_be_off_the_centre(at):
    half = (32.0, 24.0)
    scene = make_range_image(framed(half=half, at=at))
    check(scene, extract_canvas(scene.image), half=half, at=at)


def test_a_painting_that_misses_the_centre_needs_a_seed():
    half, at = (20.0, 18.0), (42.0, 24.0)
    scene = make_range_image(framed(half=half, at=at))
    assert any("or it is the wall" in w for w in extract_canvas(scene.image).warnings)
    row, col = np.unravel_index(
        np.argmin(np.hypot(scene.x - at[0], scene.y - at[1])), scene.x.shape
    )
    canvas = extract_canvas(scene.image, CanvasOptions(seed=(int(row), int(col))))
    check(scene, canvas, half=half, at=at, share=0.97)


@pytest.mark.parametrize("tilt", [(0.0, np.deg2rad(30)), (np.deg2rad(-30), 0.0)])
def test_a_canvas_may_be_tilted(tilt):
    scene = make_range_image(framed(half=(40.0, 30.0)), tilt=tilt)
    turned = check(scene, extract_canvas(scene.image), half=(40.0, 30.0), share=0.93)
    np.testing.assert_allclose(turned, np.eye(3), atol=0.02)


def test_a_round_canvas_takes_the_pictures_axes():
    def surface(x, y):
        radius = np.hypot(x, y)
        return np.where(radius > 33, np.where(radius > 40, -20.0, 9.0), weave(x, y))

    scene = make_range_image(surface)
    canvas = extract_canvas(scene.image)
    radius = np.hypot(scene.x, scene.y)
    assert canvas.mask[radius < 30.3].mean() > 0.99
    assert not canvas.mask[radius > 33.3].any()
    assert canvas.axes is InPlaneAxes.PICTURE
    x_axis = rotation(canvas.rt_cam_canvas)[:, 0]
    assert abs(x_axis[1]) < 0.01


def test_a_square_canvas_keeps_its_edges_for_axes():
    half = (30.0, 30.0)
    turn = np.deg2rad(12)

    def surface(x, y):
        return framed(half=half)(
            np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
        )

    scene = make_range_image(surface)
    canvas = extract_canvas(scene.image)
    assert canvas.axes is InPlaneAxes.MASK_EDGES
    along = rotation(scene.rt_cam_surface) @ [np.cos(turn), np.sin(turn), 0]
    assert rotation(canvas.rt_cam_canvas)[:, 0] @ along > np.cos(np.deg2rad(0.5))


def test_a_canvas_without_a_frame_ends_where_the_wall_begins():
    def surface(x, y):
        outside = np.maximum(np.abs(x) - 45, np.abs(y) - 32)
        return np.where(outside > 0, -18.0, weave(x, y))

    scene = make_range_image(surface)
    canvas = extract_canvas(scene.image)
    check(scene, canvas)
    assert not canvas.warnings


def test_a_canvas_that_fills_the_picture_is_told_to_run_off_it():
    scene = make_range_image(weave)
    canvas = extract_canvas(scene.image)
    assert canvas.mask.mean() > 0.9
    assert any("runs off the picture" in w for w in canvas.warnings)


def test_a_frame_flush_with_the_canvas_is_kept_out_by_its_seam():
    def surface(x, y):
        outside = np.maximum(np.abs(x) - 45, np.abs(y) - 32)
        seam = (np.abs(outside - 0.6) < 0.7) & (np.abs(x - 10) > 0.8)  # bridged in two places
        around = np.where(outside > 10, -20.0, 0.0)
        return np.where(seam, -2.5, np.where(outside > 0, around, weave(x, y)))

    scene = make_range_image(surface)
    check(scene, extract_canvas(scene.image))


def test_a_warped_panel_is_found_whole_and_keeps_its_shape():
    def bowed(x, y):
        return weave(x, y) + 6.0 * (1 - (x / 45) ** 2)

    scene = make_range_image(framed(bowed, frame=14.0))
    canvas = extract_canvas(scene.image)
    outside = np.maximum(np.abs(scene.x) - 45, np.abs(scene.y) - 32)
    assert canvas.mask[outside < -2.7].mean() > 0.99
    assert not canvas.mask[outside > 0.3].any()


def two_paintings(x, y):
    left = framed(half=(24.0, 24.0), at=(-12.0, 0.0))(x, y)
    right = framed(half=(16.0, 24.0), at=(44.0, 0.0))(x, y)
    return np.where(x < 20, left, right)


def test_of_two_paintings_the_one_at_the_centre_is_taken_with_a_warning():
    scene = make_range_image(two_paintings)
    canvas = extract_canvas(scene.image)
    check(scene, canvas, half=(24.0, 24.0), at=(-12.0, 0.0))
    assert any("another smooth region" in w for w in canvas.warnings)


def test_a_seed_pixel_takes_the_other():
    scene = make_range_image(two_paintings)
    row, col = np.unravel_index(np.argmin(np.hypot(scene.x - 44, scene.y)), scene.x.shape)
    options = CanvasOptions(seed=(int(row), int(col)))
    canvas = extract_canvas(scene.image, options)
    check(scene, canvas, half=(16.0, 24.0), at=(44.0, 0.0), share=0.93)
    assert not canvas.warnings
    for seed, message in (((500, 3), "outside"), ((int(row), 0), "seed pixel")):
        image = scene.image
        if message == "seed pixel":
            rejection = image.rejection.copy()
            rejection[:, :30] = 2
            image = dataclasses.replace(image, rejection=rejection)
        with pytest.raises(FittingError, match=message):
            extract_canvas(image, CanvasOptions(seed=seed))


def surface_points(height, step):
    rows, cols = height.shape
    x, y = np.meshgrid(np.arange(cols) * step[0], np.arange(rows) * step[1])
    return np.stack([x, y, 1e6 - height], axis=-1)


FACING = np.array([0.0, 0.0, -1.0])


def test_dead_rows_and_columns_do_not_part_the_canvas():
    scene = make_range_image(framed())
    rejection = scene.image.rejection.copy()
    rejection[80:82] = rejection[:, 100:103] = 2
    image = dataclasses.replace(scene.image, rejection=rejection)
    check(dataclasses.replace(scene, image=image), extract_canvas(image), share=0.98)


def test_a_narrow_shadow_does_not_join_a_frame_to_the_canvas():
    scene = make_range_image(framed())
    outside = np.maximum(np.abs(scene.x) - 45, np.abs(scene.y) - 32)
    rejection = scene.image.rejection.copy()
    rejection[np.abs(outside) < 1.2] = 2
    image = dataclasses.replace(scene.image, rejection=rejection)
    check(dataclasses.replace(scene, image=image), extract_canvas(image), share=0.96)


def test_smooth_pixels_against_sobel():
    random = np.random.default_rng(0)
    height = ndimage.gaussian_filter(random.normal(0, 3, (40, 50)), 1)
    variance = np.full(height.shape, 1e-4, np.float32)
    valid = np.ones(height.shape, bool)
    x = ndimage.sobel(height, axis=1) / (8 * 0.5)
    y = ndimage.sobel(height, axis=0) / (8 * 0.7)
    # Seen from straight ahead, far away, a slope is the same against plane and ray.
    limit = 1.0 + 2.0 * 0.01 * np.sqrt(12) / (8 * 0.5)
    inner = (slice(1, -1), slice(1, -1))
    points = surface_points(height, (0.5, 0.7))
    found = find_smooth(points, variance, valid, FACING, 0.5, 1.0, 2.0)
    np.testing.assert_array_equal(found[inner], (np.hypot(x, y) < limit)[inner])
    assert 0.1 < found.mean() < 0.9


def test_slopes_at_the_rim_of_a_hole_are_those_of_the_surface():
    height = np.tile(0.6 * np.arange(30.0), (20, 1))
    valid = np.ones(height.shape, bool)
    valid[5:12, 8:20] = False
    variance = np.zeros(height.shape, np.float32)
    points = surface_points(height, (1.0, 1.0))
    points[~valid] = np.nan
    assert (find_smooth(points, variance, valid, FACING, 1.0, 0.601, 0.0) == valid).all()
    assert not find_smooth(points, variance, valid, FACING, 1.0, 0.599, 0.0).any()


def test_a_wall_seen_aslant_is_steep():
    points = surface_points(np.zeros((20, 40)), (0.5, 0.5))
    # From column 20 on the surface runs straight away from the plane, half a millimetre a pixel.
    wall = np.maximum(np.arange(40) - 20, 0) * 0.5
    points[..., 0] = np.minimum(np.arange(40), 20) * 0.5
    points[..., 2] += wall
    smooth = find_smooth(
        points, np.zeros((20, 40), np.float32), np.ones((20, 40), bool), FACING, 0.5, 2.0, 0.0
    )
    assert smooth[:, :20].all()
    assert not smooth[:, 21:].any()


def test_heights_above_a_plane_and_filled_holes_against_the_plain_ones():
    random = np.random.default_rng(1)
    points = random.normal(size=(9, 11, 3))
    valid = random.random((9, 11)) > 0.3
    normal = np.array([0.6, 0.0, 0.8])
    found = heights_above_plane(points, valid, np.ones(3), normal)
    np.testing.assert_allclose(found[valid], ((points - 1) @ normal)[valid], atol=1e-6)
    blobs = ndimage.gaussian_filter(random.normal(size=(60, 70)), 2) > 0
    np.testing.assert_array_equal(fill_holes(blobs), ndimage.binary_fill_holes(blobs))
