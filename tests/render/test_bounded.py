from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from synthetic_copy import make_copy, strokes

from render.bounded import Search, SurfaceShape
from render.errors import RenderError
from render.painter import BACKGROUND
from render.painting_maps import PaintingMaterial
from render.painting_node import Mode
from render.surface_tiles import SurfaceTiles
from render.views import NamedView, View, named_view

WIDTH, HEIGHT = 320, 240
BUDGETS = [1.0, 0.5, 0.25, 0.125, 0.0625]


@pytest.fixture(scope="module")
def copy():
    return make_copy(0.6 * strokes(), cell=12, smallest_mm2=2.0)


def on_screen(view, points):
    """Places in a picture, (rows, cols, 2) in pixels from its middle."""
    local = (points - view.position) @ view.pose()[:3, :3]
    return local[..., :2] / -local[..., 2:] * HEIGHT / 2 / np.tan(view.field_of_view / 2)


def parallax_px(painter, copy, view, **options):
    """How far off its place what each pixel shows is: by the height missed, seen on the screen."""
    shown, true = (
        painter.points(copy, view, mode=mode, width=WIDTH, height=HEIGHT, **options).astype(float)
        for mode in (Mode.BOUNDED, Mode.EXACT)
    )
    missed = np.zeros_like(shown)
    missed[..., 2] = shown[..., 2] - true[..., 2]
    off = on_screen(view, shown) - on_screen(view, shown - missed)
    differs = np.isfinite(shown[..., 0]) != np.isfinite(true[..., 0])
    return np.linalg.norm(off, axis=-1), differs


@pytest.mark.parametrize("name", list(NamedView))
@pytest.mark.parametrize("budget", [0.25, 1])
def test_parallax_stays_within_the_budget(painter, copy, name, budget):
    view = named_view(copy, name, aspect=WIDTH / HEIGHT)
    parallax, differs = parallax_px(painter, copy, view, budget_px=budget)
    assert np.nanquantile(parallax, 0.95) <= budget
    # The outline is known to the budget.
    assert differs.sum() <= budget * (WIDTH + HEIGHT)


@pytest.mark.parametrize("distance", [12.0, 36.0])
def test_parallax_stays_within_the_budget_of_a_wide_lens(painter, distance):
    copy = make_copy(0.6 * strokes(480, 640, 0.125), pitch=0.125)
    for elevation in (82.0, 60.0, 15.0):
        view = View(np.deg2rad(-90.0), np.deg2rad(elevation), distance, np.deg2rad(120.0))
        parallax, _ = parallax_px(painter, copy, view)
        assert np.nanquantile(parallax, 0.95) <= 0.25


def test_half_the_budget_leaves_about_half_the_parallax(painter):
    # Texels smaller than pixels: otherwise the triangles themselves are hit.
    copy = make_copy(0.6 * strokes(480, 640, 0.125), pitch=0.125)
    view = named_view(copy, NamedView.INSHOT_GRAZING, aspect=WIDTH / HEIGHT)
    left = [
        np.nanquantile(parallax_px(painter, copy, view, budget_px=budget)[0], 0.95)
        for budget in BUDGETS
    ]
    assert (np.diff(left) < 0).all()
    assert 0.7 < np.polyfit(np.log(BUDGETS), np.log(left), 1)[0] < 1.5


def test_the_work_grows_with_the_parallax_there_is(painter, copy):
    steps = {}
    for name in NamedView:
        view = named_view(copy, name, aspect=WIDTH / HEIGHT)
        work = painter.work(copy, view, mode=Mode.BOUNDED, width=WIDTH, height=HEIGHT)
        steps[name] = work[..., 0].sum() / max(work[..., 1].sum(), 1)
    assert steps[NamedView.FAR_FRONT] == 0
    assert steps[NamedView.INSHOT_FRONT] < steps[NamedView.INSHOT_GRAZING]
    assert steps[NamedView.INSHOT_GRAZING] < steps[NamedView.NEAR_GRAZING]


def test_a_view_along_the_surface_is_searched_exactly(painter, copy):
    for view in (
        View(np.deg2rad(152.0), np.deg2rad(7.0), 16.0, np.deg2rad(60.0)),
        View(np.deg2rad(-90.0), 0.0, 120.0),
        View(np.deg2rad(-60.0), np.deg2rad(-30.0), 120.0),
    ):
        parallax, differs = parallax_px(painter, copy, view)
        assert not differs.any()
        # In single precision.
        assert np.nanmax(parallax, initial=0.0) < 1e-4


@pytest.fixture(scope="module")
def sculpted():
    height = 3 * strokes()
    mask = np.random.default_rng(0).random(height.shape) > 0.03
    return make_copy(height, mask=mask)


