from __future__ import annotations

import numpy as np
import pytest
from synthetic_copy import make_copy

from fitting.canvas_shape import measure_shape


def relief(seed, *, rows=240, cols=320):
    """Strokes: correlated over many texels, and all to one side."""
    random = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(cols), np.arange(rows))
    height = np.zeros((rows, cols))
    for _ in range(200):
        cx, cy = random.uniform(-40, cols + 40), random.uniform(-40, rows + 40)
        angle, length, width = random.uniform(0, np.pi), random.uniform(8, 30), random.uniform(3, 8)
        along = (x - cx) * np.cos(angle) + (y - cy) * np.sin(angle)
        across = (y - cy) * np.cos(angle) - (x - cx) * np.sin(angle)
        inside = (np.abs(along) < length) & (np.abs(across) < width)
        height += random.uniform(0.05, 0.4) * inside
    return height


def warp(bow_x, bow_y, twist, *, rows=240, cols=320):
    x, y = np.meshgrid(
        (np.arange(cols) - (cols - 1) / 2) / (cols / 2),
        ((rows - 1) / 2 - np.arange(rows)) / (rows / 2),
    )
    return -bow_x * x**2 - bow_y * y**2 + twist * x * y + 0.3 * x - 0.1 * y + 2.0


def test_the_shape_of_a_bare_canvas_is_found():
    shape = measure_shape(make_copy(warp(1.5, -0.7, 0.4)).height_field)
    assert shape.bow_x_mm == pytest.approx(1.5, abs=2e-3)
    assert shape.bow_y_mm == pytest.approx(-0.7, abs=2e-3)
    assert shape.twist_mm == pytest.approx(0.4, abs=2e-3)
    assert max(shape.sigma_mm) < 2e-3


def test_the_standard_errors_are_what_strokes_make_of_the_shape():
    truth = np.array([1.5, -0.7, 0.4])
    found, predicted = [], []
    for seed in range(40):
        shape = measure_shape(make_copy(warp(*truth) + relief(seed)).height_field)
        found.append([shape.bow_x_mm, shape.bow_y_mm, shape.twist_mm])
        predicted.append(shape.sigma_mm)
    observed = np.std(found, axis=0)
    expected = np.sqrt(np.mean(np.square(predicted), axis=0))
    # Forty draws know their spread to 11 %.
    np.testing.assert_allclose(expected / observed, 1, atol=0.25)
    assert (np.abs(np.mean(found, axis=0) - truth) < 0.5 * observed).all()


def test_independent_texels_have_the_standard_errors_of_least_squares():
    found, predicted = [], []
    for seed in range(60):
        rough = np.random.default_rng(seed).normal(0, 0.5, (60, 80))
        height = warp(0.5, 0.2, -0.3, rows=60, cols=80) + rough
        shape = measure_shape(make_copy(height).height_field)
        found.append([shape.bow_x_mm, shape.bow_y_mm, shape.twist_mm])
        predicted.append(shape.sigma_mm)
    expected = np.sqrt(np.mean(np.square(predicted), axis=0))
    np.testing.assert_allclose(expected / np.std(found, axis=0), 1, atol=0.22)


@pytest.mark.parametrize("shape", [(1, 100), (2, 400), (300, 3), (1, 1)])
def test_a_strip_of_texels_has_no_shape(shape):
    assert measure_shape(make_copy(np.zeros(shape)).height_field) is None


def test_too_little_canvas_has_no_shape():
    mask = np.zeros((240, 320), bool)
    mask[100:110] = True
    field = make_copy(warp(1, 1, 0), mask=mask).height_field
    assert measure_shape(field) is None
