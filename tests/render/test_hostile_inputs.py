from __future__ import annotations

import numpy as np
import pytest
from pyrender.platforms import egl
from synthetic_copy import make_copy, strokes

from fitting.errors import FittingError
from render import opengl
from render.errors import RenderError
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


ON_TRIANGLES = (Mode.MESH, Mode.EXACT, Mode.BOUNDED)


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1)])
def test_copies_without_a_square_of_texels(painter, mode, shape):
    thin = make_copy(np.zeros(shape))
    view = View(np.deg2rad(-90.0), np.deg2rad(80.0), 4.0)
    if mode in ON_TRIANGLES:
        with pytest.raises(RenderError, match="make no triangle"):
            paint(painter, thin, view, mode=mode)
        return
    picture = paint(painter, thin, view, mode=mode)
    assert np.isfinite(picture.radiance).all()
    assert picture.coverage.max() == 1


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("level", [0.0, -3.0])
def test_a_relief_without_height(painter, mode, level):
    flat = make_copy(np.full((30, 40), level))
    for elevation in (80.0, 10.0):
        view = View(np.deg2rad(-90.0), np.deg2rad(elevation), 60.0)
        picture = paint(painter, flat, view, mode=mode)
        assert np.isfinite(picture.radiance).all()
        assert picture.coverage.max() == 1


def test_an_empty_height_map_is_no_copy():
    with pytest.raises(FittingError, match="empty"):
        make_copy(np.zeros((20, 30)), mask=np.zeros((20, 30), bool))


def test_an_opengl_that_is_too_old_says_what_to_install(monkeypatch):
    real = opengl.GL.glGetIntegerv

    def old(name):
        return {opengl.GL.GL_MAJOR_VERSION: 3, opengl.GL.GL_MINOR_VERSION: 3}.get(name) or real(
            name
        )

    monkeypatch.setattr(opengl.GL, "glGetIntegerv", old)
    with pytest.raises(RenderError, match=r"OpenGL 3\.3 is older than the 4\.1.*install Debian's"):
        opengl.HeadlessContext()


def test_a_missing_egl_driver_says_what_to_install(monkeypatch):
    def none(index):
        raise ValueError(f"Invalid device ID ({index})")

    monkeypatch.setattr(egl, "get_device_by_index", none)
    with pytest.raises(RenderError, match=r"no OpenGL without a display.*install Debian's libegl1"):
        opengl.HeadlessContext()
