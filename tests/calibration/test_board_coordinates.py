from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from acquisition.correspondence import AxisCoordinate, CorrespondenceMap
from acquisition.patterns import Axis
from calibration.board_coordinates import projector_coordinates
from calibration.errors import CalibrationError
from calibration.phase_errors import compensate_phase_errors

SHAPE = (330, 400)
ORIGIN = (100, 50)
PERIOD = 40.0
BLUR = 1.3


def true_coordinates(pixels):
    """A smooth map from camera to projector, with perspective."""
    x, y = pixels[..., 0] - 300, pixels[..., 1] - 210
    depth = 1 + 2e-4 * x - 1e-4 * y
    return np.stack([500 + (0.9 * x + 0.1 * y) / depth, 300 + (1.1 * y - 0.05 * x) / depth], -1)


def corners():
    col, row = np.meshgrid(np.arange(8), np.arange(6))
    return np.stack([130.0 + 46.3 * col + 2 * row, 80 + 47.7 * row - 1.5 * col], axis=-1)


def board_map(*, sigma=0.2, harmonic_px=0.0, blur=False, blisters_px=0.0, seed=0):
    """A decoded chessboard: noise by modulation, a periodic error, blur across its edges.

    Blisters along the fringes, a period apart, show in the columns.
    """
    rng = np.random.default_rng(seed)
    row, col = np.indices(SHAPE, dtype=float)
    pixels = np.stack([col + ORIGIN[0], row + ORIGIN[1]], axis=-1)
    true = true_coordinates(pixels)
    # Which square: inverse of the corners' affine grid.
    inverse = np.linalg.inv(np.array([[46.3, 2.0], [-1.5, 47.7]]))
    square = np.floor((pixels - [130.0, 80.0]) @ inverse.T).astype(int).sum(axis=-1)
    reflectance = np.where(square % 2, 60.0, 8.0)
    modulation = gaussian_filter(reflectance, BLUR) if blur else reflectance
    axes = {}
    for number, axis in enumerate((Axis.COLUMN, Axis.ROW)):
        x = true[..., number]
        if blur:
            x = gaussian_filter(reflectance * x, BLUR) / modulation
        if axis is Axis.COLUMN:
            ridge = np.cos(np.pi * x / PERIOD) ** 16 * (np.abs(row - 160) < 60)
            x = x + blisters_px * ridge * (np.abs(x - 480) < 1.5 * PERIOD)
        x = x + harmonic_px * np.cos(3 * 2 * np.pi * x / PERIOD)
        noise = sigma * 60 / modulation
        axes[axis] = AxisCoordinate(
            x + rng.normal(0, 1, SHAPE) * noise,
            (noise**2).astype(np.float32),
            modulation.astype(np.float32),
            PERIOD,
            float("nan"),
        )
    return CorrespondenceMap(
        axes, modulation.astype(np.float32), np.zeros(SHAPE, np.uint16), ORIGIN, 1.0
    )


def test_coordinates_of_corners_are_true_within_their_variance():
    white = []
    for seed in range(6):
        found = projector_coordinates(board_map(seed=seed), corners())
        error = found.pixels - true_coordinates(corners())
        white.append(error / np.sqrt(found.variance))
    assert np.sqrt(np.mean(np.square(white))) == pytest.approx(1, abs=0.15)
    assert np.sqrt(found.variance).max() < 0.04


def test_an_error_of_the_corner_counts_with_the_slope():
    found = projector_coordinates(board_map(), corners())
    right, below = np.array([0.1, 0]), np.array([0, 0.1])
    step = true_coordinates(corners() + right) - true_coordinates(corners() - right)
    down = true_coordinates(corners() + below) - true_coordinates(corners() - below)
    slope = np.sqrt(np.sum(step**2 + down**2, axis=-1) / 2) / 0.2
    np.testing.assert_allclose(found.slope, slope, rtol=0.02)
    sigma = found.sigma_px(camera_sigma_px=0.3)
    np.testing.assert_allclose(sigma, 0.3 * slope, rtol=0.03)


