from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest
from full_disk import largest_file
from synthetic_copy import make_copy, strokes

from render.errors import RenderError
from render.gallery import Gallery, Hanging
from render.gallery_room import label_mesh
from render.gallery_walk import Walk
from render.picture_frames import FrameFinish, Opening, frame_mesh
from render.surface_shapes import bounds
from render.video_files import video_file

SIZE = {"width": 192, "height": 108}
DOT = {"width": 1, "height": 9, "fps": 24}


@pytest.fixture(scope="module")
def copies():
    large = make_copy(strokes())
    small = make_copy(strokes(60, 40), pitch=0.4)
    return [Hanging(large, "large"), Hanging(small, "a small one"), Hanging(large, "again")]


def seen_at(gallery, point):
    """Where a point of the scene is in a picture, (row, col), and its distance along the axis."""
    camera = gallery.scene.main_camera_node
    inverse = np.linalg.inv(gallery.scene.get_pose(camera))
    x, y, z = (inverse @ np.append(point, 1))[:3]
    half = np.tan(camera.camera.yfov / 2)
    col = (x / -z / half * SIZE["height"] / SIZE["width"] + 1) / 2 * SIZE["width"]
    row = (1 - y / -z / half) / 2 * SIZE["height"]
    return int(row), int(col), -z


def middle_of(gallery, name):
    (node,) = (node for node in gallery.scene.mesh_nodes if node.name == name)
    return gallery.scene.get_pose(node)[:3, 3]


def test_a_walk_shows_every_painting_lit_and_in_its_place(painter, copies):
    gallery = Gallery(copies)
    seen = set()
    for share in (0.0, 0.24, 0.5, 0.53, 0.8):
        picture = gallery.paint(painter, share, **SIZE)
        assert np.isfinite(picture.radiance).all()
        # A room has no holes.
        assert picture.coverage.min() == 1
        for hanging in copies:
            row, col, distance = seen_at(gallery, middle_of(gallery, hanging.title))
            if not (10 < row < 98 and 10 < col < 182):
                continue
            seen.add(hanging.title)
            found = picture.depth_mm[row, col]
            # The relief is 3 mm high.
            assert abs(found - distance) < 4
            assert 0.2 < picture.radiance[row, col].mean() < 1.5
    assert seen == {"large", "a small one", "again"}


def test_the_wall_is_darkest_where_a_frame_keeps_the_lamp_away(painter, copies):
    gallery = Gallery(copies[:1])
    # Walked to where the camera stands before the painting.
    picture = gallery.paint(painter, 0.85 / 1.6, **SIZE)
    middle = middle_of(gallery, "large")
    width, height = copies[0].copy.height_field.size_mm
    frame = 0.11 * np.sqrt(width * height)
    foot = middle[1] - height / 2 - frame

    def wall(x, y):
        row, col, _ = seen_at(gallery, (middle[0] + x, y, 0.0))
        return picture.radiance[row, col].mean()

    # Below the frame there is its shadow, beside it light; both as far from the lamp's axis.
    assert wall(0, foot - 2.0) < 0.6 * wall(0, foot - 12.0)
    assert wall(-width / 2 - frame - 3, middle[1]) > 1.5 * wall(0, foot - 2.0)


def test_a_white_copy_is_lit_to_white(painter):
    gallery = Gallery([Hanging(make_copy(np.zeros((60, 80))), "flat")])
    picture = gallery.paint(painter, 0.85 / 1.6, **SIZE)
    row, col, _ = seen_at(gallery, middle_of(gallery, "flat"))
    # Plaster reflects 0.8 of the light; ambient light comes a little less from the wall's side.
    assert picture.radiance[row, col].mean() == pytest.approx(0.8, abs=0.05)


def test_tall_pictures_see_as_far_to_the_sides(painter, copies):
    gallery = Gallery(copies)
    camera = gallery.scene.main_camera_node.camera
    gallery.paint(painter, 0.5, width=16, height=9)
    usual = camera.yfov
    gallery.paint(painter, 0.5, width=8, height=16)
    assert np.tan(camera.yfov / 2) * 0.5 == pytest.approx(np.tan(usual / 2) * 4 / 3)


