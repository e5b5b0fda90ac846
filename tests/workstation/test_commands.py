from __future__ import annotations

import inspect
import json
import re
import shlex
import signal
import subprocess
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from impasto_command import IMPASTO, impasto
from synthetic_copy import make_copy, strokes
from synthetic_scan import expose, fringe_patterns, make_plan

from acquisition.patterns import Axis
from acquisition.session_writer import SessionWriter
from calibration.opencv_files import write_matrices
from devices.simulated.rig import demo_rig
from fitting.copy_files import read_copy, write_copy
from render.painting_node import Mode
from render.views import NamedView
from workstation import commands
from workstation.demonstration import record_simulated_scan

FIXTURES = Path(__file__).parents[2] / "fixtures"
CAPTURES, SIMULATED_RIG = FIXTURES / "captures", FIXTURES / "rigs" / "simulated.toml"


def test_help_names_every_command_and_each_shows_an_example():
    overview = impasto("--help")
    assert overview.returncode == 0
    app = typer.Typer()
    commands.register(app)
    names = [command.name for command in app.registered_commands]
    assert len(names) >= 11
    for command in names:
        assert command in overview.stdout
        assert "Example:" in impasto(command, "--help").stdout


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (f"scan {SIMULATED_RIG} --out s --dry-run --target-px inf", "--target-px: inf is not"),
        (f"scan {SIMULATED_RIG} --out s --dry-run --exposure 9 --exposure nan", "--exposure"),
        ("demo --seed 2147483648", "--seed"),
        ("process --lp lights.lp --out copy --pitch 0", "--pitch"),
        (f"scan {SIMULATED_RIG} --out s --dry-run --json /dev/null", "a device or pipe"),
    ],
)
def test_options_that_no_command_can_mean_are_refused_by_name(line, told, tmp_path):
    done = impasto(*line.split(), cwd=tmp_path)
    assert done.returncode == 2
    assert told in done.stderr
    assert not any(tmp_path.iterdir())


def examples():
    """Every command line of the commands' examples: the command, and its words."""
    app = typer.Typer()
    commands.register(app)
    for command in app.registered_commands:
        example = inspect.getdoc(command.callback).split("Example:")[1]
        for line in re.sub(r"\s*\\?\n {4,}", " ", example.replace("\n\n", "\0")).split("\0"):
            for name, words in re.findall(r"\bimpasto ([a-z]+) ([^;\n]*)", line):
                yield name, shlex.split(words)


def test_examples_are_what_commands_take(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    app = typer.Typer()
    commands.register(app)
    found = typer.main.get_command(app).commands
    shown = list(examples())
    assert {name for name, _ in shown} == set(found)
    for name, words in shown:
        # Options, the kinds of their values, and what cannot go without what.
        found[name].make_context(name, words).close()


def test_examples_run_in_a_folder_with_what_they_name(tmp_path):
    (tmp_path / "rig.toml").write_bytes(SIMULATED_RIG.read_bytes())
    record_simulated_scan(demo_rig(camera_width=80), tmp_path / "session")
    ran = {}
    for name, words in examples():
        if name in ("devices", "replay", "process", "render") and name not in ran:
            ran[name] = impasto(name, *words, cwd=tmp_path)
    assert len(ran) == 4
    assert {name: one.stderr for name, one in ran.items() if one.returncode} == {}
    for made in ("again", "copy", "grazing.png"):
        assert (tmp_path / made).exists()


def test_render_writes_linear_and_display_pictures(tmp_path):
    write_copy(make_copy(strokes()), tmp_path / "copy")
    for name in ("a.png", "a.exr"):
        done = impasto(
            *("render", tmp_path / "copy", "--mode", "hybrid", "--view=-60,40,150"),
            *("--size", "160x120", "--light", "45,30", "--out", tmp_path / name),
        )
        assert done.returncode == 0, done.stderr
    assert cv2.imread(str(tmp_path / "a.png")).shape == (120, 160, 3)
    done = impasto(
        *("render", tmp_path / "copy", "--mode", "all", "--view", "all"),
        *("--size", "80x60", "--out", tmp_path / "all"),
    )
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "all").iterdir())) == len(Mode) * len(NamedView) + 1


@pytest.fixture
def dark_session(tmp_path, rig_geometry):
    plan = make_plan(fringe_patterns(Axis.COLUMN, period=600.0, steps=4))
    frames = expose(plan, {}, mean=8, modulation=0, sigma=0.0)
    rig_geometry.save(tmp_path / "calibration")
    with SessionWriter.create(tmp_path / "s", plan, calibration=tmp_path / "calibration") as writer:
        for number, (frame_id, image) in enumerate(frames.items()):
            writer.record(frame_id, image, sequence=number)
        writer.finish()
    return tmp_path / "s"


