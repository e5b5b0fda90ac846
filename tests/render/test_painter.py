from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from synthetic_copy import make_copy, strokes

from fitting.digital_copy import ReflectanceMaps
from render.adaptive import AdaptiveOptions, box_alpha
from render.errors import RenderError
from render.opengl import pyrender
from render.painter import Light, Painter, painting_scene
from render.painting_node import Mode, painting_mesh
from render.surface_shapes import surface_triangles
from render.views import NamedView, View, named_view, parse_view


@pytest.fixture(scope="module")
def painter():
    with Painter(supersampling=1) as painter:
        yield painter


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
    """Möller and Trumbore's intersection with every triangle; the ray has z-depth 1."""
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction, edge2)
    determinant = (edge1 * p).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origin - corners[:, 0]
        u = (s * p).sum(axis=1) / determinant
        q = np.cross(s, edge1)
        v = (direction * q).sum(axis=1) / determinant
        t = (edge2 * q).sum(axis=1) / determinant
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
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


def test_adaptive_runs_from_bump_to_hybrid(painter, copy):
    view = named_view(copy, NamedView.INSHOT_GRAZING, aspect=4 / 3)
    hybrid, bump = paint(painter, copy, Mode.HYBRID, view), paint(painter, copy, Mode.BUMP, view)
    eager, lazy = (
        paint(painter, copy, Mode.ADAPTIVE, view, adaptive=AdaptiveOptions(K=k)) for k in (1e6, 0.0)
    )
    np.testing.assert_allclose(eager.radiance, hybrid.radiance, atol=1e-6)
    np.testing.assert_allclose(lazy.radiance, bump.radiance, atol=1e-6)


def test_box_alpha_by_hand(copy):
    boxes = copy.relief.boxes
    options = AdaptiveOptions(K=2.0, epsilon_min=0.01, epsilon_max=0.03)
    camera = np.array([5.0, -80.0, 120.0])
    alpha = box_alpha(copy, camera, options)
    for n in range(len(boxes)):
        row, col = boxes.peak[n]
        top = np.array(
            [
                copy.height_field.texel_x_mm()[col],
                copy.height_field.texel_y_mm()[row],
                boxes.h_max[n],
            ]
        )
        ray = top - camera
        foot = camera + ray * (copy.relief.delta0_mm - camera[2]) / ray[2]
        r = np.linalg.norm(foot - top) / np.linalg.norm(ray)
        assert alpha[n] == pytest.approx(np.clip((2 * r - 0.01) / 0.02, 0, 1), abs=1e-6)
    assert 0 < alpha.mean() < 1


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
def test_gaps_are_seen_through_and_other_nodes_compose_by_depth(painter, mode):
    mask = np.ones((120, 160), bool)
    mask[50:70, 70:90] = False
    copy = make_copy(strokes(), mask=mask)
    view = View(np.deg2rad(-90.0), np.deg2rad(89.0), 150.0)
    scene = painting_scene(copy, painting_mesh(copy, mode), view, Light(), 4 / 3)
    assert painter.paint_scene(scene, width=240, height=180).coverage[90, 120] == 0

    def board(z):
        corners = np.array([[-60, -50, z], [60, -50, z], [60, 50, z], [-60, 50, z]], np.float32)
        red = pyrender.MetallicRoughnessMaterial(emissiveFactor=[1.0, 0.0, 0.0], doubleSided=True)
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        return pyrender.Mesh([pyrender.Primitive(corners, indices=faces, material=red)])

    behind = scene.add(board(-5.0))
    picture = painter.paint_scene(scene, width=240, height=180)
    assert picture.radiance[90, 120, 0] > 0.9
    assert picture.radiance[60, 60, 1] > 0.02
    scene.remove_node(behind)
    scene.add(board(20.0))
    picture = painter.paint_scene(scene, width=240, height=180)
    assert picture.radiance[60, 60, 0] > 0.9


@pytest.mark.parametrize("mode", list(Mode))
def test_small_and_flat_copies(painter, mode):
    for height in (np.zeros((2, 2)), np.zeros((30, 40)), np.full((30, 40), 3.0)):
        picture = paint(painter, make_copy(height), mode)
        assert np.isfinite(picture.radiance).all()
        assert picture.coverage.max() == 1


def test_a_camera_inside_a_box_sees_the_relief(painter, copy):
    view = View(np.deg2rad(-90.0), np.deg2rad(20.0), 4.0)
    relief, hybrid = (paint(painter, copy, mode, view) for mode in (Mode.RELIEF, Mode.HYBRID))
    assert view.position[2] < copy.height_field.height_range_mm[1]
    assert relief.coverage.mean() > 0.2
    assert np.isfinite(hybrid.radiance).all()


def test_views_are_parsed_or_refused(copy):
    view = parse_view("-90,30,400", copy, aspect=4 / 3)
    np.testing.assert_allclose(view.position, [0, -400 * np.cos(np.pi / 6), 200], atol=1e-9)
    np.testing.assert_allclose(view.pose()[:3, :3].T @ view.pose()[:3, :3], np.eye(3), atol=1e-12)
    for bad in ("sideways", "1,2", "1,2,nan", "0,100,400", "0,30,-1"):
        with pytest.raises(RenderError):
            parse_view(bad, copy, aspect=4 / 3)
