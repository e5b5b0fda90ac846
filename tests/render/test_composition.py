from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from rendered_heights import heights_hit
from synthetic_copy import make_copy, strokes

from fitting.digital_copy import ReflectanceMaps
from render.errors import RenderError
from render.opengl import GL, pyrender
from render.painter import Light, painting_scene
from render.painting_maps import PaintingMaterial
from render.painting_node import Mode, painting_mesh
from render.painting_renderer import RoomLight
from render.views import View

FRONT = View(np.deg2rad(-90.0), np.deg2rad(89.99), 150.0)


def board(z, **material):
    corners = np.array([[-60, -50, z], [60, -50, z], [60, 50, z], [-60, 50, z]], np.float32)
    paint = pyrender.MetallicRoughnessMaterial(doubleSided=True, **material)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    up = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    return pyrender.Mesh([pyrender.Primitive(corners, indices=faces, normals=up, material=paint)])


@pytest.mark.parametrize("mode", list(Mode))
def test_gaps_are_seen_through_and_other_nodes_compose_by_depth(painter, mode):
    mask = np.ones((120, 160), bool)
    mask[50:70, 70:90] = False
    copy = make_copy(strokes(), mask=mask)
    scene = painting_scene(copy, painting_mesh(copy, mode), FRONT, Light(), 4 / 3)
    assert painter.paint_scene(scene, width=240, height=180).coverage[90, 120] == 0

    red = {"emissiveFactor": [1.0, 0.0, 0.0]}
    behind = scene.add(board(-5.0, **red))
    picture = painter.paint_scene(scene, width=240, height=180)
    assert picture.radiance[90, 120, 0] > 0.9
    assert picture.radiance[60, 60, 1] > 0.02
    scene.remove_node(behind)
    scene.add(board(20.0, **red))
    picture = painter.paint_scene(scene, width=240, height=180)
    assert picture.radiance[60, 60, 0] > 0.9


@pytest.mark.parametrize("mode", [Mode.MESH, Mode.RELIEF, Mode.HYBRID])
def test_a_pane_through_the_relief_is_pierced_by_what_is_higher(painter, mode):
    copy = make_copy(strokes())
    level = copy.relief.delta0_mm + 0.8
    scene = painting_scene(copy, painting_mesh(copy, mode), FRONT, Light(), 4 / 3)
    relief = painter.paint_scene(scene, width=240, height=180)
    scene.add(board(level, emissiveFactor=[1.0, 0.0, 0.0], baseColorFactor=[0, 0, 0, 1]))
    cut = painter.paint_scene(scene, width=240, height=180)
    height = heights_hit(relief, FRONT)
    higher = height > level + 0.05
    lower = (height < level - 0.05) & (relief.coverage == 1)
    assert higher.mean() > 0.005
    assert (cut.radiance[higher][:, 1] > 0.02).mean() > 0.99
    assert (cut.radiance[lower][:, 0] > 0.9).mean() > 0.99


def test_walls_are_as_linear_as_the_painting(painter):
    scene = pyrender.Scene(bg_color=[0, 0, 0, 0], ambient_light=[0.25] * 3)
    scene.add(board(0.0, baseColorFactor=[0.5, 0.5, 0.5, 1.0], metallicFactor=0.0))
    scene.add(
        pyrender.PerspectiveCamera(yfov=0.6, aspectRatio=1, znear=1, zfar=1000), pose=FRONT.pose()
    )
    assert painter.paint_scene(scene, width=16, height=16).radiance[8, 8] == pytest.approx(0.125)
    # Nor is it cut off at white.
    scene.ambient_light = [8.0] * 3
    assert painter.paint_scene(scene, width=16, height=16).radiance[8, 8] == pytest.approx(4.0)


