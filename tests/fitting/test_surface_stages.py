from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from synthetic_scan import bumps, correspond

from acquisition.correspondence import Rejection
from acquisition.patterns import Axis
from calibration.lens import invert, rotation, rt_from_matrix, transform
from fitting.canvas import InPlaneAxes, extract_canvas
from fitting.errors import FittingError
from fitting.neighbour_kernels import triangle_normals
from fitting.range_image import triangulate
from fitting.resampling import resample_heights
from fitting.surface import reconstruct_surface
from fitting.surface_noise import measure_surface_noise
from fitting.triangulation_kernels import find_supported


@pytest.mark.parametrize("axes", [(Axis.COLUMN,), tuple(Axis)])
def test_points_and_their_variance_are_right(rig_geometry, axes):
    exact, points = correspond(rig_geometry, bumps, sigma=0.0, axes=axes)
    found = triangulate(exact, rig_geometry)
    assert found.valid.all()
    np.testing.assert_allclose(found.points, points, atol=1e-6)
    noisy, points = correspond(rig_geometry, bumps, axes=axes)
    found = triangulate(noisy, rig_geometry)
    z = (found.points[..., 2] - points[..., 2]) / np.sqrt(found.depth_variance)
    assert found.valid.mean() > 0.999
    assert np.std(z[found.valid]) == pytest.approx(1, abs=0.03)


def test_any_lens_model_gives_the_points_of_the_compiled_one(rig_geometry, monkeypatch):
    noisy, _ = correspond(rig_geometry, bumps)
    spoiled, _ = with_wrong_columns(noisy)
    compiled = triangulate(spoiled, rig_geometry)
    monkeypatch.setattr(type(rig_geometry.projector), "opencv_parameters", None)
    plain = triangulate(spoiled, rig_geometry)
    np.testing.assert_array_equal(plain.rejection, compiled.rejection)
    np.testing.assert_allclose(plain.points, compiled.points, atol=1e-7)
    np.testing.assert_allclose(plain.depth_variance, compiled.depth_variance, rtol=1e-5)


def with_wrong_columns(correspondence, share=0.1):
    wrong = np.random.default_rng(3).random(correspondence.shape) < share
    column = correspondence.axes[Axis.COLUMN]
    moved = dataclasses.replace(column, coordinate=column.coordinate + 32.0 * wrong)
    axes = {**correspondence.axes, Axis.COLUMN: moved}
    return dataclasses.replace(correspondence, axes=axes), wrong


def test_wrong_orders_are_repaired_where_the_baseline_is_oblique(rig_geometry):
    pose = np.array([-0.15, 0.3, 0.01, -130.0, -80.0, 25.0])
    shifted = rig_geometry.projector.intrinsics + np.array([0, 0, 0, 45.0, 0, 0, 0, 0, 0])
    projector = dataclasses.replace(rig_geometry.projector, intrinsics=shifted)
    oblique = dataclasses.replace(rig_geometry, projector=projector, rt_proj_cam=pose)
    noisy, points = correspond(oblique, bumps)
    spoiled, wrong = with_wrong_columns(noisy)
    found = triangulate(spoiled, oblique)
    error = np.abs(found.points[..., 2] - points[..., 2])[found.valid]
    assert error.max() < 8 * np.sqrt(np.median(found.depth_variance))
    assert found.valid[wrong].mean() > 0.99


def test_wrong_orders_that_the_geometry_cannot_tell_are_outliers(rig_geometry):
    noisy, _ = correspond(rig_geometry, bumps)
    spoiled, wrong = with_wrong_columns(noisy, share=0.05)
    found = triangulate(spoiled, rig_geometry)
    assert (found.rejection[wrong] & Rejection.OUTLIER != 0).mean() > 0.999
    assert found.valid[~wrong].mean() > 0.999


def test_a_bent_calibration_across_the_baseline_does_not_bend_the_surface(rig_geometry):
    exact, points = correspond(rig_geometry, bumps, sigma=0.02)
    row = exact.axes[Axis.ROW]
    off = row.coordinate * 1.01 + 3.0
    moved = {**exact.axes, Axis.ROW: dataclasses.replace(row, coordinate=off)}
    found = triangulate(dataclasses.replace(exact, axes=moved), rig_geometry)
    assert found.misalignment_px == pytest.approx(
        np.sqrt(np.mean((off - row.coordinate) ** 2)), rel=0.1
    )
    error = (found.points[..., 2] - points[..., 2])[found.valid]
    assert np.abs(error).max() < 8 * np.sqrt(np.median(found.depth_variance))


