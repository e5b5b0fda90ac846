from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq
from synthetic_copy import make_copy, strokes
from triangle_rays import meet_triangles

from render.errors import RenderError
from render.painting_node import Mode
from render.surface_shapes import surface_triangles
from render.views import NamedView, View, named_view

WIDTH, HEIGHT = 240, 180


@pytest.fixture(scope="module")
def copy():
    random = np.random.default_rng(3)
    height = strokes() + 0.3 * random.standard_normal((120, 160))
    mask = random.random(height.shape) > 0.03
    mask[40:60, 30:50] = False
    return make_copy(height, mask=mask, cell=12, smallest_mm2=2.0)


def pixel_ray(view, row, col):
    half = np.tan(view.field_of_view / 2)
    x = (2 * (col + 0.5) / WIDTH - 1) * half * WIDTH / HEIGHT
    y = (1 - 2 * (row + 0.5) / HEIGHT) * half
    return view.pose()[:3, :3] @ np.array([x, y, -1.0])


def first_front_face(origin, ray, corners):
    """The point where a ray first meets a triangle that faces it; NaN where it meets none."""
    t, inside, facing = meet_triangles(origin, ray, corners)
    met = inside & facing
    return origin + t[met].min() * ray if met.any() else np.full(3, np.nan)


VIEWS = [
    *NamedView,
    "inside",  # the camera between the lowest and the highest point
    "behind",
    "along",  # in the plane of the canvas
    "straight",  # rays along the normal: no step sideways
]


@pytest.mark.parametrize("name", VIEWS)
def test_exact_hits_what_the_triangles_hit(painter, copy, name):
    views = {
        "inside": View(np.deg2rad(152.0), np.deg2rad(7.0), 16.0, np.deg2rad(60.0)),
        "behind": View(np.deg2rad(-60.0), np.deg2rad(-30.0), 120.0),
        "along": View(np.deg2rad(-90.0), 0.0, 120.0),
        "straight": View(np.deg2rad(-90.0), np.deg2rad(90.0), 150.0),
    }
    view = views.get(name) or named_view(copy, name, aspect=WIDTH / HEIGHT)
    points = painter.points(copy, view, mode=Mode.EXACT, width=WIDTH, height=HEIGHT)
    vertices, triangles = surface_triangles(copy)
    corners = vertices[triangles].astype(np.float64)
    random = np.random.default_rng(0)
    around = np.argwhere(np.isfinite(points[..., 0]))
    pixels = random.integers(0, [HEIGHT, WIDTH], (30, 2))
    if len(around):
        pixels = np.concatenate([pixels, random.permutation(around)[:40]])
    missed = 0
    for row, col in pixels:
        expected = first_front_face(view.position, pixel_ray(view, row, col), corners)
        if np.isfinite(expected[0]) != np.isfinite(points[row, col, 0]):
            missed += 1
        elif np.isfinite(expected[0]):
            assert np.linalg.norm(points[row, col] - expected) < 0.0001
    assert missed == 0
    assert name in ("behind", "far-grazing", "far-front") or len(around) > 200


@pytest.mark.parametrize("over_mm", [-1e-9, 1e-9])
def test_a_ray_along_an_edge_passes_on_its_right_side(painter, over_mm):
    height = np.zeros((60, 80))
    height[20] = 1.0
    copy = make_copy(height, pitch=0.3)
    ridge = np.array([0.0, copy.height_field.texel_y_mm()[20], 1.0 + over_mm])
    row, below = HEIGHT // 2 - 8, np.deg2rad(-90.0)
    # All rays of a row of pixels pass the ridge at the same height: of this row, where it is asked.
    elevation = brentq(
        lambda angle: passes_over(View(below, angle, 60.0), row, ridge), 0.15, 0.6, xtol=1e-15
    )
    view = View(below, elevation, 60.0)
    points = painter.points(copy, view, mode=Mode.EXACT, width=WIDTH, height=HEIGHT)[row]
    seen = points[np.isfinite(points[:, 0]), 1]
    assert len(seen) > 80
    assert ((seen > ridge[1] + 1.0) == (over_mm > 0)).all()


def passes_over(view, row, ridge):
    """Height by which the rays of a row of pixels pass over a place."""
    ray = pixel_ray(view, row, 0)
    ahead = (ridge[1] - view.position[1]) / ray[1]
    return view.position[2] + ahead * ray[2] - ridge[2]


def test_without_a_triangle_there_is_nothing_exact_to_draw(painter):
    view = View(np.deg2rad(-90.0), np.deg2rad(60.0), 20.0)
    for shape in ((1, 1), (1, 40), (40, 1)):
        with pytest.raises(RenderError, match="another mode than exact"):
            painter.points(make_copy(np.zeros(shape)), view, mode=Mode.EXACT, width=32, height=24)


def test_work_counts_fragments_and_steps(painter, copy):
    view = named_view(copy, NamedView.INSHOT_FRONT, aspect=WIDTH / HEIGHT)
    work = {
        mode: painter.work(copy, view, mode=mode, width=WIDTH, height=HEIGHT)
        for mode in (Mode.BUMP, Mode.RELIEF, Mode.EXACT, Mode.HYBRID)
    }
    assert work[Mode.BUMP][..., 0].max() == 0
    assert set(np.unique(work[Mode.BUMP][..., 1])) == {0, 1}
    # Boxes lie over the plane.
    assert work[Mode.HYBRID][..., 1].max() > 1
    assert work[Mode.RELIEF][..., 0].sum() > work[Mode.EXACT][..., 0].sum() > 0
