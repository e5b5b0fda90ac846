from __future__ import annotations

import cv2
import numpy as np
import OpenEXR
import pytest
from full_disk import largest_file

from render.errors import RenderError
from render.painter import RenderedImage
from render.painting_node import Mode
from render.picture_files import write_contact_sheet, write_picture, write_picture_table


def picture(level=0.18, rows=6, cols=8):
    radiance = np.full((rows, cols, 3), level, np.float32)
    radiance[0, 0] = (0.5, 0.002, 3.0)
    ones = np.ones((rows, cols), np.float32)
    return RenderedImage(radiance, ones, 40 * ones)


def test_png_is_srgb_after_the_exposure(tmp_path):
    write_picture(picture(), tmp_path / "p.png")
    blue_first = cv2.imread(str(tmp_path / "p.png"))
    # IEC 61966-2-1: 0.18 → 118, 0.5 → 188; 0.002 lies on the straight part, 12.92 · 0.002 · 255.
    assert blue_first[0, 0].tolist() == [255, 7, 188]
    assert blue_first[3, 3].tolist() == [118, 118, 118]
    assert picture(0.045).encoded(exposure=4.0)[3, 3].tolist() == [118, 118, 118]
    for exposure in (0.0, -1.0, float("nan")):
        with pytest.raises(RenderError, match="exposure"):
            picture().encoded(exposure=exposure)


def test_exr_holds_what_was_drawn(tmp_path):
    shown = picture()
    write_picture(shown, tmp_path / "p.exr", exposure=9.0)
    channels = OpenEXR.File(str(tmp_path / "p.exr"), separate_channels=True).channels()
    for n, name in enumerate("RGB"):
        np.testing.assert_array_equal(channels[name].pixels, shown.radiance[..., n])
    np.testing.assert_array_equal(channels["A"].pixels, shown.coverage)
    np.testing.assert_array_equal(channels["Z"].pixels, shown.depth_mm)


def test_places_that_cannot_be_written_are_named(tmp_path):
    with pytest.raises(RenderError, match=r"p\.tiff: pictures are written as"):
        write_picture(picture(), tmp_path / "p.tiff")
    with pytest.raises(RenderError, match="there is no folder"):
        write_picture(picture(), tmp_path / "none" / "p.png")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", ["png", "exr"])
@pytest.mark.parametrize("missing", [1, 200])
def test_a_disk_that_is_full_leaves_no_picture(tmp_path, suffix, missing):
    noise = np.random.default_rng(0).random((40, 50, 3)).astype(np.float32)
    shown = RenderedImage(noise, noise[..., 0], noise[..., 1])
    file = tmp_path / f"p.{suffix}"
    write_picture(shown, file)
    whole = file.stat().st_size
    file.unlink()
    refused = pytest.raises(OSError, match=r"too large|disk full")
    with refused, largest_file(whole - missing):
        write_picture(shown, file)
    assert not list(tmp_path.iterdir())


def test_a_table_of_pictures_is_whole_or_not_at_all(tmp_path):
    modes, views = [Mode.MESH, Mode.BUMP], ["near-front", "-90,20,40"]
    write_picture_table(lambda mode, view: picture(), modes, views, tmp_path / "all")
    assert sorted(path.name for path in (tmp_path / "all").iterdir()) == [
        *("bump_-90,20,40.png", "bump_near-front.png", "contact.png"),
        *("mesh_-90,20,40.png", "mesh_near-front.png"),
    ]

    def fail_late(mode, view):
        if mode is Mode.BUMP:
            raise RenderError("no memory")
        return picture()

    with pytest.raises(RenderError, match="no memory"):
        write_picture_table(fail_late, modes, views, tmp_path / "half")
    assert [path.name for path in tmp_path.iterdir()] == ["all"]


def test_a_contact_sheet_has_every_picture_in_its_place(tmp_path):
    shades = [[np.full((30, 40, 3), 40 * r + 20 * c, np.uint8) for c in range(3)] for r in range(2)]
    write_contact_sheet(shades, ["one", "two"], ["a", "b", "c"], tmp_path / "sheet.png")
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    for r in range(2):
        for c in range(3):
            assert (sheet[28 + 34 * r + 15, 90 + 44 * c + 20] == 40 * r + 20 * c).all()
