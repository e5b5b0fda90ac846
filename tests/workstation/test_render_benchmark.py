from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from synthetic_copy import make_copy, strokes
from triangle_rays import meet_triangles

from render.painting_node import Mode
from render.surface_shapes import surface_triangles
from render.views import NamedView, View
from workstation.benchmarks.picture_differences import Difference
from workstation.benchmarks.render import bench
from workstation.benchmarks.render_bounds import bounded_records, exact_records, time_records
from workstation.benchmarks.render_budget import halving_record
from workstation.benchmarks.render_cases import Case, Work, time_ratio
from workstation.benchmarks.render_path import Popping, switches
from workstation.benchmarks.render_rays import TriangleRays
from workstation.benchmarks.render_scenes import OIL, SIZES, RenderedScene
from workstation.benchmarks.render_tables import order_of_sizes, table_1

MS = {
    Mode.MESH: [300.0, 310.0],
    Mode.BUMP: [20.0, 40.0, 20.0],
    Mode.RELIEF: [60.0, 90.0, 60.0],
    Mode.HYBRID: [70.0] * 3,
    Mode.ADAPTIVE: [65.0] * 3,
    Mode.EXACT: [50.0] * 3,
    Mode.BOUNDED: [22.0, 44.0, 33.0],
}


def case(view, size, mode, *, psnr=60.0, coverage=1, parallax=0.2, flip=0.004):
    off = Difference(
        psnr, psnr - 9, 0.99, flip, 2 * flip, (0.01, parallax, 2.0), (0.1, 5.0), coverage
    )
    return Case(OIL, size, str(view), str(mode), MS[mode], 30.0, Work(1, 2), 0, 0, off)


def cases(**worst):
    made = [
        case(view, f"{width}x{height}", mode)
        for width, height in SIZES
        for view in NamedView
        for mode in Mode
    ]
    return [*made, case(NamedView.FAR_FRONT, "1024x768", worst.pop("mode", Mode.MESH), **worst)]


def test_ratios_are_of_the_same_turn():
    slow_turn, bump = (case("v", "s", mode) for mode in (Mode.BOUNDED, Mode.BUMP))
    assert time_ratio(slow_turn, bump) == pytest.approx(1.1)


def test_the_worst_view_decides():
    found = {record.name: record for record in exact_records(cases(mode=Mode.EXACT, psnr=50.0))}
    assert found["exact.psnr_db_min"].value == 50.0
    assert not found["exact.psnr_db_min"].holds
    assert "41.0 dB at least" in found["exact.psnr_db_min"].note
    assert found["exact.coverage_px_max"].holds
    found = {record.name: record for record in bounded_records(cases(mode=Mode.BOUNDED, flip=0.02))}
    assert not found["bounded.flip_max"].holds
    assert "far-front 1024x768" in found["bounded.flip_max"].note
    assert found["bounded.parallax_p95_px_max"].holds
    assert "1 px at most" in found["bounded.parallax_p95_px_max"].note


def test_times_are_held_against_bump_mapping_and_the_faster_rival():
    found = {record.name: record for record in time_records(cases())}
    assert len(found) == 2 * len(NamedView)
    over_bump = found["bounded.time_over_bump.inshot-front"]
    assert (over_bump.value, over_bump.bound) == (pytest.approx(1.1), 1.15)
    assert "relief" in found["bounded.time_over_rival.far-front"].note


def test_the_first_table_tells_where_its_order_is_not_the_papers():
    found = {record.name: record for record in table_1(cases())}
    assert len(found) == len(NamedView) * (len(Mode) - 1)
    note = found["table1.near-front.adaptive_over_mesh"].note
    assert "fastest to slowest relief, adaptive, hybrid, mesh, the paper's mesh" in note
    assert "relief 1.00 fragments and 2.0 steps" in note