def test_a_sculpted_relief_is_drawn_by_large_triangles_and_searched_for_small_ones(
    painter, sculpted
):
    steps = {}
    for elevation, distance in ((80.0, 16.0), (80.0, 150.0), (20.0, 30.0)):
        view = View(np.deg2rad(-90), np.deg2rad(elevation), distance)
        parallax, differs = parallax_px(painter, sculpted, view)
        assert np.nanquantile(parallax, 0.95) <= 0.01
        assert differs.sum() <= 0.001 * differs.size
        work = painter.work(sculpted, view, mode=Mode.BOUNDED, width=WIDTH, height=HEIGHT)
        steps[distance] = work[..., 0].sum()
    assert steps[16.0] == 0
    assert steps[150.0] > 0


def test_tiles_out_of_sight_are_left_out(sculpted):
    tiles = SurfaceTiles.of(sculpted)
    assert tiles.runs(np.ones(len(tiles.corners), bool)) == [(0, len(tiles.triangles))]
    assert tiles.runs(np.zeros(len(tiles.corners), bool)) == []
    # Orthographic, X from 0 to 20 and Y from -5 to 5.
    to_clip = np.array([[0.1, 0, 0, -1], [0, 0.2, 0, 0], [0, 0, -0.01, 0], [0, 0, 0, 1.0]])
    seen = tiles.seen(to_clip)
    assert 0 < seen.sum() < 0.3 * len(seen)
    drawn = np.concatenate(
        [tiles.triangles[first : first + count] for first, count in tiles.runs(seen)]
    )
    place = tiles.vertices[tiles.triangles].mean(axis=1)
    inside = (np.abs(place[:, 0] - 10) < 10) & (np.abs(place[:, 1]) < 5)
    assert {*map(tuple, tiles.triangles[inside])} <= {*map(tuple, drawn)}


def test_needs_change_from_a_plane_to_a_search_as_the_camera_nears(copy):
    shape = SurfaceShape.of(copy.height_field, PaintingMaterial(copy).height_levels)
    low, high = copy.height_field.height_range_mm
    found, planes = [], []
    for distance in np.geomspace(2e4, 60.0, 400):
        needs = shape.needs(np.array([0.0, -0.3, 1.0]) * distance, 0.001, 0.25)
        found.append(needs.search)
        planes.append(needs.plane_mm)
        assert low <= needs.plane_mm <= high
    assert found[0] is Search.PLANE
    assert found[-1] is not Search.PLANE
    # Nothing jumps: the plane moves smoothly from where it hides its error to the median.
    assert np.abs(np.diff(planes)).max() < 0.05


def test_nothing_jumps_where_one_search_gives_way_to_another(painter, copy):
    shape = SurfaceShape.of(copy.height_field, PaintingMaterial(copy).height_levels)

    def way(view):
        pixel_angle = 2 * np.tan(view.field_of_view / 2) / HEIGHT
        needs = shape.needs(view.position, pixel_angle, 0.25)
        return needs.search, needs.level, needs.heading, needs.triangle_share > 0

    views = [
        View(np.deg2rad(-90), np.deg2rad(elevation), distance)
        for elevation, distance in zip(
            np.linspace(80, 20, 60), np.geomspace(3000, 60, 60), strict=True
        )
    ]
    switches = 0
    for first, last in pairwise(views):
        if way(first) == way(last):
            continue
        begin, end = 0.0, 1.0
        for _ in range(20):
            middle = 0.5 * (begin + end)
            if way(between(first, last, middle)) == way(first):
                begin = middle
            else:
                end = middle
        pictures = [
            painter.paint(
                *(copy, between(first, last, share)), mode=Mode.BOUNDED, width=WIDTH, height=HEIGHT
            ).radiance
            for share in (begin, end)
        ]
        jump = np.abs(pictures[0] - pictures[1])[pictures[0] != BACKGROUND[0]]
        assert jump.mean() < 1e-4
        switches += 1
    assert switches >= 4


def between(first, last, share):
    return View(
        first.azimuth,
        first.elevation + share * (last.elevation - first.elevation),
        first.distance_mm + share * (last.distance_mm - first.distance_mm),
    )


@pytest.mark.parametrize("budget", [0.0, -1.0, np.nan, np.inf])
def test_budgets_that_make_no_sense_are_refused(painter, copy, budget):
    view = named_view(copy, NamedView.INSHOT_FRONT, aspect=1.0)
    with pytest.raises(RenderError, match="budget"):
        painter.paint(copy, view, mode=Mode.BOUNDED, width=16, height=16, budget_px=budget)
