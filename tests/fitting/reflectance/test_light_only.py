from __future__ import annotations

import cv2
import numpy as np
import pytest

from fitting.errors import FittingError
from fitting.reflectance.back_projection import PhotographSampler, Tile
from fitting.reflectance.light_only import read_light_only
from fitting.reflectance.terrain import Terrain

DIRECTIONS = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, -0.6, 0.8], [-0.48, 0.36, 0.8]])
ALBEDO = np.array([0.2, 0.5, 0.8])


def write_dome(folder, *, kind=np.uint16, shape=(12, 20)):
    lines = [str(len(DIRECTIONS))]
    for number, direction in enumerate(DIRECTIONS):
        linear = np.ones((*shape, 1)) * ALBEDO * direction[2]
        linear[3, 5] = 1.0
        if kind is np.uint8:
            linear = np.where(
                linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055
            )
        full = np.iinfo(kind).max
        picture = np.minimum(np.rint(linear * full), full).astype(kind)
        cv2.imwrite(str(folder / f"{number}.png"), picture[..., ::-1])
        lines.append(f"{number}.png " + " ".join(f"{x:.6f}" for x in direction))
    (folder / "lights.lp").write_text("\n".join(lines) + "\n")
    return folder / "lights.lp"


@pytest.mark.parametrize(("kind", "error"), [(np.uint16, 1e-4), (np.uint8, 5e-3)])
def test_a_texel_is_a_pixel_and_its_reflectance_that_of_the_pictures(tmp_path, kind, error):
    copy, photographs = read_light_only(write_dome(tmp_path, kind=kind))
    assert copy.height_field.shape == (12, 20)
    sampler = PhotographSampler(copy, photographs, Terrain.of(copy.height_field))
    samples = sampler.samples(Tile((0, 12), (0, 20)))
    valid = samples.valid.all(axis=1).reshape(12, 20)
    assert not valid[3, 5]  # saturated
    assert valid.sum() >= 12 * 20 - 9
    inside = valid.ravel()
    expected = ALBEDO / np.pi * DIRECTIONS[:, 2:]
    assert samples.radiance[inside] == pytest.approx(
        np.broadcast_to(expected, (inside.sum(), 4, 3)), abs=error
    )
    assert samples.light[inside] == pytest.approx(
        np.broadcast_to(DIRECTIONS, (inside.sum(), 4, 3)), abs=1e-4
    )
    assert samples.view[inside][..., 2].min() > 0.9999


def test_pictures_lie_on_disk_and_grey_ones_say_no_more_than_one_channel(tmp_path):
    _, photographs = read_light_only(write_dome(tmp_path))
    assert all(isinstance(photograph.variance, np.memmap) for photograph in photographs)
    for number in range(len(DIRECTIONS)):
        picture = cv2.imread(str(tmp_path / f"{number}.png"), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture[..., 1])
    _, grey = read_light_only(tmp_path / "lights.lp")
    for own, other in zip(grey, photographs, strict=True):
        for channel in range(3):
            assert np.array_equal(own.radiance[5:, :, channel], other.radiance[5:, :, 1])
            assert own.variance[..., channel] == pytest.approx(3 * other.variance[..., 1])


@pytest.mark.parametrize("scale", [1e-4, 1.0, 3e5])
def test_noise_of_floating_point_goes_by_what_is_white_in_all_pictures(tmp_path, scale):
    path = write_dome(tmp_path)
    lines = path.read_text().replace(".png", ".tiff")
    path.write_text(lines)
    for number, direction in enumerate(DIRECTIONS):
        linear = np.ones((12, 20, 1)) * ALBEDO * direction[2]
        linear[3, 5] = np.nan
        picture = np.asarray(scale * linear, np.float32)
        exactly = [cv2.IMWRITE_TIFF_COMPRESSION, 1]
        cv2.imwrite(str(tmp_path / f"{number}.tiff"), picture[..., ::-1], exactly)
    _, photographs = read_light_only(path)
    white = scale * ALBEDO.max()
    for own, direction in zip(photographs, DIRECTIONS, strict=True):
        radiance = scale * ALBEDO * direction[2]
        assert own.radiance[0, 0] == pytest.approx(radiance)
        assert np.isnan(own.radiance[3, 5]).all()
        variance = (2e-4 * white) ** 2 + 5e-5 * white * radiance
        assert own.variance[0, 0] == pytest.approx(variance, rel=1e-5)
        assert np.isfinite(own.variance).all()


def test_pictures_of_different_sizes_or_none_are_refused(tmp_path):
    path = write_dome(tmp_path)
    cv2.imwrite(str(tmp_path / "2.png"), np.zeros((5, 5, 3), np.uint16))
    with pytest.raises(FittingError, match=r"5 × 5 pixels"):
        read_light_only(path)
    (tmp_path / "2.png").write_bytes(b"no picture")
    with pytest.raises(FittingError, match="readable"):
        read_light_only(path)
