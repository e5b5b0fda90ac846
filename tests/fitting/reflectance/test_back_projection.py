from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from photographed_relief import COLS, ROWS, lamp, lens, photograph, pose_looking_at_origin
from synthetic_copy import make_copy, strokes

from calibration.lens import Lens, transform
from devices.bayer import BayerPattern
from fitting.errors import FittingError
from fitting.reflectance.back_projection import PhotographSampler, SamplingOptions, Tile
from fitting.reflectance.ray_kernels import BLOCKED
from fitting.reflectance.samples import local_frames
from fitting.reflectance.terrain import Terrain

EYES = [(-20.0, 10.0, 300.0), (150.0, 0.0, 260.0)]
# Radiance of a picture that varies evenly, by pixel: its interpolation must be exact.
SLOPE = np.array([[2e-3, 1e-3, -5e-4], [1e-3, -1e-3, 2e-3]])


def ramp(rows=ROWS, cols=COLS):
    col, row = np.meshgrid(np.arange(cols), np.arange(rows))
    return (0.5 + np.stack([col, row], -1) @ SLOPE).astype(np.float32)


def sampled(copy, photographs, **options):
    terrain = Terrain.of(copy.height_field)
    sampler = PhotographSampler(copy, photographs, terrain, SamplingOptions(**options))
    rows, cols = copy.height_field.shape
    return sampler, sampler.samples(Tile((0, rows), (0, cols)))


def texel_points(copy):
    field = copy.height_field
    x, y = np.meshgrid(field.texel_x_mm(), field.texel_y_mm())
    points = np.stack([x, y, field.height], axis=-1).astype(float)[field.mask]
    flat = copy.normal_xy[field.mask].astype(float)
    up = np.sqrt(1 - np.sum(flat**2, axis=1, keepdims=True))
    return points, np.hstack([flat, up])


def mosaic_of(image, pattern):
    channels = {"R": 0, "G": 1, "B": 2}
    mosaic = np.empty(image.shape[:2], np.float32)
    for place, letter in enumerate(pattern.value):
        row, col = divmod(place, 2)
        mosaic[row::2, col::2] = image[row::2, col::2, channels[letter]]
    return mosaic


@pytest.mark.parametrize("pitch", [0.05, 0.3])
@pytest.mark.parametrize("mosaic", [None, *BayerPattern])
def test_an_even_picture_is_looked_up_where_the_texel_is(pitch, mosaic):
    copy = make_copy(strokes(40, 50) * 0.1, pitch=pitch)
    image = ramp()
    if mosaic is not None:
        image = mosaic_of(image, mosaic)
    taken = photograph(EYES[1], image=image, mosaic=mosaic)
    _, samples = sampled(copy, [taken], penumbra_px=0.0)
    points, _ = texel_points(copy)
    pixels = taken.lens.project(transform(taken.rt_cam_canvas, points))
    expected = (0.5 + pixels @ SLOPE) / taken.lamp.irradiance(points)
    valid = samples.weight[:, 0] > 0
    assert valid.mean() > 0.8
    off = (samples.radiance[:, 0] - expected)[valid] * taken.lamp.irradiance(points)[valid]
    # A texel larger than a pixel is a mean over whole pixels, which are not quite even about it.
    assert np.abs(off).max() < (3e-6 if pitch == 0.05 or mosaic is None else 3e-4)


def test_directions_are_those_of_the_texel_s_frame():
    copy = make_copy(strokes())
    taken = photograph(EYES[1])
    _, samples = sampled(copy, [taken])
    points, normals = texel_points(copy)
    frames = local_frames(normals)
    towards = taken.lamp.position - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    assert samples.light[:, 0] == pytest.approx(np.einsum("nij,nj->ni", frames, towards), abs=1e-6)
    towards = np.array(EYES[1]) - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    assert samples.view[:, 0] == pytest.approx(np.einsum("nij,nj->ni", frames, towards), abs=1e-6)


def test_exposure_and_flat_field_are_divided_out():
    copy = make_copy(np.zeros((40, 50)), pitch=0.3)
    col, row = np.meshgrid(np.arange(COLS), np.arange(ROWS))
    flat = (1 - 0.3 * np.hypot(col - 60, row - 45) / 75).astype(np.float32)
    plain = photograph(image=ramp())
    dimmed = photograph(
        image=ramp() * flat[..., None] * 0.25,
        variance=np.full((ROWS, COLS, 3), 1e-6, np.float32) * flat[..., None] ** 2 / 16,
        exposure=0.25,
        flat_field=flat,
    )
    _, samples = sampled(copy, [plain, dimmed])
    valid = samples.valid.all(axis=1)
    assert valid.mean() > 0.9
    for name in ("radiance", "variance"):
        one, other = getattr(samples, name)[valid].swapaxes(0, 1)
        assert other == pytest.approx(one, rel=1e-5)


@pytest.mark.parametrize("mosaic", [None, BayerPattern.RGGB])
@pytest.mark.parametrize("pitch", [0.1, 0.5, 1.2])
def test_the_variance_is_that_of_the_samples(pitch, mosaic):
    copy = make_copy(np.zeros((30, 30)), pitch=pitch)
    random = np.random.default_rng(2)
    shape = (ROWS, COLS) if mosaic else (ROWS, COLS, 3)
    variance = np.full(shape, 4e-4, np.float32)
    noisy = [
        photograph(
            image=0.3 + 0.02 * random.standard_normal(shape),
            variance=variance,
            mosaic=mosaic,
        )
        for _ in range(300)
    ]
    _, samples = sampled(copy, noisy)
    valid = samples.valid.all(axis=1)
    assert valid.mean() > 0.5
    ratio = samples.radiance[valid].var(axis=1) / samples.variance[valid, 0]
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.03)
    # More pixels, less noise.
    assert np.median(samples.variance[valid, 0] * noisy[0].lamp.irradiance(np.zeros(3)) ** 2) < 4e-4


