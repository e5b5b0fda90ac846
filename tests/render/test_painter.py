from __future__ import annotations

import dataclasses
import os

import numpy as np
import pytest
from rendered_heights import heights_hit
from synthetic_copy import make_copy, strokes
from triangle_rays import meet_triangles

from fitting.digital_copy import ReflectanceMaps
from render.errors import RenderError
from render.painter import Light, Painter
from render.painting_node import Mode
from render.surface_shapes import surface_triangles
from render.views import NamedView, View, named_view


@pytest.fixture(scope="module")
def copy():
    return make_copy(strokes(), cell=12, smallest_mm2=2.0)


def paint(painter, copy, mode, view=NamedView.INSHOT_FRONT, **options):
    camera = view if isinstance(view, View) else named_view(copy, view, aspect=4 / 3)
    return painter.paint(copy, camera, mode=mode, width=240, height=180, **options)


def psnr(a, b):
    return -10 * np.log10(np.mean((a - b) ** 2))


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("view", list(NamedView))
def test_every_mode_draws_every_view(painter, copy, mode, view):
    picture = paint(painter, copy, mode, view)
    assert np.isfinite(picture.radiance).all()
    assert picture.coverage.max() == 1
    assert picture.radiance[picture.coverage == 1].max() > 0.2


def test_mesh_depth_agrees_with_rays_cast_on_its_triangles(painter, copy):
    view = named_view(copy, NamedView.INSHOT_GRAZING, aspect=4 / 3)
    picture = paint(painter, copy, Mode.MESH, view)
    vertices, triangles = surface_triangles(copy)
    pose = view.pose()
    checked = 0
    rows, cols = np.nonzero(picture.coverage == 1)
    random = np.random.default_rng(0)
    for n in random.choice(len(rows), 40, replace=False):
        ray = np.array(
            [
                (2 * (cols[n] + 0.5) / 240 - 1) * np.tan(view.field_of_view / 2) * 4 / 3,
                (1 - 2 * (rows[n] + 0.5) / 180) * np.tan(view.field_of_view / 2),
                -1.0,
            ]
        )
        direction = pose[:3, :3] @ ray
        hit = first_hit(view.position, direction, vertices[triangles].astype(float))
        if np.isfinite(hit):
            assert picture.depth_mm[rows[n], cols[n]] == pytest.approx(hit, abs=0.05)
            checked += 1
    assert checked > 35


def first_hit(origin, direction, corners):
    """Where a ray of z-depth 1 first meets a triangle; infinite where it meets none."""
    t, inside, _ = meet_triangles(origin, direction, corners)
    return t[inside].min() if inside.any() else np.inf


@pytest.mark.parametrize("view", [NamedView.INSHOT_FRONT, NamedView.INSHOT_GRAZING])
def test_relief_mapping_agrees_with_the_mesh(painter, copy, view):
    mesh, relief = (paint(painter, copy, mode, view) for mode in (Mode.MESH, Mode.RELIEF))
    both = (mesh.coverage == 1) & (relief.coverage == 1)
    assert psnr(mesh.radiance[both], relief.radiance[both]) > 35
    assert np.median(np.abs(mesh.depth_mm - relief.depth_mm)[both]) < 0.02


def test_bump_is_flat_and_hybrid_raises_what_stands_above_the_plane(painter, copy):
    view = View(np.deg2rad(-90.0), np.deg2rad(30.0), 110.0)
    bump, hybrid, relief = (
        paint(painter, copy, mode, view) for mode in (Mode.BUMP, Mode.HYBRID, Mode.RELIEF)
    )
    raised = (hybrid.depth_mm > 0) & (hybrid.depth_mm < bump.depth_mm - 0.1)
    assert raised.mean() > 0.01
    # Where boxes were hit, they were hit where the whole surface is.
    close = np.abs(hybrid.depth_mm - relief.depth_mm)[raised & (relief.depth_mm > 0)]
    assert np.median(close) < 0.02
    assert np.quantile(close, 0.9) < 0.3


def test_a_flat_copy_has_the_radiance_lambert_says(painter):
    flat = make_copy(np.zeros((60, 80)))
    view = View(np.deg2rad(-90.0), np.deg2rad(85.0), 150.0)
    light = Light(azimuth=0.3, elevation=0.6, distance_mm=1e5, strength=1.0, ambient=0.0)
    for mode in Mode:
        picture = paint(painter, flat, mode, view, light=light)
        # Plaster has ρ_d = 0.8 / π, and the lamp gives the irradiance π at normal incidence.
        assert picture.radiance[90, 120] == pytest.approx(0.8 * np.sin(0.6), rel=0.01)


