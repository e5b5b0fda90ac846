from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from photographed_relief import lamp, photograph
from synthetic_copy import make_copy, strokes

from fitting.copy_files import read_copy, write_copy
from fitting.digital_copy import ReflectanceMaps
from fitting.errors import FittingError
from fitting.reflectance.back_projection import PhotographSampler, SamplingOptions
from fitting.reflectance.clusters import ClusterOptions
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.held_out import Relighting, compare_held_out, pooled_psnr_db
from fitting.reflectance.lobe import LafortuneLobes
from fitting.reflectance.maps import MapOptions, fit_maps
from fitting.reflectance.relighting_kernels import relight
from fitting.reflectance.samples import local_frames
from fitting.reflectance.terrain import Terrain

EYES = [(-20.0, 10.0, 300.0), (150.0, 0.0, 260.0), (0.0, -140.0, 265.0)]
LAMPS = [lamp(e, 37 * i) for i, e in enumerate(np.linspace(20, 80, 11))]
OPTIONS = MapOptions(clusters=ClusterOptions(most=2, survey=240, per_material=80, fewest=60))


def painted(rows=60, cols=80):
    """A relief of two paints: matt blue to the left, glossy ochre to the right."""
    copy = make_copy(0.6 * strokes(rows, cols), pitch=0.5)
    right = np.arange(cols)[np.newaxis, :, np.newaxis] >= cols // 2
    shape = (rows, cols, 1)
    diffuse = np.where(right, [0.18, 0.12, 0.03], [0.03, 0.05, 0.15]) * np.ones(shape)
    specular = np.where(right, [0.3, 0.3, 0.3], [0.0, 0.0, 0.0]) * np.ones(shape)
    lobe = np.where(right, [-1.0, -1.0, 1.0, 40.0], [-1.0, -1.0, 1.0, 40.0]) * np.ones(shape)
    maps = (diffuse, specular, lobe)
    return dataclasses.replace(copy, reflectance=ReflectanceMaps(*(np.float32(m) for m in maps)))


def photographs_of(copy, terrain, eyes, lamps, seed=0):
    """What the camera would see of a copy, with noise."""
    random = np.random.default_rng(seed)
    taken = []
    for eye in eyes:
        place = Relighting(copy, terrain, photograph(eye))
        for light in lamps:
            # Nothing is known beyond the canvas.
            image = place.rendered(photograph(eye, light))
            variance = 1e-6 + 2e-5 * np.nan_to_num(image)
            noisy = image + np.sqrt(variance) * random.standard_normal(image.shape)
            variance = variance.astype(np.float32)
            taken.append(photograph(eye, light, image=noisy, variance=variance))
    return taken


@pytest.fixture(scope="module")
def fitted():
    truth = painted()
    terrain = Terrain.of(truth.height_field)
    taken = photographs_of(truth, terrain, EYES, LAMPS)
    bare = dataclasses.replace(truth, reflectance=None)
    sampler = PhotographSampler(bare, taken, terrain, SamplingOptions(tile_bytes=2**24))
    return truth, terrain, bare, fit_maps(sampler, options=OPTIONS)


def test_materials_are_learned_from_the_photographs_that_are_surveyed():
    truth = painted(24, 32)
    terrain = Terrain.of(truth.height_field)
    taken = photographs_of(truth, terrain, EYES[:2], LAMPS[::2])
    bare = dataclasses.replace(truth, reflectance=None)
    every, some = (PhotographSampler(bare, some, terrain) for some in (taken, taken[::2]))
    clusters = ClusterOptions(most=1, survey=120, per_material=60, fewest=60)
    options = MapOptions(clusters=clusters, refine_normals=False)
    found = fit_maps(every, options=options, surveyed=some)
    alone = fit_maps(some, options=options)
    assert found.palette.colour_unit == alone.palette.colour_unit
    for own, other in zip(found.palette.materials, alone.palette.materials, strict=True):
        assert np.array_equal(own.shape_mean, other.shape_mean)
    # All the same, texels are fitted to all photographs.
    assert found.maps.quality.samples.max() == len(taken)
    assert alone.maps.quality.samples.max() == len(taken) // 2


def inner(copy):
    area = np.zeros(copy.height_field.shape, bool)
    area[4:-4, 4:-4] = True
    half = area.shape[1] // 2
    area[:, half - 2 : half + 2] = False
    return area