def test_saturated_and_clipped_colours_are_dropped_with_all_that_reach_them():
    copy = make_copy(np.zeros((30, 40)), pitch=0.5)
    image = ramp()
    image[40, 60, 1] = np.nan
    _, samples = sampled(copy, [photograph(image=image)])
    points, _ = texel_points(copy)
    pixels = lens().project(transform(pose_looking_at_origin(EYES[0]), points))
    reached = (np.abs(pixels - [60, 40]) < 1.0).all(axis=1)
    assert 1 <= reached.sum() <= 8
    assert not samples.valid[reached].any()
    assert samples.valid[~(np.abs(pixels - [60, 40]) < 1.5).all(axis=1)].all()
    assert np.isfinite(samples.radiance).all()


def test_shadows_and_their_edges_are_dropped():
    copy = make_copy(strokes())
    low = photograph(light=lamp(20, 60))
    sharp, without = sampled(copy, [low], penumbra_px=0.0)
    _, margined = sampled(copy, [low], penumbra_px=2.0)
    points, _ = texel_points(copy)
    blocked = (
        Terrain.of(copy.height_field).findings(points, low.lamp.position, clearance_mm=2e-3)
        == BLOCKED
    )
    assert blocked.sum() > 200
    assert sharp.rays.tested == 2 * blocked.size
    assert not without.valid[blocked].any()
    dark = blocked.reshape(copy.height_field.shape)
    reach = 2  # two pixels of half a millimetre are two texels
    near = np.zeros_like(dark)
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            if np.hypot(down, right) <= reach:
                near |= np.roll(dark, (down, right), (0, 1))
    inner = np.zeros_like(dark)
    inner[4:-4, 4:-4] = True
    assert not margined.valid[(near & inner).ravel()].any()
    assert margined.valid.sum() > 0.5 * without.valid.sum()


class LensBlindOfOne(Lens):
    """A lens that says nothing of the first point it is asked for."""

    def project_with_gradient(self, points):
        pixels, gradient = super().project_with_gradient(points)
        gradient[0] = np.nan
        return pixels, gradient


def test_one_texel_without_a_size_leaves_the_margin_of_shadows_alone():
    copy = make_copy(strokes())
    low = photograph(light=lamp(20, 60))
    own = low.lens
    blind = LensBlindOfOne(own.model, own.intrinsics, own.width, own.height)
    _, clear = sampled(copy, [low], penumbra_px=2.0)
    _, other = sampled(copy, [dataclasses.replace(low, lens=blind)], penumbra_px=2.0)
    assert clear.valid.sum() > 1000
    assert np.array_equal(other.valid[1:], clear.valid[1:])
    assert not other.valid[0].any()


def test_tiles_join_without_a_seam():
    mask = np.ones((120, 160), bool)
    mask[30:50, 60:90] = False
    copy = make_copy(strokes(), mask=mask)
    photographs = [photograph(eye, lamp(25, a), image=ramp()) for eye in EYES for a in (0, 100)]
    _, whole = sampled(copy, photographs, penumbra_px=2.0)
    options = SamplingOptions(penumbra_px=2.0, tile_bytes=4 * 160 * 900)
    sampler = PhotographSampler(copy, photographs, Terrain.of(copy.height_field), options)
    tiles = list(sampler.tiles())
    assert len(tiles) > 12
    index = np.full(mask.shape, -1)
    index[mask] = np.arange(mask.sum())
    for tile in tiles:
        part = sampler.samples(tile)
        there = index[tile.slices][mask[tile.slices]]
        for field in dataclasses.fields(part):
            assert np.array_equal(getattr(part, field.name), getattr(whole, field.name)[there])


def test_more_photographs_make_smaller_tiles():
    copy = make_copy(np.zeros((600, 600)))
    terrain = Terrain.of(copy.height_field)
    options = SamplingOptions(tile_bytes=2**24)

    def largest(count):
        sampler = PhotographSampler(copy, [photograph()] * count, terrain, options)
        return max(np.prod(tile.shape) * count for tile in sampler.tiles())

    assert largest(200) <= largest(2) <= 2**24 / 160


def test_the_other_side_and_beyond_the_picture_give_no_sample():
    copy = make_copy(np.zeros((120, 160)), pitch=1.0)
    behind = dataclasses.replace(lamp(50, 30), position=np.array([0, 0, -300.0]))
    _, samples = sampled(copy, [photograph(), photograph(light=behind)])
    assert 0.05 < samples.valid[:, 0].mean() < 0.9
    assert not samples.valid[:, 1].any()


def test_photographs_that_contradict_themselves_are_refused():
    with pytest.raises(FittingError, match="variance"):
        photograph(variance=np.zeros((3, 3, 3), np.float32))
    with pytest.raises(FittingError, match="rows, cols"):
        photograph(mosaic=BayerPattern.RGGB)
    with pytest.raises(FittingError, match="flat field"):
        photograph(flat_field=np.ones((4, 4), np.float32))
    for wrong in (0.0, -0.5, np.nan, np.inf):
        flat = np.ones((ROWS, COLS), np.float32)
        flat[3, 4] = wrong
        with pytest.raises(FittingError, match="in 1 of 10800 pixels"):
            photograph(flat_field=flat)
    with pytest.raises(FittingError, match="exposure"):
        photograph(exposure=0.0)
    with pytest.raises(FittingError, match="six finite"):
        photograph(rt_cam_canvas=np.full(6, np.nan))
    with pytest.raises(FittingError, match="photographs"):
        copy = make_copy(np.zeros((20, 20)))
        PhotographSampler(copy, [], Terrain.of(copy.height_field))