def test_structure_that_a_window_cannot_average_raises_the_variance():
    calm = projector_coordinates(board_map(sigma=0.05), corners()).variance
    wavy = projector_coordinates(board_map(sigma=0.05, harmonic_px=0.2), corners()).variance
    assert np.median(wavy) > 4 * np.median(calm)


def test_periodic_errors_are_found_and_subtracted():
    observed = board_map(harmonic_px=0.15)
    clean, errors = compensate_phase_errors(observed, corners())
    found = errors[Axis.COLUMN]
    third = found.orders.index(3)
    assert found.amplitude_px[third] == pytest.approx(0.15, abs=5 * found.sigma_px[third] + 0.003)
    others = np.delete(found.amplitude_px, third)
    assert others.max() < 0.02
    row, col = np.indices(SHAPE, dtype=float)
    true = true_coordinates(np.stack([col + ORIGIN[0], row + ORIGIN[1]], axis=-1))
    periodic = 0.15 * np.cos(3 * 2 * np.pi * true[..., 0] / PERIOD)
    subtracted = (m.axes[Axis.COLUMN].coordinate for m in (observed, clean))
    left = next(subtracted) - next(subtracted) - periodic
    # In the dark squares the phase itself, at which the error is taken, is too noisy to tell.
    bright = observed.axes[Axis.COLUMN].modulation > 50
    assert left[40:-40, 40:-40][bright[40:-40, 40:-40]].std() < 0.15 * periodic.std()


def test_blisters_below_a_pixel_s_noise_are_no_periodic_error():
    _, errors = compensate_phase_errors(board_map(sigma=0.5, blisters_px=1.0), corners())
    found = errors[Axis.COLUMN]
    assert (found.amplitude_px < 4 * found.sigma_px + 0.003).all()


def test_the_pull_of_bright_squares_at_edges_is_removed():
    observed = board_map(sigma=0.05, blur=True)
    clean, errors = compensate_phase_errors(observed, corners())
    row, col = np.indices(SHAPE, dtype=float)
    true = true_coordinates(np.stack([col + ORIGIN[0], row + ORIGIN[1]], axis=-1))
    inner = np.s_[40:-60, 50:-50]
    before, after = (
        (m.axes[Axis.COLUMN].coordinate - true[..., 0])[inner] for m in (observed, clean)
    )
    edge = np.abs(gaussian_filter(before, 1)) > 0.3
    assert edge.mean() > 0.01
    assert np.sqrt(np.mean(after[edge] ** 2)) < 0.35 * np.sqrt(np.mean(before[edge] ** 2))
    # The parts' moments add up to the variance of the blur.
    assert errors[Axis.COLUMN].blur_px2.sum() == pytest.approx(BLUR**2, rel=0.05)


def test_maps_that_cannot_serve_are_refused_by_name():
    observed = board_map()
    alone = CorrespondenceMap(
        {Axis.COLUMN: observed.axes[Axis.COLUMN]},
        observed.ambient,
        observed.rejection,
        ORIGIN,
        1.0,
    )
    with pytest.raises(CalibrationError, match="pose 3: no row coordinates"):
        projector_coordinates(alone, corners(), name="pose 3")
    dark = CorrespondenceMap(
        observed.axes, observed.ambient, np.full(SHAPE, 2, np.uint16), ORIGIN, 1.0
    )
    with pytest.raises(CalibrationError, match="pose 3: no corner has decoded pixels"):
        projector_coordinates(dark, corners(), name="pose 3")
    with pytest.raises(CalibrationError, match="pose 3: only 0 pixels"):
        compensate_phase_errors(dark, corners(), name="pose 3")


def test_a_corner_beside_the_decoded_area_has_no_coordinates():
    observed = board_map()
    rejection = observed.rejection.copy()
    rejection[:, 200:] = 2
    half = CorrespondenceMap(observed.axes, observed.ambient, rejection, ORIGIN, 1.0)
    found = projector_coordinates(half, corners())
    lost = ~np.isfinite(found.pixels).all(axis=-1)
    assert lost[:, 5:].all()
    assert not lost[:, :3].any()
