from __future__ import annotations

import dataclasses
import json

import numpy as np
import OpenEXR
import pytest
from full_disk import largest_file
from synthetic_copy import make_copy, strokes

from fitting.copy_files import check_destination, read_copy, write_copy
from fitting.digital_copy import DigitalCopy, ReflectanceMaps, ReflectanceQuality
from fitting.errors import CopyError, FittingError
from fitting.height_field import HeightField
from fitting.relief_classification import ReliefOptions, classify_relief


@pytest.fixture
def copy():
    mask = np.ones((120, 160), bool)
    mask[50:55, 60:70] = False
    return make_copy(strokes(), mask=mask)


def test_relief_by_hand():
    height = np.zeros((23, 31), np.float32)
    height[2:7, 3:8] = 1.0
    height[4, 5] = 1.5
    height[15, 20] = 5.0  # a speck
    height[18:23, 27:31] = 0.9
    relief = make_copy(height, pitch=1.0, cell=10, delta0_mm=0.5, smallest_mm2=4.0).relief
    assert relief.significant.sum() == 25 + 20
    assert relief.boxes.corner.tolist() == [[0, 0], [10, 20], [10, 30], [20, 20], [20, 30]]
    assert relief.boxes.size.tolist() == [[10, 10], [10, 10], [10, 1], [3, 10], [3, 1]]
    assert relief.boxes.h_max[0] == np.float32(1.5)
    assert relief.boxes.peak[0].tolist() == [4, 5]
    assert relief.boxes.h_max[1] == np.float32(5.0)  # the highest of the cell, speck or not


def test_noise_does_not_become_relief():
    random = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(300) * 0.15, np.arange(300) * 0.15)
    blister = 0.4 * np.exp(-(((x - 20) / 2.5) ** 2) - ((y - 25) / 6) ** 2)
    noisy = (blister + random.normal(0, 0.11, x.shape)).astype(np.float32)
    field = make_copy(noisy, pitch=0.15).height_field
    field = dataclasses.replace(field, variance=np.full(x.shape, 0.0121, np.float32))
    relief = classify_relief(field, ReliefOptions())
    assert 0.08 < relief.delta0_mm < 0.2
    assert relief.significant[blister > 0.25].mean() > 0.97
    assert relief.significant[blister < 0.02].mean() < 0.002


def test_a_flat_copy_has_no_boxes():
    relief = make_copy(np.zeros((20, 30))).relief
    assert len(relief.boxes) == 0
    assert relief.delta0_mm == 0


@pytest.mark.parametrize("with_reflectance", [False, True])
def test_a_copy_survives_the_disk(copy, tmp_path, with_reflectance):
    if with_reflectance:
        random = np.random.default_rng(0)
        maps = ReflectanceMaps(
            *(
                random.uniform(0, 2, (120, 160, n)).astype(np.float16).astype(np.float32)
                for n in (3, 3, 4)
            )
        )
        copy = dataclasses.replace(copy, reflectance=maps, provenance={"software": "test"})
    write_copy(copy, tmp_path / "copy", exact_maps=True)
    loaded = read_copy(tmp_path / "copy")
    np.testing.assert_array_equal(loaded.height_field.height, copy.height_field.height)
    np.testing.assert_array_equal(loaded.height_field.mask, copy.height_field.mask)
    np.testing.assert_allclose(loaded.height_field.variance, copy.height_field.variance, rtol=2e-3)
    np.testing.assert_allclose(loaded.normal_xy, copy.normal_xy, atol=5e-4)
    np.testing.assert_array_equal(loaded.relief.significant, copy.relief.significant)
    np.testing.assert_array_equal(loaded.relief.boxes.peak, copy.relief.boxes.peak)
    assert loaded.provenance == copy.provenance
    assert loaded.height_field.origin_mm == copy.height_field.origin_mm
    if with_reflectance:
        np.testing.assert_array_equal(loaded.reflectance.lobe, copy.reflectance.lobe)
    with pytest.raises(CopyError, match="exists already"):
        write_copy(copy, tmp_path / "copy")
    write_copy(copy, tmp_path / "copy", replace=True)
    assert [p.name for p in tmp_path.iterdir()] == ["copy"]


def spoil_height(folder):
    with OpenEXR.File(str(folder / "relief.exr"), separate_channels=True) as file:
        channels = {name: np.array(c.pixels) for name, c in file.channels().items()}
    channels["height"][10, 10] = np.nan
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, channels).write(
        str(folder / "relief.exr")
    )


def empty_mask(folder):
    with OpenEXR.File(str(folder / "relief.exr"), separate_channels=True) as file:
        channels = {name: np.array(c.pixels) for name, c in file.channels().items()}
    channels["mask"][:] = 0
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, channels).write(
        str(folder / "relief.exr")
    )