def test_the_lobe_is_evaluated_as_eq_1_says(painter):
    flat = make_copy(np.zeros((60, 80)))
    shape = (60, 80)
    lobe = np.broadcast_to(np.array([-0.9, -0.9, 1.1, 12.0], np.float32), (*shape, 4))
    maps = ReflectanceMaps(
        np.full((*shape, 3), 0.1, np.float32), np.full((*shape, 3), 0.3, np.float32), lobe.copy()
    )
    copy = dataclasses.replace(flat, reflectance=maps)
    view = View(np.deg2rad(-100.0), np.deg2rad(50.0), 1e4)
    light = Light(
        azimuth=np.deg2rad(75.0), elevation=np.deg2rad(55.0), distance_mm=1e6, ambient=0.0
    )
    picture = painter.paint(
        copy,
        dataclasses.replace(view, field_of_view=0.005),
        mode=Mode.BUMP,
        width=64,
        height=48,
        light=light,
    )
    v, l_ = view.position / 1e4, [np.cos(light.elevation) * np.cos(light.azimuth)]
    l_ = np.array([*l_, np.cos(light.elevation) * np.sin(light.azimuth), np.sin(light.elevation)])
    d = np.sum(np.array([-0.9, -0.9, 1.1]) * v * l_)
    expected = (0.1 + 0.3 * d**12) * np.pi * l_[2]
    assert picture.radiance[24, 32] == pytest.approx(expected, rel=0.01)


