"""The surface stages on inputs far from the easy case: the same answer, or a sentence."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from synthetic_scan import make_range_image

from fitting.canvas import CanvasOptions, extract_canvas
from fitting.errors import FittingError
from fitting.range_image import RangeImage
from fitting.relief_classification import ReliefOptions, classify_relief
from fitting.resampling import resample_heights


def surface(x, y):
    """A canvas of 80 × 60 mm with a thick stroke, before a wall."""
    outside = np.maximum(np.abs(x) - 40, np.abs(y) - 30)
    stroke = 2.0 * np.exp(-(((x - 8) / 9) ** 2) - ((y + 5) / 4) ** 2)
    return np.where(outside > 0, -18.0, stroke + 0.05 * np.sin(x / 2) * np.sin(y / 2))


@pytest.fixture(scope="module")
def easy():
    scene = make_range_image(surface, sigma=0.02)
    return scene.image, reconstruct(scene.image)


def reconstruct(image: RangeImage, *, unit: float = 1.0):
    canvas = extract_canvas(image, CanvasOptions())
    field = resample_heights(image, canvas)
    return field, classify_relief(field, ReliefOptions(smallest_mm2=unit**2))


def assert_same(found, expected, *, unit=1.0, height_mm):
    (field, relief), (reference, classified) = found, expected
    assert field.shape == reference.shape
    assert field.pitch_mm == pytest.approx(unit * reference.pitch_mm, rel=1e-5)
    assert (field.mask != reference.mask).mean() < 2e-4
    both = field.mask & reference.mask
    error = (field.height / unit - reference.height)[both]
    assert np.abs(error).max() < height_mm
    np.testing.assert_allclose(
        (np.sqrt(field.variance) / unit)[both], np.sqrt(reference.variance)[both], rtol=0.01
    )
    assert relief.delta0_mm / unit == pytest.approx(classified.delta0_mm, abs=0.02)
    assert len(relief.boxes) == pytest.approx(len(classified.boxes), abs=1)


def test_ten_metres_further_away_the_surface_is_the_same(easy):
    image, expected = easy
    far = dataclasses.replace(image, points=image.points + np.array([0, 0, 1e4]))
    found = reconstruct(far)
    # From there the rays are all but parallel, which changes the weights of the samples slightly.
    (field, relief), (reference, classified) = found, expected
    assert field.shape == reference.shape
    both = field.mask & reference.mask
    assert both.sum() > 0.999 * reference.mask.sum()
    assert np.abs(field.height - reference.height)[both].max() < 1e-3
    assert relief.delta0_mm == pytest.approx(classified.delta0_mm, abs=1e-3)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_another_unit_of_length_scales_the_surface(easy, unit):
    image, expected = easy
    scaled = dataclasses.replace(
        image,
        points=image.points * unit,
        depth_variance=(image.depth_variance * unit**2).astype(np.float32),
    )
    assert_same(reconstruct(scaled, unit=unit), expected, unit=unit, height_mm=1e-4)


def test_points_in_single_precision_cost_a_tenth_of_a_micrometre(easy):
    image, expected = easy
    single = dataclasses.replace(image, points=image.points.astype(np.float32))
    # Depths of 430 mm are rounded to 0.03 µm.
    assert_same(reconstruct(single), expected, height_mm=1e-4)


def test_a_row_of_nan_is_a_gap_and_nothing_else(easy):
    image, (reference, _) = easy
    points = image.points.copy()
    points[100] = np.nan
    rejection = image.rejection.copy()
    field, _ = reconstruct(dataclasses.replace(image, points=points))
    rejection[100] = 2
    flagged, _ = reconstruct(dataclasses.replace(image, points=points, rejection=rejection))
    np.testing.assert_array_equal(field.height, flagged.height)
    assert field.mask.sum() > 0.97 * reference.mask.sum()
    # Other points make the plane, and the grid is laid anew: the surface is what is compared.
    for measure in (np.std, np.max, np.min):
        expected = measure(reference.height[reference.mask])
        assert measure(field.height[field.mask]) == pytest.approx(expected, abs=0.03)
    assert np.isfinite(field.height).all()
    assert np.isfinite(field.variance).all()


def test_with_ninety_nine_in_a_hundred_masked_the_answer_is_a_sentence(easy):
    image, _ = easy
    rejection = image.rejection.copy()
    rejection[np.random.default_rng(0).random(rejection.shape) < 0.99] = 2
    sparse = dataclasses.replace(image, rejection=rejection)
    with pytest.raises(FittingError, match=r"smooth surface|neighbouring|empty"):
        reconstruct(sparse)


def test_a_hundredth_of_the_picture_in_one_piece_is_a_surface(easy):
    image, (reference, _) = easy
    rejection = np.full_like(image.rejection, 2)
    rejection[84:108, 116:140] = 0
    field, _ = reconstruct(dataclasses.replace(image, rejection=rejection))
    assert field.mask.sum() > 150
    assert abs(field.pitch_mm / reference.pitch_mm - 1) < 0.02
    assert np.std(field.height[field.mask]) < 1


@pytest.mark.parametrize("count", [10, 1, 0])
def test_ten_points_are_refused_in_a_sentence(easy, count):
    image, _ = easy
    rejection = np.full_like(image.rejection, 2)
    rejection[96, 120 : 120 + count] = 0
    with pytest.raises(FittingError, match=r"smooth surface|empty|takes 10 points"):
        reconstruct(dataclasses.replace(image, rejection=rejection))