def test_bad_input_ends_with_its_code_and_nothing_written(tmp_path, dark_session):
    write_copy(make_copy(strokes()), tmp_path / "copy")
    (tmp_path / "bad.toml").write_text("name = 3")
    cases = [
        (("process", dark_session, "--out", tmp_path / "o"), 3, "not one pixel could be decoded"),
        (("process", tmp_path / "none", "--out", tmp_path / "o"), 3, "no such session"),
        (("process", tmp_path / "none"), 2, "--out"),
        (("render", tmp_path / "none", "--out", tmp_path / "o.png"), 3, "not a digital copy"),
        (("render", tmp_path / "copy", "--out", tmp_path / "o.tiff"), 3, ".png or .exr"),
        (("render", tmp_path / "copy", "--mode", "x", "--out", tmp_path / "o.png"), 2, "mode"),
        (("render", tmp_path / "copy", "--size", "0x9", "--out", tmp_path / "o.png"), 2, "size"),
        (("render", tmp_path / "copy", "--view", "up", "--out", tmp_path / "o.png"), 3, "no view"),
        (("bench", "render", "--json", tmp_path / "no" / "f.json"), 2, "there is no folder"),
        (
            (
                "render",
                tmp_path / "copy",
                "--out",
                tmp_path / "o.png",
                "--json",
                tmp_path / "no" / "f",
            ),
            2,
            "there is no folder",
        ),
        (("devices", "--json", tmp_path), 2, "is a folder"),
        (("bench", "stress", "--pictures", tmp_path / "no" / "p"), 2, "there is no folder"),
        (
            ("import", tmp_path, "--capture", tmp_path / "bad.toml", "--out", tmp_path / "o"),
            3,
            "name",
        ),
    ]
    before = sorted(p.name for p in tmp_path.iterdir())
    for arguments, code, message in cases:
        done = impasto(*arguments)
        assert done.returncode == code, done.stderr
        assert message in re.sub(r"\s+", " ", done.stderr)
        assert "Traceback" not in done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == before


@pytest.mark.parametrize("damage", ["missing", "truncated", "wrong size", "no matrix"])
def test_a_bad_capture_leaves_no_session(tmp_path, rig_geometry, damage):
    folder = tmp_path / "files"
    folder.mkdir()
    for name in "abc":
        cv2.imwrite(str(folder / f"{name}.png"), np.full((12, 16), ord(name), np.uint8))
    write_matrices(folder / "c.yml", {"K": np.eye(3)})
    description = """
name = "test"
camera = { width = 16, height = 12 }
projector = { width = 512, height = 320 }
saturation_level = 255
[[phase_shift]]
axis = "column"
periods = 1
files = ["a.png", "b.png", "c.png"]
"""
    if damage == "missing":
        (folder / "b.png").unlink()
    elif damage == "truncated":
        (folder / "b.png").write_bytes((folder / "b.png").read_bytes()[:40])
    elif damage == "wrong size":
        cv2.imwrite(str(folder / "b.png"), np.zeros((5, 16), np.uint8))
    else:
        names = "camera_matrix camera_distortion projector_matrix projector_distortion rotation"
        keys = "".join(f'{name} = "K"\n' for name in names.split())
        description += f'[calibration]\nfile = "c.yml"\n{keys}translation = "T"\n'
    (tmp_path / "capture.toml").write_text(description)
    before = sorted(p.name for p in tmp_path.iterdir())
    done = impasto(
        "import", folder, "--capture", tmp_path / "capture.toml", "--out", tmp_path / "s"
    )
    assert done.returncode == 3, done.stderr
    assert ("c.yml: no matrix 'T'" if damage == "no matrix" else "b.png") in done.stderr
    assert "Traceback" not in done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("sign", "stage"),
    [
        (signal.SIGTERM, "scanning"),
        (signal.SIGINT, "rendering six views"),
    ],
)
def test_an_interrupted_demo_leaves_nothing(tmp_path, sign, stage):
    words = [str(IMPASTO), "demo", "--size", "tiny", "--out", str(tmp_path / "demo")]
    running = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    assert running.stderr is not None
    for line in running.stderr:
        if stage in line:
            break
    time.sleep(0.2)
    running.send_signal(sign)
    assert running.wait(timeout=60) == 130
    assert "interrupted" in running.stderr.read()
    assert not list(tmp_path.iterdir())


def bring_in(source: Path, name: str, out: Path) -> None:
    done = impasto("import", source, "--capture", CAPTURES / f"{name}.toml", "--out", out)
    assert done.returncode == 0, done.stderr


def test_real_plaster_relief(real_data, tmp_path):
    bring_in(real_data / "slmaster_relief_mono", "slmaster_relief_mono", tmp_path / "s")
    done = impasto(
        "process", tmp_path / "s", "--out", tmp_path / "c", "--json", tmp_path / "f.json"
    )
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "f.json").read_text())
    noise = figures["height_noise"]
    assert noise["observed_mm"] / noise["predicted_mm"] == pytest.approx(1, abs=0.1)
    # 214 654 pixels of the picture have a modulation above 10, the tablet's sides included.
    assert figures["canvas_pixels"] > 0.9 * 214_654
    low, high = figures["height_range_mm"]
    assert 40 < high - low < 130


def test_real_board_is_flat_but_for_its_blisters(real_data, tmp_path):
    source = real_data / "slstudio_procam" / "calseq1"
    bring_in(source, "slstudio_procam", tmp_path / "s")
    done = impasto("process", tmp_path / "s", "--out", tmp_path / "c")
    assert done.returncode == 0, done.stderr
    copy = read_copy(tmp_path / "c")
    heights = copy.height_field.height[copy.height_field.mask]
    assert np.std(heights) < 0.2
    assert 0.05 < copy.relief.delta0_mm < 0.3
    assert 0.01 < copy.relief.significant[copy.height_field.mask].mean() < 0.15
    assert len(copy.relief.boxes) > 50


def test_real_plane_without_calibration_says_so(real_data, tmp_path):
    bring_in(real_data / "kamino410_gamma_plane", "kamino410_gamma_plane", tmp_path / "s")
    done = impasto("process", tmp_path / "s", "--out", tmp_path / "c")
    assert done.returncode == 3
    assert "no rig calibration" in done.stderr