def test_spot_and_directional_lights_follow_lambert(painter):
    copy = make_copy(np.zeros((60, 80)))
    dark = Light(strength=0.0, ambient=0.0)

    def radiance(light, pose):
        scene = painting_scene(copy, painting_mesh(copy, Mode.RELIEF), FRONT, dark, 4 / 3)
        scene.add(light, pose=pose)
        return painter.paint_scene(scene, width=240, height=180).radiance[90, :, 0]

    slant = View(0.4, 0.7, 80.0)
    sun = pyrender.DirectionalLight(color=[1.0, 1.0, 1.0], intensity=3.0)
    assert radiance(sun, slant.pose())[120] == pytest.approx(
        0.8 / np.pi * 3 * np.sin(0.7), rel=0.01
    )
    spot = pyrender.SpotLight(
        color=[1.0, 1.0, 1.0], intensity=3.0 * 80**2, innerConeAngle=0.1, outerConeAngle=0.12
    )
    line = radiance(spot, View(np.deg2rad(-90.0), np.deg2rad(89.9), 80.0).pose())
    assert line[120] == pytest.approx(0.8 / np.pi * 3, rel=0.01)
    # The cone's edge lies 80 mm · tan 0.12 = 9.6 mm from the middle; the canvas ends at 20 mm.
    shown_mm = np.abs(np.arange(240) - 119.5) * 2 * 150 * np.tan(FRONT.field_of_view / 2) / 180
    assert (line[shown_mm < 7.9] > 0.7).all()
    assert (line[(shown_mm > 9.9) & (shown_mm < 19)] == 0).all()


def test_a_painting_turned_with_its_node_looks_the_same(painter):
    copy = make_copy(strokes())
    pictures = []
    turn = View(0.3, 0.9, 200.0).pose()
    for pose in (np.eye(4), turn):
        scene = painting_scene(copy, painting_mesh(copy, Mode.HYBRID), FRONT, Light(), 4 / 3)
        for node in list(scene.nodes):
            scene.set_pose(node, pose @ scene.get_pose(node))
        pictures.append(painter.paint_scene(scene, width=240, height=180).radiance)
    assert np.quantile(np.abs(pictures[0] - pictures[1]), 0.999) < 0.02


def test_a_scaled_painting_is_refused(painter):
    copy = make_copy(np.zeros((20, 20)))
    scene = painting_scene(copy, painting_mesh(copy, Mode.BUMP), FRONT, Light(), 1.0)
    (node,) = scene.mesh_nodes
    scene.set_pose(node, np.diag([0.001, 0.001, 0.001, 1.0]))
    with pytest.raises(RenderError, match="in mm"):
        painter.paint_scene(scene, width=16, height=16)


