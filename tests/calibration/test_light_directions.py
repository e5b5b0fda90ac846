from __future__ import annotations

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.light_directions import (
    LightDirections,
    directions_from_circles,
    directions_from_spheres,
    read_lp,
    write_lp,
)
from calibration.mirror_spheres import MirrorSphere
from workstation.benchmarks.lights import LENS, SPHERE_MM, highlight_pixels

DIRECTIONS = np.array([[0.0, 0, 1], [0.6, 0, 0.8], [0, -0.6, 0.8]])
NAMES = ("a.tif", "folder with blanks/b c.tif", "d.tif")


def test_lights_come_back_from_their_file(tmp_path):
    write_lp(tmp_path / "dome.lp", LightDirections(NAMES, DIRECTIONS))
    found = read_lp(tmp_path / "dome.lp")
    assert found.pictures == NAMES
    np.testing.assert_allclose(found.directions, DIRECTIONS, atol=1e-8)


def test_pictures_of_another_machine_are_found_by_name(tmp_path):
    (tmp_path / "a.tif").write_bytes(b"")
    (tmp_path / "dome.lp").write_text("1\r\nC:\\scans\\dome\\a.tif 0 0.01 0.999\r\n\r\n")
    assert read_lp(tmp_path / "dome.lp", pictures=tmp_path).pictures == ("a.tif",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("dome\na 0 0 1\n", "no number of pictures"),
        ("-1\n", "no number of pictures"),
        ("99999999999999999999\n", "no number of pictures"),
        ("3\na 0 0 1\nb 0 0 1\n", "says 3 pictures, and 2 follow"),
        ("1\na 0 0 1\nb 0 0 1\n", "says 1 pictures, and 2 follow"),
        ("1\na 0 0\n", "line 2: a picture's name and three numbers"),
        ("1\na 0 x 1\n", "line 2: '0 x 1' are no numbers"),
        ("2\nb 0 0 1\na 0 nan 1\n", "line 3: the direction is not finite"),
        ("1\na 0 inf 1\n", "not finite"),
        ("1\na 0 0 0\n", "zero is no direction"),
        ("1\na 0 0 1e9\n", "length"),
        ("2\na 0 0 1\na 0 0.6 0.8\n", "two directions"),
    ],
)
def test_malformed_files_are_refused_by_line(tmp_path, text, message):
    (tmp_path / "dome.lp").write_text(text)
    with pytest.raises(CalibrationError, match=message):
        read_lp(tmp_path / "dome.lp")


def test_missing_files_and_pictures_are_named(tmp_path):
    with pytest.raises(CalibrationError, match="no such file"):
        read_lp(tmp_path / "none.lp")
    (tmp_path / "bytes.lp").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CalibrationError, match="not a readable text file"):
        read_lp(tmp_path / "bytes.lp")
    (tmp_path / "dome.lp").write_text("1\n../../etc/passwd 0 0 1\n")
    with pytest.raises(CalibrationError, match="line 2: picture"):
        read_lp(tmp_path / "dome.lp", pictures=tmp_path)


def test_names_that_cannot_be_written_are_refused(tmp_path):
    with pytest.raises(CalibrationError, match="cannot be written"):
        write_lp(tmp_path / "dome.lp", LightDirections(("a\nb",), DIRECTIONS[:1]))
    assert not (tmp_path / "dome.lp").exists()
    with pytest.raises(CalibrationError, match="no unit vector"):
        LightDirections(("a",), np.zeros((1, 3)))


def test_directions_from_circles_of_a_distant_camera():
    circles = np.array([[100.0, 80, 40], [300, 90, 35]])
    # The normal halves the angle between sight and light.
    half = DIRECTIONS + np.array([0, 0, 1])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    pixels = circles[:, None, :2] + circles[:, None, 2:] * half[:, :2] * [1, -1]
    found, spread = directions_from_circles(circles, pixels)
    np.testing.assert_allclose(found, DIRECTIONS, atol=1e-12)
    np.testing.assert_allclose(spread, 0, atol=1e-12)
    pixels[0, 1] = np.nan
    found, spread = directions_from_circles(circles, pixels)
    np.testing.assert_allclose(found, DIRECTIONS, atol=1e-12)
    assert np.isnan(spread[1])
    pixels[1, 1] = np.nan
    with pytest.raises(CalibrationError, match="picture 2: no sphere"):
        directions_from_circles(circles, pixels)
    with pytest.raises(CalibrationError, match="outside of sphere 1"):
        directions_from_circles(circles, circles[:, None, :2] + [[[50.0, 0]], [[0, 0]]])


def test_directions_from_spheres_through_a_lens():
    towards = DIRECTIONS * [1, -1, -1]
    centres = np.array([[-140.0, 70, 880], [150, -80, 880]])
    spheres = [MirrorSphere(centre, SPHERE_MM, np.zeros((3, 3))) for centre in centres]
    pixels = np.stack([highlight_pixels(centre, centre + 1e7 * towards) for centre in centres])
    found, spread = directions_from_spheres(spheres, pixels, LENS)
    np.testing.assert_allclose(found, DIRECTIONS, atol=1e-5)
    assert (spread < 1e-5).all()
