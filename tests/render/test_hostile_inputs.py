from __future__ import annotations

import numpy as np
import pytest
from synthetic_copy import make_copy, strokes

from render.painter import Light
from render.painting_node import Mode
from render.views import View


@pytest.fixture(scope="module")
def copy():
    mask = np.ones((120, 160), bool)
    mask[50:70, 70:90] = False
    return make_copy(strokes(), mask=mask)


def paint(painter, copy, view, **options):
    return painter.paint(copy, view, width=64, height=48, **options)


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("elevation", [-90.0, 0.0, 0.5, 30.0])
@pytest.mark.parametrize("distance", [1e-3, 200.0, 1e6])
def test_no_view_gives_anything_but_a_picture(painter, copy, mode, elevation, distance):
    view = View(np.deg2rad(-70.0), np.deg2rad(elevation), distance)
    picture = paint(painter, copy, view, mode=mode)
    assert np.isfinite(picture.radiance).all()
    assert np.isfinite(picture.depth_mm).all()
    if elevation == 30.0 and distance == 200.0:
        assert picture.coverage.mean() > 0.05
    # From behind the plane alone is seen; steep strokes may show a front when seen from the side.
    if elevation == -90 and mode not in (Mode.BUMP, Mode.HYBRID, Mode.ADAPTIVE):
        assert picture.coverage.max() == 0


@pytest.mark.parametrize("mode", list(Mode))
def test_a_lamp_in_the_plane_of_the_canvas_or_behind_it(painter, copy, mode):
    view = View(np.deg2rad(-90.0), np.deg2rad(60.0), 150.0)
    pictures = {
        elevation: paint(
            painter, copy, view, mode=mode, light=Light(elevation=np.deg2rad(elevation), ambient=0)
        ).radiance
        for elevation in (45.0, 0.0, -45.0)
    }
    assert all(np.isfinite(radiance).all() for radiance in pictures.values())
    shown = {elevation: radiance.max() for elevation, radiance in pictures.items()}
    assert shown[45.0] > shown[0.0]


@pytest.mark.parametrize("mode", list(Mode))
def test_a_panorama_as_wide_as_textures_may_be(painter, mode):
    wide = make_copy(np.zeros((4, 16384)) + np.linspace(0, 1, 16384), pitch=0.01)
    view = View(np.deg2rad(-90.0), np.deg2rad(80.0), 400.0)
    picture = paint(painter, wide, view, mode=mode)
    assert np.isfinite(picture.radiance).all()