def test_orientation_is_neither_mirrored_nor_upside_down(painter):
    height = np.zeros((60, 80))
    mask = np.ones(height.shape, bool)
    mask[:20, 60:] = False  # top right
    copy = make_copy(height, mask=mask)
    view = View(np.deg2rad(-90.0), np.deg2rad(89.9), 70.0)
    picture = paint(painter, copy, Mode.MESH, view)
    covered = picture.coverage > 0.5
    rows, cols = np.nonzero(covered)
    middle = covered[rows.min() : rows.max(), cols.min() : cols.max()]
    top, bottom = middle[: len(middle) // 4], middle[-len(middle) // 4 :]
    assert not top[:, -20:].any()
    assert top[:, :20].mean() > 0.8
    assert bottom[:, -20:].mean() > 0.8


@pytest.mark.parametrize("mode", list(Mode))
def test_small_and_flat_copies(painter, mode):
    for height in (np.zeros((2, 2)), np.zeros((30, 40)), np.full((30, 40), 3.0)):
        picture = paint(painter, make_copy(height), mode)
        assert np.isfinite(picture.radiance).all()
        assert picture.coverage.max() == 1


def test_a_single_texel_is_drawn_except_as_a_mesh(painter):
    single = make_copy(np.zeros((1, 1)))
    for mode in (Mode.BUMP, Mode.RELIEF, Mode.HYBRID, Mode.ADAPTIVE):
        assert paint(painter, single, mode).coverage.mean() > 0.5
    with pytest.raises(RenderError, match="1 measured texels make no triangle"):
        paint(painter, single, Mode.MESH)


def test_a_camera_inside_a_box_sees_what_the_whole_search_sees(painter, copy):
    # Low over the dome's flank, inside the cell above it.
    view = View(np.deg2rad(152.0), np.deg2rad(7.0), 16.0, np.deg2rad(60.0))
    _, high = copy.height_field.height_range_mm
    col, row = (view.position[:2] - copy.height_field.origin_mm) / 0.5 * [1, -1]
    corner, size = copy.relief.boxes.corner, copy.relief.boxes.size
    assert (([row, col] >= corner - 0.5) & ([row, col] < corner + size - 0.5)).all(axis=1).any()
    assert copy.relief.delta0_mm < view.position[2] < high
    relief, hybrid = (paint(painter, copy, mode, view) for mode in (Mode.RELIEF, Mode.HYBRID))
    above = heights_hit(relief, view) > copy.relief.delta0_mm + 0.1
    assert above.mean() > 0.01
    np.testing.assert_allclose(
        np.median(np.abs(hybrid.depth_mm - relief.depth_mm)[above]), 0, atol=0.02
    )


@pytest.mark.parametrize("elevation", [35.0, 80.0])
def test_hybrid_is_relief_above_the_plane_and_bump_elsewhere(painter, copy, elevation):
    view = View(np.deg2rad(-70.0), np.deg2rad(elevation), 110.0)
    bump, hybrid, relief = (
        paint(painter, copy, mode, view) for mode in (Mode.BUMP, Mode.HYBRID, Mode.RELIEF)
    )
    high = heights_hit(relief, view) > copy.relief.delta0_mm + 0.1
    assert high.mean() > 0.01
    assert psnr(hybrid.radiance[high], relief.radiance[high]) > 30
    assert np.quantile(np.abs(hybrid.depth_mm - relief.depth_mm)[high], 0.95) < 0.05
    flat = hybrid.depth_mm == bump.depth_mm
    assert flat.mean() > 0.5
    np.testing.assert_array_equal(hybrid.radiance[flat], bump.radiance[flat])
    assert (hybrid.depth_mm[~flat] <= bump.depth_mm[~flat] + 1e-3).mean() > 0.99


def test_a_near_lamp_lights_each_point_from_where_it_is(painter):
    level = 3.0
    copy = make_copy(np.full((60, 80), level))
    view = View(np.deg2rad(-90.0), np.deg2rad(89.99), 60.0)
    light = Light(azimuth=0.8, elevation=0.9, distance_mm=25.0, strength=2.0, ambient=0.05)
    lamp = 25.0 * np.array([np.cos(0.9) * np.cos(0.8), np.cos(0.9) * np.sin(0.8), np.sin(0.9)])
    for mode in Mode:
        picture = paint(painter, copy, mode, view, light=light)
        for row, col in ((90, 120), (50, 70), (120, 170)):
            depth = picture.depth_mm[row, col]
            scale = depth * np.tan(view.field_of_view / 2) / 90
            point = np.array([(col - 119.5) * scale, (89.5 - row) * scale, level])
            to_lamp = lamp - point
            r = np.linalg.norm(to_lamp)
            # I = π · strength · distance²; plaster reflects 0.8 / π, and ambient light by 0.8.
            expected = 0.8 * 2.0 * 25.0**2 * to_lamp[2] / r**3 + 0.8 * 0.05
            assert picture.radiance[row, col] == pytest.approx(expected, rel=0.01)


def test_values_in_gaps_never_show(painter):
    mask = np.ones((120, 160), bool)
    mask[50:70, 70:90] = False
    clean = make_copy(strokes(), mask=mask)

    def filled(gap):
        def fill(channels, value):
            inside = np.broadcast_to(mask[..., np.newaxis], (*mask.shape, channels))
            return np.where(inside, np.float32(value), np.float32(gap))

        maps = ReflectanceMaps(fill(3, 0.2), fill(3, 0.1), fill(4, 1.0))
        normal = np.where(mask[..., np.newaxis], clean.normal_xy, np.float32(gap))
        return dataclasses.replace(clean, reflectance=maps, normal_xy=normal)

    for mode in Mode:
        pictures = [paint(painter, filled(gap), mode).radiance for gap in (np.nan, 1e9)]
        np.testing.assert_array_equal(*pictures)


def test_a_copy_whose_maps_overflow_is_refused(painter):
    lobe = np.tile(np.array([-3, -3, 3, 300], np.float32), (60, 80, 1))
    white = np.full((60, 80, 3), 0.2, np.float32)
    copy = dataclasses.replace(
        make_copy(np.zeros((60, 80))), reflectance=ReflectanceMaps(white, white, lobe)
    )
    with pytest.raises(RenderError, match="not finite"):
        paint(painter, copy, Mode.BUMP)


def test_a_painter_draws_on_after_another_is_closed(painter, copy):
    before = paint(painter, copy, Mode.HYBRID)
    with Painter(supersampling=1) as other:
        second = paint(other, copy, Mode.HYBRID)
    after = paint(painter, copy, Mode.HYBRID)
    np.testing.assert_array_equal(before.radiance, second.radiance)
    np.testing.assert_array_equal(before.radiance, after.radiance)


def test_lights_and_sizes_that_make_no_sense_are_refused(painter, copy):
    for wrong in ({"azimuth": np.nan}, {"distance_mm": 0.0}, {"strength": -1.0}):
        with pytest.raises(RenderError):
            Light(**wrong)
    view = named_view(copy, NamedView.FAR_FRONT, aspect=1.0)
    for width, height in ((0, 10), (10, 10**6)):
        with pytest.raises(RenderError, match="cannot be drawn"):
            painter.paint(copy, view, width=width, height=height)


def test_a_picture_that_memory_cannot_hold_is_refused(painter, copy, monkeypatch):
    real = os.sysconf
    pages = 2**30 // real("SC_PAGE_SIZE")
    monkeypatch.setattr(
        os, "sysconf", lambda name: pages if name == "SC_PHYS_PAGES" else real(name)
    )
    view = named_view(copy, NamedView.FAR_FRONT, aspect=1.0)
    with pytest.raises(RenderError, match=r"4096×4096 cannot be drawn: .* 1 GB of memory.* 1 GB"):
        painter.paint(copy, view, width=4096, height=4096)
