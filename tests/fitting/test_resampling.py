from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from synthetic_scan import make_range_image

from fitting.canvas import Canvas, InPlaneAxes
from fitting.errors import FittingError
from fitting.height_field import CORRELATION_REACH
from fitting.neighbour_kernels import triangle_normals
from fitting.resampling import (
    canvas_samples,
    footprint_radius_mm,
    point_spacing_mm,
    resample_heights,
)
from fitting.surface_noise import slope_error_ratio


def canvas_of(scene, mask=None):
    """The canvas as it truly is."""
    mask = scene.image.valid if mask is None else mask
    return Canvas(mask, scene.rt_cam_surface, InPlaneAxes.PICTURE, mask)


def truth_at(field, relief):
    x, y = np.meshgrid(field.texel_x_mm(), field.texel_y_mm())
    return relief(x, y)


def quadratic(x, y):
    return 1e-3 * (0.7 * x**2 - 0.4 * x * y + 0.3 * y**2) + 0.02 * x - 0.01 * y + 0.4


def ripples(wavelength, amplitude=0.5):
    return lambda x, y: amplitude * np.cos(2 * np.pi * (0.8 * x + 0.6 * y) / wavelength)


@pytest.mark.parametrize("pitch", [0.3, None, 2.0])
def test_a_quadratic_surface_comes_back_exactly(pitch):
    scene = make_range_image(quadratic, sigma=0.0)
    field = resample_heights(scene.image, canvas_of(scene), pitch_mm=pitch)
    assert field.mask[5:-5, 5:-5].all()
    # At the rim, where samples lie to one side, planes are fitted.
    error = (field.height - truth_at(field, quadratic))[5:-5, 5:-5]
    assert np.abs(error).max() < 2e-6
    assert field.unresolved_mm < 1e-5


def combination(terms, weight):
    """Inverse normal matrix, and the shares of the samples in the value at the texel."""
    inverse = np.linalg.inv((terms.T * weight) @ terms)
    return inverse, (inverse[0] @ terms.T) * weight


def test_each_texel_against_plain_least_squares():
    random = np.random.default_rng(0)
    scene = make_range_image(ripples(12.0), sigma=0.03)
    variance = scene.image.depth_variance * random.uniform(0.3, 3, scene.x.shape).astype(np.float32)
    mask = scene.image.valid & (random.random(scene.x.shape) > 0.05)
    canvas = canvas_of(scene, mask)
    image = dataclasses.replace(scene.image, depth_variance=variance)
    field = resample_heights(image, canvas)
    place, height, sample_variance = canvas_samples(image, canvas)
    radius = footprint_radius_mm(point_spacing_mm(image, canvas), field.pitch_mm)
    x, y = place[mask].T
    z, v = height[mask].astype(float), sample_variance[mask].astype(float)
    compared = 0
    for row, col in random.integers([3, 3], np.subtract(field.shape, 3), (60, 2)):
        if not field.mask[row, col]:
            continue
        dx = (x - field.texel_x_mm()[col]) / radius[0]
        dy = (field.texel_y_mm()[row] - y) / radius[1]
        near = dx**2 + dy**2 < 1
        dx, dy = dx[near], dy[near]
        weight = (1 - dx**2 - dy**2) ** 2 / v[near]
        terms = np.stack([np.ones_like(dx), dx, dy, dx**2, dx * dy, dy**2], axis=1)
        inverse, shares = combination(terms, weight)
        of_mean = (weight**2 @ v[near]) / weight.sum() ** 2
        if shares**2 @ v[near] > 9 * of_mean:
            terms = terms[:, :3]
            inverse, shares = combination(terms, weight)
        assert field.height[row, col] == pytest.approx(shares @ z[near], abs=3e-6)
        off = z[near] - terms @ inverse @ (terms.T * weight) @ z[near]
        scatter = weight @ off**2
        if scatter < 1.9 * (weight @ v[near]):
            expected = shares**2 @ v[near]
            assert field.variance[row, col] == pytest.approx(expected, rel=1e-4)
            compared += 1
    assert compared > 40


def test_a_finer_grid_brings_a_curved_surface_closer_by_its_cube():
    error = []
    for scale in (1, 2):
        scene = make_range_image(
            ripples(16.0), sigma=0.0, shape=(96 * scale, 128 * scale), focal=360.0 * scale
        )
        field = resample_heights(scene.image, canvas_of(scene))
        inner = field.mask[4:-4, 4:-4]
        off = (field.height - truth_at(field, ripples(16.0)))[4:-4, 4:-4][inner]
        error.append(np.sqrt(np.mean(off**2)))
    assert error[0] / error[1] > 7
    assert error[1] < 1e-3