def test_two_paints_are_recovered(fitted):
    truth, _, _, result = fitted
    maps, area = result.maps, inner(truth)
    off = np.abs(maps.diffuse - truth.reflectance.diffuse)[area] / truth.reflectance.diffuse[area]
    assert np.median(off) < 0.01
    assert np.percentile(off, 95) < 0.08
    right = area & (np.arange(area.shape[1]) >= area.shape[1] // 2)
    assert np.median(maps.lobe[right][:, 3]) == pytest.approx(40, rel=0.05)
    assert np.median(maps.specular[right]) == pytest.approx(0.3, rel=0.05)
    left = area & ~right
    assert np.mean(maps.specular[left].max(axis=1) < 0.03) > 0.97
    assert np.mean((maps.quality.flags[left] & int(TexelFlag.DIFFUSE)) != 0) > 0.9


def test_every_map_is_finite_and_samples_are_counted(fitted, tmp_path):
    _, _, bare, result = fitted
    for array in (result.maps.diffuse, result.maps.lobe, *result.maps.quality.arrays.values()):
        assert np.isfinite(array).all()
    assert result.maps.quality.samples.max() <= len(EYES) * len(LAMPS)
    assert np.median(result.maps.quality.samples) > 25
    assert 0 < np.median(result.maps.quality.residual) < 0.01
    write_copy(result.added_to(bare), tmp_path / "copy")
    assert read_copy(tmp_path / "copy").reflectance.quality is not None


def test_a_photograph_that_the_fit_has_not_seen_is_foretold(fitted):
    truth, terrain, bare, result = fitted
    new = photographs_of(truth, terrain, [(60.0, 70.0, 280.0)], [lamp(38, 200), lamp(60, 77)], 7)
    compared = compare_held_out(result.added_to(bare), terrain, new)
    assert pooled_psnr_db(compared) > 38
    assert max(one.mean_delta_e for one in compared) < 1.0


def test_wrong_normals_are_told_by_the_photographs(fitted):
    truth, terrain, bare, _ = fitted
    random = np.random.default_rng(4)
    wrong = bare.normal_xy + random.normal(0, 0.06, bare.normal_xy.shape).astype(np.float32)
    slope = np.full_like(bare.slope_sigma, 0.06)
    doubtful = dataclasses.replace(bare, normal_xy=np.clip(wrong, -0.7, 0.7), slope_sigma=slope)
    taken = photographs_of(truth, terrain, EYES, LAMPS[::2], 3)
    sampler = PhotographSampler(doubtful, taken, terrain, SamplingOptions(tile_bytes=2**24))
    result = fit_maps(sampler, options=OPTIONS)
    area = inner(truth)
    before = np.abs(doubtful.normal_xy - truth.normal_xy)[area]
    after = np.abs(result.normal_xy - truth.normal_xy)[area]
    assert np.median(after) < 0.2 * np.median(before)
    assert np.median(result.slope_sigma[area]) < 0.02


def test_gaps_and_places_in_shadow_take_their_neighbours_lobes_and_say_so():
    truth = painted(40, 40)
    mask = np.ones((40, 40), bool)
    mask[10:14, 20:26] = False
    gapped = make_copy(truth.height_field.height, pitch=0.5, mask=mask)
    terrain = Terrain.of(truth.height_field)
    taken = photographs_of(truth, terrain, EYES[:1], LAMPS[3:6])
    for one in taken:
        one.radiance[40:46, 50:60] = np.nan  # a blinded patch
    sampler = PhotographSampler(gapped, taken, terrain)
    result = fit_maps(sampler, options=OPTIONS)
    none = (result.maps.quality.flags & int(TexelFlag.NO_SAMPLES)) != 0
    assert none[~mask].all()
    assert none[mask].sum() > 10
    assert (result.maps.quality.samples[none] == 0).all()
    assert (result.maps.diffuse[none].max(axis=1) > 0.02).all()
    assert result.maps.specular.max() < 1000


def test_photographs_of_something_else_are_refused():
    copy = make_copy(np.zeros((20, 20)))
    behind = dataclasses.replace(lamp(50, 30), position=np.array([0.0, 0.0, -300.0]))
    sampler = PhotographSampler(copy, [photograph(light=behind)], Terrain.of(copy.height_field))
    with pytest.raises(FittingError, match="sample"):
        fit_maps(sampler, options=OPTIONS)


def test_pixels_show_the_texels_that_are_projected_there():
    copy = painted(24, 30)
    random = np.random.default_rng(0)
    shape = copy.height_field.shape
    c_x = -random.uniform(0.8, 1.2, shape)
    lobe = np.stack([c_x, c_x * 1.1, np.ones(shape), random.uniform(2, 60, shape)], axis=-1)
    maps = dataclasses.replace(copy.reflectance, lobe=lobe.astype(np.float32))
    copy = dataclasses.replace(copy, reflectance=maps)
    taken = photograph(EYES[1], lamp(55, 10))
    rendered = Relighting(copy, Terrain.of(copy.height_field), taken).rendered(taken)
    field = copy.height_field
    x, y = np.meshgrid(field.texel_x_mm(), field.texel_y_mm())
    points = np.stack([x, y, field.height], axis=-1).reshape(-1, 3).astype(float)
    flat = copy.normal_xy.reshape(-1, 2).astype(float)
    frames = local_frames(np.column_stack([flat, np.sqrt(1 - np.sum(flat**2, axis=1))]))
    towards = np.array(EYES[1]) - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    view = np.einsum("nij,nj->ni", frames, towards)[:, np.newaxis]
    light = np.einsum("nij,nj->ni", frames, taken.lamp.directions(points))[:, np.newaxis]
    own = maps.lobe.reshape(-1, 4).astype(float)
    shapes = np.column_stack(
        [np.log(own[:, 3]), np.log(-own[:, 2] / own[:, 0]), np.log(own[:, 1] / own[:, 0])]
    )
    lobes = LafortuneLobes(shapes, maps.diffuse.reshape(-1, 3), maps.specular.reshape(-1, 3))
    expected = lobes.radiance(view, light)[:, 0] * taken.lamp.irradiance(points)
    from calibration.lens import transform

    pixels = taken.lens.project(transform(taken.rt_cam_canvas, points))
    at = np.rint(pixels).astype(int)
    close = np.abs(pixels - at).max(axis=1) < 0.06
    found = rendered[at[:, 1], at[:, 0]]
    usable = close & np.isfinite(found).all(axis=1) & (found > 0).all(axis=1)
    assert usable.sum() >= 4
    assert found[usable] == pytest.approx(expected[usable], rel=0.1)


def test_rendering_is_the_lobes_own_formula():
    copy = painted(24, 30)
    random = np.random.default_rng(0)
    shape = copy.height_field.shape
    c_x = -random.uniform(0.8, 1.2, shape)
    c_y = c_x * random.uniform(0.7, 1.4, shape)
    own = np.stack([c_x, c_y, np.ones(shape), random.uniform(2, 60, shape)], axis=-1)
    own = own.astype(np.float32)
    maps = copy.reflectance
    tilts = random.uniform(-0.4, 0.4, (*shape, 2)).astype(np.float32)
    flat = tilts.reshape(-1, 2).astype(float)
    frames = local_frames(np.column_stack([flat, np.sqrt(1 - np.sum(flat**2, axis=1))]))
    towards = random.normal((0, 0, 1), 0.3, (2, len(flat), 3))
    view, light = towards / np.linalg.norm(towards, axis=2, keepdims=True)
    irradiance = random.uniform(0.5, 2, (len(flat), 3))
    lamps = (view, light, irradiance)
    row, col = np.divmod(np.arange(len(flat)), shape[1])
    places = np.column_stack([col, row]).astype(float)
    found = relight(tilts, maps.diffuse, maps.specular, own, places, *lamps)
    flat_own = own.reshape(-1, 4).astype(float)
    shapes = np.column_stack(
        [
            np.log(flat_own[:, 3]),
            np.log(-flat_own[:, 2] / flat_own[:, 0]),
            np.log(flat_own[:, 1] / flat_own[:, 0]),
        ]
    )
    lobes = LafortuneLobes(shapes, maps.diffuse.reshape(-1, 3), maps.specular.reshape(-1, 3))
    local_view, local_light = (
        np.einsum("nij,nj->ni", frames, way)[:, np.newaxis] for way in (view, light)
    )
    expected = lobes.radiance(local_view, local_light)[:, 0] * irradiance
    assert found == pytest.approx(expected, rel=2e-4, abs=1e-7)
    # Halfway between two texels it is their mean.
    same = (np.repeat(one[:1], 3, axis=0) for one in lamps)
    places = np.array([[3.5, 2.0], [3.0, 2.0], [4.0, 2.0]])
    between = relight(tilts, maps.diffuse, maps.specular, own, places, *same)
    assert between[0] == pytest.approx(between[1:].mean(axis=0), rel=1e-5)
