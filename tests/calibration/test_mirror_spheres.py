from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from calibration.errors import CalibrationError
from calibration.lens import Lens
from calibration.mirror_spheres import (
    MirrorSphere,
    find_highlight,
    find_outline,
    highlight_direction_sigma,
    sphere_from_outline,
)

LENS = Lens(
    "LENSMODEL_OPENCV4", np.array([900.0, 902, 160, 118, -0.1, 0.05, 1e-3, -5e-4]), 320, 240
)
CENTRE = np.array([12.0, -9.0, 420.0])
RADIUS = 20.0
LAMP = np.array([-300.0, -350.0, 150.0])
OVERSAMPLED = 4


@pytest.fixture(scope="module")
def picture():
    """A dark mirror before a bright wall, with a small lamp in it; rays averaged over pixels."""
    at = (np.arange(320 * OVERSAMPLED) + 0.5) / OVERSAMPLED - 0.5
    rows, cols = np.meshgrid(at[: 240 * OVERSAMPLED], at, indexing="ij")
    rays = LENS.unproject(np.stack([cols, rows], axis=-1).reshape(-1, 2))
    sphere = MirrorSphere(CENTRE, RADIUS, np.zeros((3, 3)))
    points, directions = sphere.reflect(rays)
    towards = LAMP - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    light = np.where(np.isfinite(points[:, 0]), 60.0, 600.0)
    light[np.sum(directions * towards, axis=1) > np.cos(np.radians(3.0))] = 5000.0
    fine = light.reshape(240, OVERSAMPLED, 320, OVERSAMPLED).mean(axis=(1, 3))
    noisy = fine + np.random.default_rng(0).normal(0, 3.0, fine.shape)
    return np.clip(np.round(noisy), 0, 1023).astype(np.uint16)


def near():
    column, row = LENS.project(CENTRE)
    return float(column) + 1.5, float(row) - 1.0, 900 * RADIUS / 420 + 1.0


def test_a_sphere_is_found_by_its_outline(picture):
    edges = find_outline(picture, near=near())
    sphere = sphere_from_outline(edges, LENS, radius_mm=RADIUS)
    assert sphere.outline_px < 0.1
    # Across the sight a hundredth of a pixel is 5 µm.
    np.testing.assert_allclose(sphere.centre[:2], CENTRE[:2], atol=0.03)
    assert sphere.centre[2] == pytest.approx(CENTRE[2], abs=0.7)


@pytest.mark.parametrize("blur", [0.0, 0.7, 1.2])
def test_a_blurred_outline_is_no_smaller(blur):
    at = (np.arange(240 * OVERSAMPLED) + 0.5) / OVERSAMPLED - 0.5
    cols, rows = np.meshgrid(np.append(at, at[-1] + 1 + at[: 80 * OVERSAMPLED]), at)
    rays = LENS.unproject(np.stack([cols, rows], axis=-1).reshape(-1, 2))
    hit, _ = MirrorSphere(CENTRE, RADIUS, np.eye(3)).reflect(rays)
    light = np.where(np.isfinite(hit[:, 0]), 60.0, 600.0).reshape(cols.shape)
    fine = gaussian_filter(light, blur * OVERSAMPLED)
    seen = fine.reshape(240, OVERSAMPLED, 320, OVERSAMPLED).mean(axis=(1, 3))
    sphere = sphere_from_outline(find_outline(seen, near=near()), LENS, radius_mm=RADIUS)
    # The steepest places lie within the outline, which would put it 0.2 mm away at most blur.
    np.testing.assert_allclose(sphere.centre, CENTRE, atol=0.05)


def test_centres_err_as_much_as_predicted():
    white = []
    clean = outline()
    for seed in range(150):
        noise = np.random.default_rng(seed).normal(0, 0.2, clean.shape)
        sphere = sphere_from_outline(clean + noise, LENS, radius_mm=RADIUS)
        error = sphere.centre - CENTRE
        white.append(np.linalg.solve(np.linalg.cholesky(sphere.covariance), error))
    assert np.sqrt(np.mean(np.square(white))) == pytest.approx(1, abs=0.12)


