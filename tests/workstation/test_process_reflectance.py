from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import OpenEXR
import pytest
import typer
from tiny_rig import TinyCamera, TinyScene, tiny_rig
from typer.testing import CliRunner

from acquisition.errors import SessionError
from acquisition.photograph_plan import PhotographChoices, plan_photographs
from acquisition.recording import record_plan
from acquisition.session_writer import SessionWriter
from devices.bayer import BayerPattern
from fitting.copy_files import read_copy
from workstation.commands import process
from workstation.destinations import DestinationError

ALBEDO = np.array([0.25, 0.5, 0.75])


@pytest.fixture
def dome(tmp_path):
    """A flat matt board of two colours under 18 lights."""
    random = np.random.default_rng(0)
    lines = ["18"]
    for number in range(18):
        polar, turn = np.radians(15 + 3 * number), 2.4 * number
        x, y = np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn)
        linear = np.ones((24, 32, 1)) * ALBEDO * np.cos(polar)
        linear[:, 16:] *= 0.5
        linear = linear + 0.001 * random.standard_normal(linear.shape)
        picture = np.clip(np.rint(linear * 65535), 0, 65535).astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"{number:02}.png"), picture[..., ::-1])
        lines.append(f"{number:02}.png {x:.6f} {y:.6f} {np.cos(polar):.6f}")
    (tmp_path / "lights.lp").write_text("\n".join(lines) + "\n")
    return tmp_path / "lights.lp"


def run(*arguments):
    app = typer.Typer()
    process.register(app)
    return CliRunner().invoke(app, [*map(str, arguments)])


def test_pictures_with_light_directions_become_a_copy(dome, tmp_path):
    figures = tmp_path / "figures.json"
    out = tmp_path / "copy"
    result = run("--lp", dome, "--out", out, "--ggx", "--exact-maps", "--json", figures)
    assert result.exit_code == 0, result.output
    copy = read_copy(out)
    middle = copy.reflectance.diffuse[4:20, 3:13]
    assert np.median(middle, axis=(0, 1)) == pytest.approx(ALBEDO / np.pi, rel=0.01)
    held = json.loads(figures.read_text())["reflectance"]["held_out"]
    assert held["psnr_db"] > 35
    assert held["delta_e"] < 1.5
    assert (tmp_path / "copy-held-out.png").is_file()
    assert json.loads((out / "copy.json").read_text())["rounding"] is None
    with OpenEXR.File(str(out / "ggx.exr"), separate_channels=True) as file:
        albedo = np.array(file.channels()["albedo.G"].pixels)
    assert np.median(albedo[4:20, 3:13]) == pytest.approx(0.5, rel=0.02)


def test_figures_never_replace_a_picture_that_is_read(dome, tmp_path):
    picture = dome.with_name("07.png")
    before = picture.read_bytes()
    result = run("--lp", dome, "--out", tmp_path / "copy", "--json", picture)
    assert isinstance(result.exception, DestinationError)
    assert picture.read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "SESSION"),
        (["s", "--lp", "x.lp"], "not both"),
        (["s", "--photographs", "p"], "together"),
        (["s", "--ggx"], "ggx"),
    ],
)
def test_contradictions_are_usage_errors(tmp_path, arguments, message):
    result = run(*arguments, "--out", tmp_path / "copy")
    assert result.exit_code == 2
    assert message in result.output


class ColourCamera(TinyCamera):
    capabilities = replace(TinyCamera.capabilities, bayer=BayerPattern.GRBG)


def test_a_mosaic_that_is_not_the_camera_s_is_refused_before_any_stage(tmp_path):
    scene = TinyScene()
    rig = tiny_rig(scene, camera=ColourCamera(scene))
    choices = PhotographChoices(
        exposures_s=(0.1,), code_exposures_s=(0.1,), poses=2, steps=3, period_px=32.0
    )
    taken = tmp_path / "taken"
    with SessionWriter.create(taken, plan_photographs(rig, choices)) as writer:
        record_plan(writer, rig)
    given = ("--photographs", taken, "--lamps", tmp_path / "lamps.json", "--mosaic", "RGGB")
    refused = run(taken, *given, "--out", tmp_path / "copy").exception
    assert isinstance(refused, SessionError)
    assert "mosaic of GRBG, not RGGB" in str(refused)
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]