def test_detail_finer_than_a_coarse_grid_does_not_alias():
    fine = ripples(2.2)
    scene = make_range_image(lambda x, y: quadratic(x, y) + fine(x, y), sigma=0.0)
    coarse = resample_heights(scene.image, canvas_of(scene), pitch_mm=4.0)
    picked = np.std(truth_at(coarse, fine)[coarse.mask])
    left = np.std((coarse.height - truth_at(coarse, quadratic))[coarse.mask])
    assert left < 0.05 * picked


def standardised_errors(relief, **options):
    z = []
    for seed in range(6):
        scene = make_range_image(relief, sigma=0.05, seed=seed)
        field = resample_heights(scene.image, canvas_of(scene), **options)
        z.append(
            np.where(
                field.mask,
                (field.height - truth_at(field, relief))
                / np.sqrt(np.where(field.mask, field.variance, 1)),
                0,
            )
        )
    return np.stack(z), field


@pytest.mark.parametrize("options", [{}, {"pitch_mm": 1.5}, {"footprint_mm": 3.0}])
def test_errors_and_their_correlation_are_as_stated(options):
    z, field = standardised_errors(quadratic, **options)
    inner = z[:, 6:-6, 6:-6]
    assert np.std(inner) == pytest.approx(1, abs=0.04)
    assert abs(np.mean(inner)) < 0.03
    reach = CORRELATION_REACH
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)):
        shifted = np.roll(z, (-down, -right), axis=(1, 2))[:, 6:-6, 6:-6]
        observed = np.mean(inner * shifted)
        assert field.correlation[reach + down, reach + right] == pytest.approx(observed, abs=0.04)
    np.testing.assert_allclose(field.correlation, field.correlation[::-1, ::-1])


def test_standard_errors_of_normals_allow_for_what_neighbours_share():
    spread, predicted = [], []
    for seed in range(4):
        scene = make_range_image(lambda x, y: 0 * x, sigma=0.05, seed=seed)
        field = resample_heights(scene.image, canvas_of(scene))
        normal, sigma = triangle_normals(field.height, field.mask, field.variance, field.pitch_mm)
        ratio = slope_error_ratio(field.correlation)
        spread.append(np.std(normal[6:-6, 6:-6]))
        predicted.append(ratio * np.median(sigma[6:-6, 6:-6]))
    assert np.mean(spread) == pytest.approx(np.mean(predicted), rel=0.04)
    assert slope_error_ratio(np.pad([[1.0]], CORRELATION_REACH)) == pytest.approx(1)


def test_more_footprint_is_less_noise():
    scene = make_range_image(quadratic, sigma=0.05)
    plain = resample_heights(scene.image, canvas_of(scene))
    smooth = resample_heights(
        scene.image, canvas_of(scene), pitch_mm=plain.pitch_mm, footprint_mm=3.0
    )
    assert np.median(smooth.variance) < 0.3 * np.median(plain.variance)
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(FittingError, match="footprint"):
            resample_heights(scene.image, canvas_of(scene), footprint_mm=wrong)


def test_nothing_is_made_up_across_gaps():
    scene = make_range_image(quadratic)
    gap = (np.abs(scene.x - 5) < 1.6) | (np.hypot(scene.x + 20, scene.y) < 6)
    field = resample_heights(scene.image, canvas_of(scene, scene.image.valid & ~gap))
    x, y = np.meshgrid(field.texel_x_mm(), field.texel_y_mm())
    assert not field.mask[np.abs(x - 5) < 0.9].any()
    assert not field.mask[np.hypot(x + 20, y) < 5].any()
    assert field.mask[(np.abs(x - 5) > 2.5) & (np.hypot(x + 20, y) > 7)][100:-100].mean() > 0.98
    assert not field.height[~field.mask].any()


def test_what_the_samples_do_not_resolve_is_owned_up_to():
    """Steps narrower than the samples' spacing, which no polynomial follows."""

    def steps(x, y):
        return 0.8 * (np.sin(x / 1.7) * np.sin(y / 2.3) > 0.4)

    scene = make_range_image(steps, sigma=0.01)
    field = resample_heights(scene.image, canvas_of(scene))
    error = (field.height - truth_at(field, steps))[field.mask]
    assert field.unresolved_mm > 0.03
    predicted = np.sqrt(np.mean(field.variance[field.mask]))
    assert 0.5 < np.sqrt(np.mean(error**2)) / predicted < 2
    smooth = make_range_image(quadratic, sigma=0.01)
    assert resample_heights(smooth.image, canvas_of(smooth)).unresolved_mm < 1e-3