def truncate(folder):
    content = (folder / "relief.exr").read_bytes()
    (folder / "relief.exr").write_bytes(content[: len(content) // 2])


def drop_key(folder):
    header = json.loads((folder / "copy.json").read_text())
    del header["pitch_mm"]
    (folder / "copy.json").write_text(json.dumps(header))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (spoil_height, "1 measured texels of the height field are not finite"),
        (empty_mask, "canvas is empty"),
        (truncate, r"relief\.exr: truncated"),
        (drop_key, "pitch_mm"),
        (lambda f: (f / "uncertainty.exr").unlink(), r"uncertainty\.exr is missing"),
        (lambda f: (f / "copy.json").write_text("{"), r"copy\.json: not JSON"),
        (lambda f: (f / "copy.json").write_text("{}"), "format None"),
        (lambda f: (f / "copy.json").unlink(), "not a digital copy"),
    ],
)
def test_damaged_copies_are_refused_by_name(copy, tmp_path, damage, message):
    write_copy(copy, tmp_path / "copy")
    damage(tmp_path / "copy")
    with pytest.raises(CopyError, match=message):
        read_copy(tmp_path / "copy")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("delta0_mm", float("nan")),
        ("proposed_delta0_mm", "high"),
        ("origin_mm", [0.0, float("inf")]),
        ("rt_cam_canvas", [0.0, 0.0]),
        ("unresolved_mm", -1.0),
        ("cell", 0),
        ("provenance", "a museum"),
        ("corner", [[2**31 - 1, 0]]),
        ("size", [[0, 5]]),
        ("peak", [[5, 160]]),
        ("h_max", [float("nan")]),
    ],
)
def test_numbers_that_no_copy_can_have_are_refused_by_name(copy, tmp_path, name, value):
    write_copy(copy, tmp_path / "copy")
    header = json.loads((tmp_path / "copy" / "copy.json").read_text())
    if name in header["boxes"]:
        header["boxes"][name][: len(value)] = value
        name = "boxes"
    else:
        header[name] = value
    (tmp_path / "copy" / "copy.json").write_text(json.dumps(header))
    with pytest.raises(CopyError, match=f"{name} cannot be that of a copy of 160 × 120 texels"):
        read_copy(tmp_path / "copy")


def test_a_header_without_end_is_no_copy_and_a_file_neither(tmp_path):
    (tmp_path / "copy.json").write_text("[" * 100_000)
    with pytest.raises(CopyError, match="not JSON"):
        read_copy(tmp_path)
    with pytest.raises(CopyError, match="not a digital copy"):
        read_copy(tmp_path / "copy.json")


@pytest.mark.parametrize("missing", [1, 20_000])
def test_a_disk_that_is_full_leaves_no_copy(copy, tmp_path, missing):
    write_copy(copy, tmp_path / "copy")
    largest = max(file.stat().st_size for file in (tmp_path / "copy").iterdir())
    refused = pytest.raises(OSError, match=r"exr.*is the disk full")
    with refused, largest_file(largest - missing):
        write_copy(copy, tmp_path / "second")
    assert [file.name for file in tmp_path.iterdir()] == ["copy"]


def test_height_fields_refuse_what_is_no_height(copy):
    field = copy.height_field
    heights = field.height.copy()
    heights[0, 0] = np.inf
    for change, message in (
        ({"height": heights}, "row 0, column 0"),
        ({"mask": np.zeros(field.shape, bool)}, "empty"),
        ({"pitch_mm": 0.0}, "pitch"),
        ({"variance": field.variance[1:]}, "differ in shape"),
    ):
        with pytest.raises(FittingError, match=message):
            dataclasses.replace(field, **change)
    assert isinstance(field, HeightField)


def with_quality(copy: DigitalCopy) -> DigitalCopy:
    random = np.random.default_rng(3)
    shape = copy.height_field.shape

    def triple() -> np.ndarray:
        return random.random((*shape, 3)).astype(np.float32)

    quality = ReflectanceQuality(
        *(triple() for _ in range(3)),
        random.random(shape).astype(np.float32),
        random.integers(0, 400, shape).astype(np.uint16),
        random.integers(0, 512, shape).astype(np.uint16),
    )
    lobe = random.uniform(0.5, 200, (*shape, 4)).astype(np.float32)
    return dataclasses.replace(copy, reflectance=ReflectanceMaps(triple(), triple(), lobe, quality))


def test_what_is_known_of_the_reflectance_survives_the_disk(copy, tmp_path):
    copy = with_quality(copy)
    write_copy(copy, tmp_path / "copy", exact_maps=True)
    again = read_copy(tmp_path / "copy").reflectance.quality
    for name, array in copy.reflectance.quality.arrays.items():
        other = getattr(again, name)
        assert other.dtype == array.dtype
        assert other == pytest.approx(array, rel=1e-3, abs=1e-6)


def test_a_copy_of_before_has_reflectance_of_unknown_quality(copy, tmp_path):
    write_copy(with_quality(copy), tmp_path / "copy")
    header = json.loads((tmp_path / "copy" / "copy.json").read_text())
    del header["reflectance_quality"]
    (tmp_path / "copy" / "copy.json").write_text(json.dumps(header))
    (tmp_path / "copy" / "reflectance-quality.exr").unlink()
    assert read_copy(tmp_path / "copy").reflectance.quality is None


def test_radiance_on_a_wild_scale_is_refused_and_nothing_written(copy, tmp_path):
    copy = with_quality(copy)
    wild = dataclasses.replace(copy.reflectance, diffuse=copy.reflectance.diffuse * 1e6)
    with pytest.raises(CopyError, match="white reference"):
        write_copy(dataclasses.replace(copy, reflectance=wild), tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


def test_standard_errors_beyond_half_floats_stay_finite(copy, tmp_path):
    copy = with_quality(copy)
    copy.reflectance.quality.specular_sigma[3, 4] = 1e20
    write_copy(copy, tmp_path / "copy")
    again = read_copy(tmp_path / "copy").reflectance.quality
    assert np.isfinite(again.specular_sigma).all()
    assert again.specular_sigma[3, 4].min() > 6e4


@pytest.mark.parametrize("header", ['{"format": "of another program"}', "{torn", "[]"])
def test_a_folder_with_somebody_else_s_copy_json_is_kept(tmp_path, header):
    (tmp_path / "copy.json").write_text(header)
    with pytest.raises(CopyError, match="exists already"):
        check_destination(tmp_path, replace=True)
