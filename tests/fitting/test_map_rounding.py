from __future__ import annotations

import dataclasses

import numpy as np
import OpenEXR
import pytest
from synthetic_copy import make_copy, strokes

from fitting.copy_files import read_copy, write_copy
from fitting.digital_copy import DigitalCopy, ReflectanceMaps, ReflectanceQuality
from fitting.map_rounding import MapRounding, multiples, significant


def measured(sigma_mm: float = 0.01) -> DigitalCopy:
    """Heights with noise, and reflectance whose errors are known."""
    random = np.random.default_rng(0)
    height = strokes() + sigma_mm * random.standard_normal((120, 160))
    copy = make_copy(height)
    field = dataclasses.replace(
        copy.height_field, variance=np.full(height.shape, sigma_mm**2, np.float32)
    )
    shape = height.shape

    def around(value: float, *channels: int, spread: float = 0.1) -> np.ndarray:
        noise = 1 + spread * random.standard_normal((*shape, *channels))
        return (value * np.abs(noise)).astype(np.float32)

    quality = ReflectanceQuality(
        around(0.002, 3),
        around(0.01, 3),
        around(0.06, 3),
        around(0.01),
        np.full(shape, 40, np.uint16),
        np.zeros(shape, np.uint16),
    )
    lobe = np.concatenate([around(1.0, 3, spread=0.01), around(30.0, 1)], axis=-1)
    maps = ReflectanceMaps(around(0.2, 3), around(0.05, 3), lobe, quality)
    slope = np.full(shape, np.float32(sigma_mm / 0.5))
    return dataclasses.replace(copy, height_field=field, slope_sigma=slope, reflectance=maps)


@pytest.mark.parametrize("sigma_mm", [1e-4, 1e-3, 0.01, 0.3])
def test_what_rounding_adds_is_far_below_the_errors(sigma_mm):
    copy = measured(sigma_mm)
    rounded = MapRounding.of(copy).applied(copy)
    off = rounded.height_field.height - copy.height_field.height
    assert 0 < off.std() < 0.11 * sigma_mm
    assert abs(off.mean()) < 0.01 * sigma_mm
    tilt = rounded.normal_xy - copy.normal_xy
    assert 0 < tilt.std() < 0.21 * copy.slope_sigma[0, 0]


def test_reflectance_keeps_as_many_bits_as_are_known():
    copy = measured()
    rounding = MapRounding.of(copy)
    assert (rounding.diffuse_bits, rounding.specular_bits, rounding.k_bits) == (8, 6, 6)
    maps, rounded = copy.reflectance, rounding.applied(copy).reflectance
    for name, bits in (("diffuse", 8), ("specular", 6)):
        ratio = getattr(rounded, name) / getattr(maps, name)
        assert 0 < np.abs(ratio - 1).max() <= 2.0**-bits
    # A lobe's directions are raised to the power of k.
    np.testing.assert_array_equal(rounded.lobe[..., :3], maps.lobe[..., :3])
    np.testing.assert_array_equal(rounded.quality.samples, maps.quality.samples)
    np.testing.assert_allclose(rounded.quality.residual, maps.quality.residual, rtol=2.0**-4)


def test_rounding_again_changes_nothing():
    copy = measured()
    rounding = MapRounding.of(copy)
    once = rounding.applied(copy)
    twice = rounding.applied(once)
    np.testing.assert_array_equal(twice.height_field.height, once.height_field.height)
    np.testing.assert_array_equal(twice.reflectance.diffuse, once.reflectance.diffuse)
    np.testing.assert_array_equal(twice.normal_xy, once.normal_xy)


def test_no_normal_becomes_longer_than_one():
    copy = measured(0.3)
    angle = np.linspace(0, 2 * np.pi, 120 * 160).reshape(120, 160)
    flat = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32) * 0.9999
    rounded = MapRounding.of(copy).applied(dataclasses.replace(copy, normal_xy=flat))
    assert (rounded.normal_xy**2).sum(axis=-1).max() <= 1


def test_a_copy_without_errors_keeps_its_heights():
    copy = make_copy(strokes())
    field = copy.height_field
    known = dataclasses.replace(
        copy,
        height_field=dataclasses.replace(field, variance=np.zeros_like(field.variance)),
        slope_sigma=np.zeros_like(copy.slope_sigma),
    )
    rounding = MapRounding.of(known)
    assert (rounding.height_mm, rounding.normal) == (0, 0)
    np.testing.assert_array_equal(rounding.applied(known).height_field.height, field.height)


def test_files_are_smaller_and_the_switch_keeps_every_bit(tmp_path):
    copy = measured()
    write_copy(copy, tmp_path / "rounded")
    write_copy(copy, tmp_path / "exact", exact_maps=True)
    sizes = {
        name: sum(file.stat().st_size for file in (tmp_path / name).iterdir())
        for name in ("rounded", "exact")
    }
    assert sizes["rounded"] < 0.7 * sizes["exact"]
    loaded = read_copy(tmp_path / "exact").height_field.height
    np.testing.assert_array_equal(loaded, copy.height_field.height)
    rounded = MapRounding.of(copy).applied(copy)
    again = read_copy(tmp_path / "rounded")
    np.testing.assert_array_equal(again.height_field.height, rounded.height_field.height)
    np.testing.assert_array_equal(again.reflectance.specular, rounded.reflectance.specular)


@pytest.mark.parametrize(("raised_mm", "kind"), [(0.0, "float16"), (900.0, "float32")])
def test_heights_take_half_the_room_where_that_holds_them(tmp_path, raised_mm, kind):
    copy = measured()
    field = copy.height_field
    raised = dataclasses.replace(field, height=field.height + np.float32(raised_mm))
    tall = dataclasses.replace(copy, height_field=raised)
    write_copy(tall, tmp_path / "copy")
    with OpenEXR.File(str(tmp_path / "copy" / "relief.exr"), separate_channels=True) as file:
        assert file.channels()["height"].pixels.dtype == kind
    rounded = MapRounding.of(tall).applied(tall).height_field.height
    loaded = read_copy(tmp_path / "copy").height_field.height
    assert loaded.dtype == np.float32
    np.testing.assert_array_equal(loaded, rounded)


def test_rounding_by_hand():
    values = np.array([0.0, 0.26, -0.26, 100.1], np.float32)
    assert multiples(values, 0.25).tolist() == [0.0, 0.25, -0.25, 100.0]
    assert significant(np.array([0.0, 1.0, -1.1, 130.0], np.float32), 3).tolist() == [
        *(0.0, 1.0, -1.0, 128.0)
    ]
