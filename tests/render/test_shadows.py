from __future__ import annotations

import numpy as np
import pytest
from synthetic_copy import make_copy, strokes
from triangle_rays import meet_triangles

from render.errors import RenderError
from render.opengl import pyrender
from render.painter import Light, painting_scene
from render.painting_node import Mode, painting_mesh
from render.painting_renderer import RoomLight
from render.surface_shapes import surface_triangles
from render.views import View, direction

WIDTH, HEIGHT = 240, 180
VIEW = View(np.deg2rad(-80.0), np.deg2rad(65.0), 110.0)
LOW = Light(azimuth=np.deg2rad(120.0), elevation=np.deg2rad(12.0), ambient=0.0)


@pytest.fixture(scope="module")
def copy():
    mask = np.ones((60, 80), bool)
    mask[10:18, 12:20] = False
    mask[40, 50] = False
    return make_copy(strokes(60, 80, 1.0), pitch=1.0, mask=mask)


def lit_and_shadowed(painter, copy, mode, light=LOW):
    """Pixels that the light reaches without shadows, and those of them that are in one."""
    options = {"mode": mode, "width": WIDTH, "height": HEIGHT, "light": light}
    bare = painter.paint(copy, VIEW, **options).radiance[..., 0]
    shadowed = painter.paint(copy, VIEW, **options, shadows=True).radiance[..., 0]
    covered = painter.paint(copy, VIEW, **options).coverage > 0
    lit = covered & (bare > 0)
    # A shadow takes all of the light or none.
    assert np.array_equal(shadowed[lit & (shadowed > 0)], bare[lit & (shadowed > 0)])
    return lit, lit & (shadowed == 0)


def lifted(copy, point):
    """A point of the surface, raised by the error of heights and of the choice of diagonals."""
    field = copy.height_field
    col = (point[0] - field.origin_mm[0]) / field.pitch_mm
    row = (field.origin_mm[1] - point[1]) / field.pitch_mm
    square = np.s_[int(row) : int(row) + 2, int(col) : int(col) + 2]
    (a, b), (c, d) = field.height[square].astype(float)
    twist = abs(a + d - b - c) / 2 if field.mask[square].all() else 0.0
    noise = 3e-3  # three standard deviations of the made-up copy, mm
    return point + np.array([0, 0, twist + noise + 1e-3 * field.pitch_mm])


@pytest.mark.parametrize("azimuth", [120.0, -100.0])
def test_shadows_are_where_triangles_hide_the_light(painter, copy, azimuth):
    light = Light(azimuth=np.deg2rad(azimuth), elevation=np.deg2rad(12.0), ambient=0.0)
    lit, shadowed = lit_and_shadowed(painter, copy, Mode.EXACT, light)
    assert 0.01 < shadowed.sum() / lit.sum() < 0.5
    points = painter.points(copy, VIEW, mode=Mode.EXACT, width=WIDTH, height=HEIGHT)
    vertices, triangles = surface_triangles(copy)
    corners = vertices[triangles].astype(np.float64)
    lamp = 5 * max(copy.height_field.size_mm) * direction(light.azimuth, light.elevation)
    # Away from the edges of shadows and of the surface, which are a pixel wide.
    state = np.where(lit, 1 + shadowed, 0)
    around = np.stack([np.roll(state, (r, c), (0, 1)) for r in (-1, 0, 1) for c in (-1, 0, 1)])
    inner = (state > 0) & (around == state).all(axis=0)
    random = np.random.default_rng(int(azimuth) + 200)
    chosen = [random.permutation(np.argwhere(inner & (state == s)))[:120] for s in (1, 2)]
    for row, col in np.concatenate(chosen):
        start = lifted(copy, points[row, col].astype(np.float64))
        t, inside, facing = meet_triangles(start, lamp - start, corners)
        hidden = bool((inside & facing & (t < 1)).any())
        assert hidden == shadowed[row, col], (row, col)


@pytest.mark.parametrize("mode", [Mode.MESH, Mode.BUMP, Mode.ADAPTIVE, Mode.BOUNDED])
def test_every_mode_shadows_what_exact_does(painter, copy, mode):
    lit, shadowed = lit_and_shadowed(painter, copy, mode)
    _, expected = lit_and_shadowed(painter, copy, Mode.EXACT)
    common = (shadowed & expected).sum() / (shadowed | expected)[lit].sum()
    # Planes put shadows where they show the surface: off by its parallax.
    assert common > (0.75 if mode in (Mode.BUMP, Mode.HYBRID, Mode.ADAPTIVE) else 0.9)


def test_a_light_behind_the_canvas_reaches_nothing(painter):
    copy = make_copy(strokes(60, 80, 1.0), pitch=1.0)
    behind = Light(elevation=np.deg2rad(-15.0), ambient=0.0)
    lit, shadowed = lit_and_shadowed(painter, copy, Mode.EXACT, behind)
    assert lit.any()
    assert np.array_equal(lit, shadowed)


def test_flat_copies_of_any_size_have_no_shadows(painter):
    for shape, mode in (((1, 1), Mode.BUMP), ((9, 12), Mode.BOUNDED)):
        flat = make_copy(np.zeros(shape))
        pair = [
            painter.paint(
                flat, VIEW, mode=mode, width=80, height=60, light=LOW, shadows=shadows
            ).radiance
            for shadows in (False, True)
        ]
        assert np.array_equal(*pair)


FRONT = View(np.deg2rad(-90.0), np.deg2rad(89.99), 150.0)