@pytest.mark.parametrize(("off_px", "doubted"), [(0.5, False), (4.0, True)])
def test_a_calibration_that_contradicts_the_rows_is_doubted(rig_geometry, off_px, doubted):
    exact, _ = correspond(rig_geometry, framed, sigma=0.02)
    row = exact.axes[Axis.ROW]
    moved = dataclasses.replace(row, coordinate=row.coordinate + off_px)
    axes = {**exact.axes, Axis.ROW: moved}
    surface = reconstruct_surface(dataclasses.replace(exact, axes=axes), rig_geometry)
    assert any("columns and rows disagree" in w for w in surface.warnings) == doubted
    assert surface.range_image.rejection.dtype == np.uint16


def test_a_foreign_calibration_is_refused(rig_geometry):
    exact, _ = correspond(rig_geometry, bumps)
    mirrored = dataclasses.replace(
        rig_geometry, rt_proj_cam=rig_geometry.rt_proj_cam * [1, 1, 1, -1, 1, 1]
    )
    with pytest.raises(FittingError, match="calibration belongs to this rig"):
        triangulate(exact, mirrored)


def test_supported_pixels_against_plain_loops():
    random = np.random.default_rng(0)
    depth = 400 + random.normal(0, 0.5, (12, 14))
    valid = random.random(depth.shape) > 0.2
    valid[5, 5], depth[5, 5] = True, 420
    variance = np.full(depth.shape, 0.01, np.float32)
    found = find_supported(depth, variance, valid, 0.0005, 2.0, 0.3)
    for row, col in np.ndindex(depth.shape):
        near = [
            (i, j)
            for i in range(max(0, row - 2), min(12, row + 3))
            for j in range(max(0, col - 2), min(14, col + 3))
            if (i, j) != (row, col)
        ]
        agree = sum(
            valid[i, j]
            and abs(depth[i, j] - depth[row, col])
            < 0.0005 * depth[row, col] * np.hypot(i - row, j - col) + 2 * np.sqrt(0.02)
            for i, j in near
        )
        assert found[row, col] == (valid[row, col] and agree >= 0.3 * len(near))
    assert 0.2 < found[valid].mean() < 0.99


def framed(x, y):
    outside = np.maximum(np.abs(x) - 45, np.abs(y) - 32)
    return np.where(outside > 0, -12.0, bumps(x, y))


def test_the_canvas_is_found_inside_its_frame(rig_geometry):
    noisy, points = correspond(rig_geometry, framed)
    canvas = extract_canvas(triangulate(noisy, rig_geometry))
    x, y = points[..., 0], points[..., 1]
    inside = (np.abs(x) < 43) & (np.abs(y) < 30)
    assert canvas.mask[inside].mean() > 0.995
    assert not canvas.mask[(np.abs(x) > 45.5) | (np.abs(y) > 32.5)].any()
    assert canvas.axes is InPlaneAxes.MASK_EDGES
    axes = rotation(canvas.rt_cam_canvas)
    normal = np.array([0.06, -0.04, -1.0]) / np.linalg.norm([0.06, -0.04, -1.0])
    assert axes[:, 2] @ normal > np.cos(np.deg2rad(0.5))
    assert axes[0, 0] > 0.99
    assert axes[1, 1] < -0.99
    assert np.linalg.det(axes) == pytest.approx(1)


def test_the_centre_may_be_a_hole(rig_geometry):
    noisy, _ = correspond(rig_geometry, framed)
    rejection = noisy.rejection.copy()
    rejection[100:140, 140:180] = Rejection.LOW_MODULATION
    holed = dataclasses.replace(noisy, rejection=rejection)
    canvas = extract_canvas(triangulate(holed, rig_geometry))
    whole = extract_canvas(triangulate(noisy, rig_geometry))
    assert canvas.mask.sum() > 0.95 * (whole.mask.sum() - 1600)
    assert not canvas.mask[105:135, 145:175].any()