def test_the_second_table_tells_where_its_order_is_not_the_papers():
    paper = {20: 1.0, 5: 2.0, 10: 3.0, 50: 4.0, 100: 5.0}
    had = {n: f"work {n}" for n in paper}
    assert order_of_sizes(paper, had, "front").endswith("as in the paper")
    other = order_of_sizes(dict(zip(paper, range(5, 0, -1), strict=True)), had, "front")
    assert "size 100, 50, 10, 5, 20, the paper's 20, 5, 10, 50, 100" in other
    assert "100 has work 100, 20 work 20" in other


def rough_triangles():
    random = np.random.default_rng(1)
    height = strokes(40, 50) + 0.3 * random.standard_normal((40, 50))
    copy = make_copy(height, mask=random.random(height.shape) > 0.05)
    vertices, triangles = surface_triangles(copy)
    return copy, vertices.astype(np.float64)[triangles]


def test_rays_meet_the_triangle_that_is_first_of_all():
    copy, corners = rough_triangles()
    rays = TriangleRays(copy.height_field, corners)
    random = np.random.default_rng(2)
    met = 0
    for eye in ([0.0, -30.0, 6.0], [3.0, 1.0, 40.0], [0.0, 0.0, 1.5], [2.0, 5.0, -20.0]):
        aimed = random.uniform([-14, -11, -1], [14, 11, 2], (30, 3)) - eye
        for ray, found in zip(aimed, rays.first_front_faces(np.array(eye), aimed), strict=True):
            t, inside, facing = meet_triangles(np.array(eye), ray, corners)
            first = t[inside & facing].min(initial=np.inf)
            assert np.isfinite(first) == np.isfinite(found[0])
            if np.isfinite(first):
                met += 1
                assert found == pytest.approx(np.array(eye) + first * ray, abs=1e-9)
    assert met > 40


def test_no_ray_passes_between_triangles_that_share_an_edge():
    copy = make_copy(strokes(40, 50))
    vertices, triangles = surface_triangles(copy)
    corners = vertices.astype(np.float64)[triangles]
    inner = np.abs(vertices[:, :2]).max(axis=1) < 6
    ends = vertices[inner].astype(np.float64)
    along = corners.mean(axis=1, where=np.array([True, True, False])[:, np.newaxis])
    along = along[np.abs(along[:, :2]).max(axis=1) < 6]
    eye = np.array([1.0, -2.0, 50.0])
    rays = np.concatenate([ends, along]) - eye
    found = TriangleRays(copy.height_field, corners).first_front_faces(eye, rays)
    assert len(rays) > 800
    assert np.isfinite(found).all()


def test_halving_is_a_slope_of_one():
    assert halving_record({1.0: 0.8, 0.5: 0.4, 0.25: 0.2}).value == pytest.approx(1.0)
    assert not halving_record({1.0: 0.8, 0.5: 0.8, 0.25: 0.8}).holds


def test_one_popping_frame_or_switch_is_enough_to_fail():
    excess = {Mode.BOUNDED: [0.0, 0.003, 0.0], Mode.ADAPTIVE: [0.0, 0.01, 0.0]}
    frame, adaptive, count, switch = Popping(excess, [("a to b", 0.0001)]).records()
    assert not frame.holds
    assert adaptive.value == 0.01
    assert count.value == 1
    assert count.holds
    assert switch.holds
    none = Popping(excess, []).records()
    assert not any(record.holds for record in none if "switch" in record.name)


def test_every_switch_between_two_frames_is_found():
    scene = RenderedScene("strokes", make_copy(0.6 * strokes()))
    views = [View(np.deg2rad(-90), np.deg2rad(80 - 60 * n), 3000 * 0.02**n) for n in range(2)]
    found = list(switches(scene, views))
    assert len(found) > 3
    for (before, _), (after, _) in pairwise(found):
        assert before.split(" to ")[1] == after.split(" to ")[0]
    for what, (first, last) in found:
        assert len(set(what.split(" to "))) == 2
        assert last.distance_mm == pytest.approx(first.distance_mm, rel=1e-4)


def test_parts_that_are_not_there_are_refused():
    with pytest.raises(ValueError, match="nothing"):
        bench(parts=["nothing"])