def wall(z, half_width=60.0):
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    corners = corners * half_width + [0, 0, z]
    paint = pyrender.MetallicRoughnessMaterial(metallicFactor=0.0, roughnessFactor=1.0)
    up = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    primitive = pyrender.Primitive(
        corners.astype(np.float32), indices=faces, normals=up, material=paint
    )
    return pyrender.Mesh([primitive])


def spot_scene(copy, mode):
    dark = Light(strength=0.0, ambient=0.0)
    scene = painting_scene(copy, painting_mesh(copy, mode), FRONT, dark, 4 / 3)
    spot = pyrender.SpotLight(
        color=[1.0] * 3, intensity=3 * 200.0**2, innerConeAngle=0.5, outerConeAngle=0.6
    )
    # From the upper left, 45° above the canvas.
    scene.add(spot, pose=View(np.deg2rad(180.0), np.deg2rad(45.0), 200.0).pose())
    return scene


def line(painter, scene, radius):
    room = RoomLight(lamp_radius_mm=radius)
    return painter.paint_scene(scene, width=240, height=180, room_light=room).radiance[90, :, 0]


@pytest.mark.parametrize("mode", [Mode.ADAPTIVE, Mode.BOUNDED])
def test_a_painting_casts_its_outline_on_the_wall_and_light_passes_its_gap(painter, mode):
    # 40 mm wide, flat, 30 mm before the wall, with a gap of 10 mm around the middle.
    mask = np.ones((60, 80), bool)
    mask[20:40, 30:50] = False
    copy = make_copy(np.zeros((60, 80)), mask=mask)
    scene = spot_scene(copy, mode)
    scene.add(wall(-30.0))
    found = line(painter, scene, 0.0)
    half = np.tan(FRONT.field_of_view / 2)
    x = (2 * (np.arange(240) + 0.5) / 240 - 1) * half * 4 / 3 * (150 + 30)
    on_wall = (np.abs(x) > 24) & (np.abs(x) < 55)
    lamp_x, lamp_z = -200 * np.sqrt(0.5), 200 * np.sqrt(0.5)
    # Where the ray from the lamp to a place of the wall passes the canvas's plane.
    passes = lamp_x + (x - lamp_x) * lamp_z / (lamp_z + 30)
    dark = (np.abs(passes) < 20) & (np.abs(passes) > 5)
    edge = np.min(np.abs(np.abs(passes)[:, None] - [5.0, 20.0]), axis=1) < 1.0
    sure = on_wall & ~edge
    assert (found[sure & dark] < 1e-6).all()
    assert (found[sure & ~dark] > 0.2).all()
    assert (sure & dark).sum() > 10
    assert (sure & ~dark).sum() > 30


def test_a_frame_casts_a_half_shadow_on_the_painting_as_wide_as_the_lamp_makes_it(painter):
    copy = make_copy(np.zeros((120, 160)))
    scene = spot_scene(copy, Mode.BOUNDED)
    # A bar 10 mm before the canvas, its right edge at x = -30 mm: its shadow ends at -19.6 mm.
    scene.add(wall(10.0, half_width=10.0), pose=np.array([[1, 0, 0, -40.0], *np.eye(4)[1:]]))
    half = np.tan(FRONT.field_of_view / 2)
    x = (2 * (np.arange(240) + 0.5) / 240 - 1) * half * 4 / 3 * 150
    widths = {}
    for radius in (0.0, 12.0):
        found = line(painter, scene, radius)
        full = line(painter, spot_scene(copy, Mode.BOUNDED), radius)
        share = found / np.maximum(full, 1e-9)
        seen = (np.abs(x) < 39) & (x > -28)
        shadow = share[seen]
        middle = x[seen][np.argmin(np.abs(shadow - 0.5))]
        lamp = 200 * np.sqrt(0.5)
        assert middle == pytest.approx(-30 + (-30 + lamp) * 10 / (lamp - 10), abs=1.5)
        widths[radius] = ((shadow > 0.02) & (shadow < 0.98)).sum() * (x[1] - x[0])
    # Similar triangles: the disc is seen at 45°, the bar is 10 of the lamp's 141 mm away.
    expected = 2 * 12 * 10 / (lamp - 10) / np.sqrt(0.5)
    assert widths[0.0] < 1.5
    assert 0.5 * expected < widths[12.0] < 1.6 * expected


def test_ambient_light_comes_from_where_its_slope_says(painter):
    copy = make_copy(np.zeros((60, 80)))
    light = Light(strength=0.0, ambient=0.5)
    scene = painting_scene(copy, painting_mesh(copy, Mode.BUMP), FRONT, light, 4 / 3)
    scene.add(wall(-5.0))
    shown = [
        painter.paint_scene(
            scene, width=120, height=90, room_light=RoomLight(ambient_slope=slope)
        ).radiance[45, :, 0]
        for slope in ((0.0, 0.0, 0.0), (0.0, 0.8, 0.5))
    ]
    assert shown[0][60] == pytest.approx(0.4, rel=1e-4)
    # Painting and wall alike; the background is none of them.
    assert shown[1][8:-8] == pytest.approx(1.5 * shown[0][8:-8], rel=1e-4)


@pytest.mark.parametrize(
    "options", [{"lamp_radius_mm": -1.0}, {"lamp_radius_mm": np.nan}, {"ambient_slope": (2, 0, 0)}]
)
def test_light_that_cannot_be_is_refused(options):
    with pytest.raises(RenderError):
        RoomLight(**options)
