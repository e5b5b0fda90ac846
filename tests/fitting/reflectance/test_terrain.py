from __future__ import annotations

import numpy as np
import pytest
from synthetic_copy import make_copy, strokes

from devices.simulated.ray_kernels import MaximumPyramid, cast_shadows
from fitting.errors import FittingError
from fitting.reflectance.ray_kernels import ABOVE_HORIZON, BLOCKED
from fitting.reflectance.terrain import Terrain


def surface_points(field):
    x, y = np.meshgrid(field.texel_x_mm(), field.texel_y_mm())
    return np.stack([x, y, field.height], axis=-1).reshape(-1, 3).astype(float)


def source(elevation, azimuth, distance=500.0):
    e, a = np.radians([elevation, azimuth])
    return distance * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


SOURCES = [source(e, a) for e, a in [(8, 20), (15, 200), (30, 90), (30, 0), (45, 311), (80, 137)]]


def marched(terrain_height, pitch, origin, point, towards, clearance):
    """By small steps along the ray: plain, slow, and blind to what is finer than a step."""
    t = np.arange(0.02, 60.0, 0.02)
    way = point + t[:, np.newaxis] * towards
    col, row = (way[:, 0] - origin[0]) / pitch, (origin[1] - way[:, 1]) / pitch
    rows, cols = terrain_height.shape
    inside = (col >= 0) & (row >= 0) & (col <= cols - 1) & (row <= rows - 1)
    col, row, z = col[inside], row[inside], way[inside, 2]
    c, r = np.minimum(col.astype(int), cols - 2), np.minimum(row.astype(int), rows - 2)
    u, v = col - c, row - r
    h = terrain_height
    surface = (1 - v) * ((1 - u) * h[r, c] + u * h[r, c + 1])
    surface += v * ((1 - u) * h[r + 1, c] + u * h[r + 1, c + 1])
    return bool((surface > z + clearance).any())


@pytest.mark.parametrize("light", SOURCES)
def test_shadows_are_those_of_a_march_along_every_ray(light):
    field = make_copy(strokes()).height_field
    points = surface_points(field)[::37]
    found = Terrain.of(field).findings(points, light, clearance_mm=1e-3) == BLOCKED
    for point, blocked in zip(points, found, strict=True):
        towards = (light - point) / np.linalg.norm(light - point)
        slow = [
            marched(field.height, field.pitch_mm, field.origin_mm, point, towards, c)
            for c in (2e-3, 5e-4)
        ]
        assert slow[0] <= blocked <= slow[1]


@pytest.mark.parametrize("light", SOURCES)
def test_what_is_above_the_horizon_needs_no_ray(light):
    random = np.random.default_rng(0)
    field = make_copy(strokes() + 0.2 * random.random((120, 160))).height_field
    terrain, points = Terrain.of(field), surface_points(field)
    with_rays = terrain.findings(points, light, clearance_mm=1e-4)
    horizons = terrain.horizons(points)
    skipped = terrain.findings(points, light, clearance_mm=1e-4, horizons=horizons)
    assert np.array_equal(with_rays == BLOCKED, skipped == BLOCKED)
    if light[2] > 400:
        assert np.mean(skipped == ABOVE_HORIZON) > 0.9


def test_shadows_agree_with_the_simulated_scene_on_a_rough_surface():
    height = np.random.default_rng(1).random((65, 83)).astype(np.float32)
    field = make_copy(height, pitch=0.4).height_field
    points = surface_points(field)
    pyramid = MaximumPyramid.of(field.height)
    for light in SOURCES:
        other = cast_shadows(
            *(field.height, pyramid.maxima, pyramid.starts, pyramid.shapes, 0.4),
            *(-10.0, 1.0, points, light, 1e-3),
        )
        own = Terrain.of(field).findings(points, light, clearance_mm=1e-3)
        assert np.mean((own == BLOCKED) != other) < 1e-3


def test_rays_from_an_eye_meet_the_surface_where_it_is():
    field = make_copy(strokes()).height_field
    eye, points = np.array([30.0, -10.0, 250.0]), surface_points(field)
    terrain = Terrain.of(field)
    met = terrain.seen_from(eye, points - eye)
    visible = terrain.findings(points, eye, clearance_mm=1e-4) != BLOCKED
    inner = np.ones(field.shape, bool)
    inner[[0, -1]] = inner[:, [0, -1]] = False
    seen = visible & inner.ravel()
    assert np.abs(met[seen] - points[seen]).max() < 2e-3
    hidden = ~visible & inner.ravel()
    assert hidden.any()
    nearer = np.linalg.norm(met[hidden] - eye, axis=1) < np.linalg.norm(
        points[hidden] - eye, axis=1
    )
    assert nearer.all()


def test_rays_that_come_in_below_the_edge_miss():
    terrain = Terrain.of(make_copy(np.full((20, 20), 3.0), pitch=1.0).height_field)
    eye = np.array([15.0, 0.0, 3.1])
    # Below the edge, far below it, upwards; over the edge, and beyond the far one.
    rays = np.array(
        [[-1.0, 0.0, -0.05], [-1.0, 0.0, -0.5], [0.0, 0.0, 1.0], [-1, 0, -0.01], [-1, 0, -0.004]]
    )
    met = terrain.seen_from(eye, rays)
    assert np.isnan(met[[0, 1, 2, 4]]).all()
    assert met[3] == pytest.approx([5.0, 0.0, 3.0], abs=1e-3)


def test_a_frame_beyond_the_canvas_throws_its_shadow():
    field = make_copy(np.zeros((40, 60)), pitch=1.0).height_field
    y, z = np.meshgrid(np.arange(-20.0, 21.0), np.arange(0.0, 19.0))
    frame = np.stack([np.full(y.shape, 35.0), y, z], axis=-1).reshape(-1, 3)
    points, light = surface_points(field), np.array([500.0, 0.0, 250.0])
    assert not (Terrain.of(field).findings(points, light, clearance_mm=0.01) == BLOCKED).any()
    framed = Terrain.of(field, surroundings=frame)
    dark = (framed.findings(points, light, clearance_mm=0.01) == BLOCKED).reshape(40, 60)
    # 18 mm at a slope of one half, 35 mm out: the last 36 mm before the frame.
    edge = field.texel_x_mm()[dark[20]].min()
    assert edge == pytest.approx(35 - 36, abs=2)
    assert dark[20, 35:].all()


def test_gaps_take_the_height_beside_them():
    height = np.zeros((30, 30))
    height[:, 14:17] = 4.0
    mask = np.ones((30, 30), bool)
    mask[10:20, 15] = False
    field = make_copy(height, pitch=1.0, mask=mask).height_field
    light = np.array([300.0, 0.0, 150.0])
    points = surface_points(field).reshape(30, 30, 3)[15, :14]
    dark = Terrain.of(field).findings(points, light, clearance_mm=0.01) == BLOCKED
    assert dark[-6:].all()


def test_a_strip_of_one_texel_is_refused():
    with pytest.raises(FittingError, match="no surface"):
        Terrain.of(make_copy(np.zeros((1, 40))).height_field)