def test_nothing_but_spikes_is_an_empty_canvas(rig_geometry):
    noisy, _ = correspond(
        rig_geometry, lambda x, y: 25 * np.sign(np.sin(40 * x) * np.sin(40 * y)), sigma=0.01
    )
    with pytest.raises(FittingError):
        extract_canvas(triangulate(noisy, rig_geometry))


@pytest.mark.parametrize("pitch", [None, 1.5])
def test_heights_and_their_variance_are_right_at_any_pitch(rig_geometry, pitch):
    def gentle(x, y):
        return -0.8 * np.exp(-((x - 8) ** 2 + (y + 5) ** 2) / 300)

    exact, _ = correspond(rig_geometry, gentle, sigma=0.0)
    canvas = extract_canvas(triangulate(exact, rig_geometry))
    truth = resample_heights(triangulate(exact, rig_geometry), canvas, pitch_mm=pitch)
    z = []
    for seed in range(4):
        noisy, _ = correspond(rig_geometry, gentle, seed=seed)
        field = resample_heights(
            triangulate(noisy, rig_geometry),
            dataclasses.replace(canvas, mask=canvas.mask & triangulate(noisy, rig_geometry).valid),
            pitch_mm=truth.pitch_mm,
        )
        rows, cols = np.minimum(field.shape, truth.shape)
        shift = np.subtract(field.origin_mm, truth.origin_mm) / truth.pitch_mm
        assert np.abs(shift).max() < 0.2
        both = (field.mask & True)[5 : rows - 5, 5 : cols - 5]
        error = (field.height[:rows, :cols] - truth.height[:rows, :cols])[
            5 : rows - 5, 5 : cols - 5
        ]
        sigma = np.sqrt(field.variance[5 : rows - 5, 5 : cols - 5])
        z.append(error[both] / sigma[both])
    assert np.std(np.concatenate(z)) == pytest.approx(1, abs=0.05)


def test_white_noise_of_the_surface_is_as_predicted(rig_geometry):
    noisy, _ = correspond(rig_geometry, bumps)
    found = triangulate(noisy, rig_geometry)
    noise = measure_surface_noise(found, extract_canvas(found))
    assert noise.observed_mm == pytest.approx(noise.predicted_mm, rel=0.04)


def test_a_pitch_that_makes_no_sense_is_refused(rig_geometry):
    exact, _ = correspond(rig_geometry, bumps)
    found = triangulate(exact, rig_geometry)
    canvas = extract_canvas(found)
    for pitch in (0.0, -1.0, float("nan"), 1e-4):
        with pytest.raises(FittingError, match="pitch"):
            resample_heights(found, canvas, pitch_mm=pitch)


def test_normals_of_a_sphere_and_at_a_border():
    x, y = np.meshgrid(np.linspace(-5, 5, 101), np.linspace(5, -5, 101))
    height = np.sqrt(100 - x**2 - y**2).astype(np.float32)
    mask = np.ones(height.shape, bool)
    mask[40:60, 40:60] = False
    normal, sigma = triangle_normals(height, mask, np.full(height.shape, 1e-4, np.float32), 0.1)
    expected = np.stack([x, y], axis=-1) / 10
    np.testing.assert_allclose(
        normal[1:-1, 1:-1][mask[1:-1, 1:-1]], expected[1:-1, 1:-1][mask[1:-1, 1:-1]], atol=0.008
    )
    inner = (slice(5, 35), slice(5, 35))
    np.testing.assert_allclose(normal[inner], expected[inner], atol=2e-4)
    assert (sigma[mask] > 0).all()
    assert not normal[~mask].any()


def test_the_standard_error_of_normals_is_what_noise_makes_of_them():
    random = np.random.default_rng(0)
    variance = np.full((80, 80), 1e-4, np.float32)
    noisy = random.normal(0, 1e-2, (80, 80)).astype(np.float32)
    normal, sigma = triangle_normals(noisy, np.ones((80, 80), bool), variance, 0.5)
    spread = np.std(normal[2:-2, 2:-2])
    assert spread == pytest.approx(float(np.median(sigma)), rel=0.04)


def test_rt_names_read_off():
    pose = rt_from_matrix(np.eye(3), np.array([1.0, 2, 3]))
    np.testing.assert_allclose(transform(invert(pose), np.array([[1.0, 2, 3]])), 0, atol=1e-12)