def test_without_opengl_libraries_the_error_names_the_packages():
    program = """
import ctypes, ctypes.util
whole, find = ctypes.CDLL, ctypes.util.find_library
class Without(whole):
    def __init__(self, name, *rest, **options):
        if name and any(part in str(name) for part in ("EGL", "libGL", "OpenGL")):
            raise OSError(f"{name}: cannot open shared object file")
        super().__init__(name, *rest, **options)
ctypes.CDLL = Without
ctypes.util.find_library = lambda name: None if "GL" in name else find(name)
from fitting.digital_copy import ReflectanceMaps
from render.errors import RenderError
try:
    from render.painter import Painter
    Painter()
except RenderError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=dict(os.environ)
    )
    assert done.returncode == 0, done.stderr
    assert "install Debian's libegl1, libgl1 and libgl1-mesa-dri" in done.stdout


def two_paintings(mode):
    """One large, and 25 mm before its right half a small one, lit by two spots from the left."""
    large = make_copy(np.zeros((120, 160)))
    small = make_copy(np.zeros((60, 40)))
    dark = Light(strength=0.0, ambient=0.0)
    scene = painting_scene(large, painting_mesh(large, mode), FRONT, dark, 4 / 3)
    ahead = np.eye(4)
    ahead[:3, 3] = (20, 0, 25)
    scene.add(painting_mesh(small, mode), pose=ahead)
    for elevation in (45.0, 60.0):
        spot = pyrender.SpotLight(
            color=[1.0] * 3, intensity=200.0**2, innerConeAngle=0.5, outerConeAngle=0.6
        )
        scene.add(spot, pose=View(np.pi, np.deg2rad(elevation), 200.0).pose())
    return scene


@pytest.mark.parametrize("mode", [Mode.EXACT, Mode.BOUNDED])
def test_a_painting_hides_and_shades_another_from_each_light(painter, mode):
    scene = two_paintings(mode)
    size = {"width": 240, "height": 180}
    bare = painter.paint_scene(scene, **size)
    shaded = painter.paint_scene(scene, **size, room_light=RoomLight())
    half = np.tan(FRONT.field_of_view / 2)
    x = (2 * (np.arange(240) + 0.5) / 240 - 1) * half * 4 / 3
    # The small one, from 10 to 30 mm, is nearer to the camera, and in no shadow.
    small = (x * 125 > 10.5) & (x * 125 < 29.5)
    assert bare.depth_mm[90, small] == pytest.approx(125, abs=0.1)
    assert shaded.radiance[90, small] == pytest.approx(bare.radiance[90, small])
    large = ((np.abs(x * 150) < 39) & ~((x * 125 > 9.5) & (x * 125 < 30.5))).nonzero()[0]
    hidden = []
    for elevation in np.deg2rad([45.0, 60.0]):
        lamp = 200 * np.array([-np.cos(elevation), np.sin(elevation)])
        passes = lamp[0] + (x[large] * 150 - lamp[0]) * (lamp[1] - 25) / lamp[1]
        hidden.append((passes > 10) & (passes < 30))
    count = np.sum(hidden, axis=0)
    share = shaded.radiance[90, large, 0] / bare.radiance[90, large, 0]
    # Away from the edges of shadows, which the map draws to a millimetre.
    steady = np.array([len(set(count[max(i - 3, 0) : i + 4])) == 1 for i in range(len(count))])
    assert {0, 1} <= set(count[steady])
    assert (share[steady & (count == 0)] > 0.999).all()
    assert ((share > 0.2) & (share < 0.8))[steady & (count == 1)].all()
    assert (share[steady & (count == 2)] < 1e-3).all()


def test_reflectance_is_kept_in_half_precision_with_all_its_levels(painter):
    copy = make_copy(strokes())
    texel = np.ones((120, 160, 3), np.float32)
    lobe = np.tile(np.array([-1, -1, 1, 5], np.float32), (120, 160, 1))
    copy = replace(
        copy, reflectance=ReflectanceMaps(diffuse=0.2 * texel, specular=0.1 * texel, lobe=lobe)
    )
    material = PaintingMaterial(copy)
    scene = painting_scene(
        copy, painting_mesh(copy, Mode.BUMP, material=material), FRONT, Light(), 4 / 3
    )
    painter.paint_scene(scene, width=32, height=24)
    kept = {}
    for name, texture in material.maps.items():
        texture._bind()
        sizes = []
        while True:
            level = len(sizes)
            width = GL.glGetTexLevelParameteriv(GL.GL_TEXTURE_2D, level, GL.GL_TEXTURE_WIDTH)
            if not width:
                break
            sizes.append(int(width))
        form = GL.glGetTexLevelParameteriv(GL.GL_TEXTURE_2D, 0, GL.GL_TEXTURE_INTERNAL_FORMAT)
        kept[name] = (int(form), sizes)
    sizes = [160, 80, 40, 20, 10, 5, 2, 1]
    assert kept == {
        "relief_map": (int(GL.GL_RGBA32F), sizes),
        "diffuse_map": (int(GL.GL_RGB16F), sizes),
        "specular_map": (int(GL.GL_RGB16F), sizes),
        "lobe_map": (int(GL.GL_RGBA16F), sizes),
    }
