from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from synthetic_copy import make_copy, strokes

from render.errors import RenderError
from render.views import NamedView, View, named_view, parse_view


@pytest.fixture(scope="module")
def copy():
    return make_copy(strokes(), cell=12, smallest_mm2=2.0)


def test_views_are_parsed_or_refused(copy):
    view = parse_view("-90,30,400", copy, aspect=4 / 3)
    np.testing.assert_allclose(view.position, [0, -400 * np.cos(np.pi / 6), 200], atol=1e-9)
    np.testing.assert_allclose(view.pose()[:3, :3].T @ view.pose()[:3, :3], np.eye(3), atol=1e-12)
    for bad in ("sideways", "1,2", "1,2,nan", "0,100,400", "0,30,-1"):
        with pytest.raises(RenderError):
            parse_view(bad, copy, aspect=4 / 3)
    with pytest.raises(RenderError, match="field of view"):
        dataclasses.replace(view, field_of_view=0.0)


@pytest.mark.parametrize("elevation", [5.0, 15.0, 40.0, 82.0])
def test_a_camera_that_goes_round_never_turns_suddenly(elevation):
    azimuths = np.deg2rad(np.arange(0.0, 360.25, 0.25))
    poses = [View(a, np.deg2rad(elevation), 100.0).pose()[:3, :3] for a in azimuths]
    cosines = [(np.trace(a.T @ b) - 1) / 2 for a, b in pairwise(poses)]
    # The canvas's top stays up, so the picture turns fastest where the camera passes below it.
    fastest = 0.25 / np.sin(np.deg2rad(elevation))
    assert np.rad2deg(np.arccos(np.clip(cosines, -1, 1))).max() < 1.1 * fastest + 0.01


def test_up_is_the_canvas_top_from_every_side():
    for azimuth in np.deg2rad([-170.0, -90.0, -30.0, 45.0]):
        up = View(azimuth, 0.5, 100.0).pose()[:3, 1]
        assert up[1] > 0
    below = View(np.deg2rad(-90.0), 0.0, 100.0).pose()[:3, :3]
    np.testing.assert_allclose(below, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-9)


def project(view, points, aspect):
    local = (np.asarray(points) - view.position) @ view.pose()[:3, :3]
    half = np.tan(view.field_of_view / 2)
    return local[:, :2] / -local[:, 2:] / [half * aspect, half]


@pytest.mark.parametrize("shape", [(120, 160), (160, 60), (40, 200)])
@pytest.mark.parametrize("aspect", [4 / 3, 0.75])
@pytest.mark.parametrize("angle", ["front", "grazing"])
def test_named_views_frame_what_they_say(shape, aspect, angle):
    copy = make_copy(np.zeros(shape))
    width, height = copy.height_field.size_mm
    corners = [[x * width / 2, y * height / 2, 0] for x in (-1, 1) for y in (-1, 1)]
    spans = {}
    for distance in ("near", "inshot", "far"):
        view = named_view(copy, NamedView(f"{distance}-{angle}"), aspect=aspect)
        spans[distance] = project(view, corners, aspect)
        expected = 82 if angle == "front" else 15
        assert np.rad2deg(view.elevation) == pytest.approx(expected)
    assert np.abs(spans["inshot"]).max() == pytest.approx(0.94)
    # A tenth, but for the perspective of the near edge in shot.
    assert 0.04 < np.ptp(spans["far"], axis=0).max() / 2 <= 0.1


def test_a_near_grazing_camera_stays_above_the_relief():
    steep = make_copy(40 * np.ones((120, 160)) * np.linspace(0, 1, 160))
    view = named_view(steep, NamedView.NEAR_GRAZING, aspect=4 / 3)
    assert view.position[2] > steep.height_field.height_range_mm[1]