def test_a_walk_is_smooth_goes_one_way_and_stands_nearer_to_small_paintings():
    walk = Walk(np.array([0.0, 900.0, 1500.0]), np.array([500.0, 100.0, 300.0]), 975.0, 500.0)
    poses = np.array([walk.pose(share) for share in np.linspace(0, 1, 400)])
    assert (np.diff(poses[:, 0, 3]) > 0).all()
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert np.abs(np.diff(steps)).max() < 0.1 * steps.mean() + 1.0
    turns = np.einsum("nij,nij->n", poses[1:, :3, :3], poses[:-1, :3, :3])
    assert turns.min() > 3 - 2e-3
    for rotation in poses[::50, :3, :3]:
        assert rotation.T @ rotation == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
    before = [poses[np.argmin(np.abs(poses[:, 0, 3] - x)), 2, 3] for x in walk.middles]
    assert before[1] < before[2] < before[0]


@pytest.mark.parametrize("finish", list(FrameFinish))
def test_a_frame_faces_outwards_closes_around_its_opening_and_reaches_the_wall(finish):
    opening = Opening(np.array([-50.0, -30, 4]), np.array([50.0, 30, 12]))
    mesh = frame_mesh(opening, width=10.0, wall_z=0.0, finish=finish)
    low, high = mesh.bounds
    assert low == pytest.approx([-60, -40, 0])
    assert high[:2] == pytest.approx([60, 40])
    assert 12 < high[2] < 12 + 10
    for primitive in mesh.primitives:
        corners = primitive.positions[primitive.indices.astype(int)]
        facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = primitive.normals[primitive.indices.astype(int)].mean(axis=1)
        area = np.linalg.norm(facing, axis=1)
        assert ((facing * normal).sum(axis=1)[area > 1e-6] > 0).all()
        assert np.linalg.norm(primitive.normals, axis=1) == pytest.approx(1, abs=1e-5)


def test_a_deep_relief_stands_proud_of_its_frame(copies):
    dome = np.zeros((60, 80))
    dome[20:40, 30:50] = 25.0
    gallery = Gallery([Hanging(make_copy(dome), "deep")])
    frames = [node.mesh.bounds[1][2] for node in gallery.scene.mesh_nodes if node.name is None]
    (node,) = (node for node in gallery.scene.mesh_nodes if node.name == "deep")
    top = gallery.scene.get_pose(node)[2, 3] + bounds(make_copy(dome))[1][2]
    assert top > 20 + sorted(frames)[0]


def card(title):
    (part,) = label_mesh(title, 40.0).primitives
    return part.material.baseColorTexture.source[..., :3]


def test_labels_hold_any_title():
    names = [
        "Müller",
        "Moller",
        "M??ller",
        "Château d'If, at the end of a long day",
        "",
        "..." * 40,
    ]
    cards = [card(name) for name in names]
    for one, other in pairwise(cards):
        assert not np.array_equal(one, other)
    for shown in cards:
        # Nothing runs off the card.
        assert (shown[:, :24] == 236).all()
        assert (shown[:, 488:] == 236).all()


def test_a_gallery_without_copies_is_refused():
    with pytest.raises(RenderError, match="at least one"):
        Gallery([])


def test_a_video_holds_its_pictures_and_no_other_codec_is_an_error(tmp_path, monkeypatch):
    random = np.random.default_rng(0)
    flat = [np.full((51, 81, 3), level, np.uint8) for level in random.integers(30, 220, 5)]
    with video_file(tmp_path, "walk", width=81, height=51, fps=24) as film:
        for picture in flat:
            film.add(picture)
    reader = cv2.VideoCapture(str(film.path))
    for picture in flat:
        there, found = reader.read()
        assert there
        assert found.shape == (50, 80, 3)
        assert np.abs(found.mean() - picture.mean()) < 6
    assert not reader.read()[0]
    monkeypatch.setattr(cv2.VideoWriter, "fourcc", staticmethod(lambda *_: 0x30303030))
    refused = pytest.raises(RenderError, match="can write no video")
    with refused, video_file(tmp_path, "other", width=80, height=50, fps=24):
        pass
    assert [file.name for file in tmp_path.iterdir()] == [film.path.name]


def test_a_video_that_the_disk_has_no_room_for_is_an_error(tmp_path):
    random = np.random.default_rng(0)
    pictures = random.integers(0, 255, (5, 60, 80, 3)).astype(np.uint8)

    def film(name):
        with video_file(tmp_path, name, width=80, height=60, fps=24) as made:
            for picture in pictures:
                made.add(picture)
        return made.path

    whole = film("whole").stat().st_size
    refused = pytest.raises(RenderError, match="of 5 pictures; is the disk full")
    with refused, largest_file(whole - 100):
        film("cut")
    with pytest.raises(RenderError, match="at least 2×2"), video_file(tmp_path, "dot", **DOT):
        pass
    assert [file.name for file in tmp_path.iterdir()] == ["whole.mp4"]