def test_edges_that_err_like_their_neighbours_leave_the_centre_less_sure():
    edges = outline(240)
    random = np.random.default_rng(3)
    squares, alone = [], []
    for _ in range(60):
        single = random.normal(0, 0.1, edges.shape)
        noise = sum(np.roll(single, lag, axis=0) for lag in range(4))
        sphere = sphere_from_outline(edges + noise, LENS, radius_mm=RADIUS)
        error = sphere.centre - CENTRE
        squares.append(error @ np.linalg.solve(sphere.covariance, error) / 3)
        other = sphere_from_outline(edges + random.permutation(noise), LENS, radius_mm=RADIUS)
        alone.append(sphere.covariance[2, 2] / other.covariance[2, 2])
    assert 0.75 < np.mean(squares) < 1.6
    assert np.median(alone) > 2


def outline(count=120):
    distance = np.linalg.norm(CENTRE)
    across = np.linalg.svd((CENTRE / distance)[np.newaxis])[2][1:]
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    around = np.stack([np.cos(turn), np.sin(turn)], axis=1) @ across
    sine = RADIUS / distance
    return LENS.project(np.sqrt(1 - sine**2) * CENTRE / distance + sine * around)


def test_edges_that_are_not_of_the_sphere_are_left_out():
    edges = outline()
    edges[::6] += 8.0
    sphere = sphere_from_outline(edges, LENS, radius_mm=RADIUS)
    np.testing.assert_allclose(sphere.centre, CENTRE, atol=1e-3)


def test_a_highlight_points_to_the_lamp(picture):
    column, row = LENS.project(CENTRE)
    inside = (float(column), float(row), 900 * RADIUS / 420)
    pixel, sigma = find_highlight(picture, inside=inside, saturation=1023)
    sphere = MirrorSphere(CENTRE, RADIUS, np.zeros((3, 3)))
    point, direction = sphere.reflect(LENS.unproject(pixel[np.newaxis]))
    towards = (LAMP - point[0]) / np.linalg.norm(LAMP - point[0])
    angle = np.arccos(np.clip(direction[0] @ towards, -1, 1))
    assert angle < 4 * highlight_direction_sigma(sphere, LENS, pixel, sigma) + np.radians(0.1)
    assert sigma < 0.2


def test_rays_beside_a_sphere_meet_nothing():
    sphere = MirrorSphere(CENTRE, RADIUS, np.zeros((3, 3)))
    points, directions = sphere.reflect(np.array([[1.0, 0, 1]]))
    assert np.isnan(points).all()
    assert np.isnan(directions).all()


def test_what_is_no_sphere_is_refused(picture):
    line = np.stack([np.linspace(0, 300, 50), np.full(50, 100.0)], axis=1)
    with pytest.raises(CalibrationError):
        sphere_from_outline(line, LENS, radius_mm=RADIUS)
    with pytest.raises(CalibrationError, match="edges of a sphere agree"):
        sphere_from_outline(outline()[:10], LENS, radius_mm=RADIUS)
    with pytest.raises(CalibrationError, match="positive radius"):
        sphere_from_outline(outline(), LENS, radius_mm=-1.0)
    with pytest.raises(CalibrationError, match="too small"):
        find_outline(picture, near=(10.0, 10.0, 2.0))
    with pytest.raises(CalibrationError, match="not before the camera"):
        MirrorSphere(-CENTRE, RADIUS, np.zeros((3, 3)))


def test_highlights_that_are_none_are_refused(picture):
    column, row, radius = near()
    inside = (column, row, radius)
    dark = np.random.default_rng(1).normal(60, 3, picture.shape)
    with pytest.raises(CalibrationError, match="is the lamp lit"):
        find_highlight(dark, inside=inside, saturation=1023)
    two = dark.copy()
    for shift in (-12, 12):
        two[int(row) - 3 : int(row) + 3, int(column) + shift - 3 : int(column) + shift + 3] = 900
    with pytest.raises(CalibrationError, match="2 highlights"):
        find_highlight(two, inside=inside, saturation=1023)
