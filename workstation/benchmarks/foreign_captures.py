"""Small captures of other software: fringes with a description, pictures under lights, pictures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from calibration.opencv_files import write_matrices

CAPTURE_FILE = "capture.toml"
CALIBRATION_FILE = "calibration.yml"
DOME_FILE = "lights.lp"
_CAPTURE = """
name = "a small capture"
camera = {{ width = {width}, height = {height} }}
projector = {{ width = 64, height = 48 }}
saturation_level = 255

[[phase_shift]]
axis = "column"
periods = 4
files = {{ pattern = "##.png", first = 0, last = 3 }}

[[gray]]
axis = "column"
step_px = 16
threshold = "phase-shift mean"
files = ["04.png", "05.png"]

[calibration]
file = "calibration.yml"
camera_matrix = "Kc"
camera_distortion = "dc"
projector_matrix = "Kp"
projector_distortion = "dp"
rotation = "R"
translation = "t"
pose = "camera to projector"
"""


def write_capture(folder: Path, *, width: int, height: int) -> None:
    """Write a small capture of other software, with its calibration and its description."""
    folder.mkdir()
    (folder / CAPTURE_FILE).write_text(_CAPTURE.format(width=width, height=height))
    x = np.arange(width) * 64 / width
    for step in range(4):
        level = 120 + 80 * np.cos(2 * np.pi * (x / 16 + step / 4))
        _write_rows(folder / f"{step:02d}.png", level, height)
    cell = (x // 16).astype(int)
    code = cell ^ (cell >> 1)
    for bit, name in ((1, "04.png"), (0, "05.png")):
        _write_rows(folder / name, 40.0 + 160 * ((code >> bit) & 1), height)
    lens = np.array([[30.0, 0, width / 2], [0, 30, height / 2], [0, 0, 1]])
    panel = np.array([[80.0, 0, 32], [0, 80, 24], [0, 0, 1]])
    matrices = {"Kc": lens, "dc": np.zeros((1, 5)), "Kp": panel, "dp": np.zeros((1, 5))}
    pose = {"R": np.eye(3), "t": np.array([[-100.0], [0], [0]])}
    write_matrices(folder / CALIBRATION_FILE, matrices | pose)


def _write_rows(file: Path, level: np.ndarray, height: int) -> None:
    cv2.imwrite(str(file), np.tile(level.astype(np.uint8), (height, 1)))


def write_dome(folder: Path, *, lights: int, width: int, height: int) -> None:
    """Write pictures of a flat matt board under distant lights, and the table of these."""
    folder.mkdir()
    random = np.random.default_rng(0)
    lines = [f"{lights}"]
    for number in range(lights):
        polar, turn = np.radians(15 + 45 * number / lights), 2.4 * number
        x, y, z = np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)
        linear = 0.5 * z + 0.001 * random.standard_normal((height, width, 3))
        picture = np.clip(np.rint(65535 * linear), 0, 65535).astype(np.uint16)
        cv2.imwrite(str(folder / f"{number:02}.png"), picture)
        lines.append(f"{number:02}.png {x:.6f} {y:.6f} {z:.6f}")
    (folder / DOME_FILE).write_text("\n".join(lines) + "\n")


def write_pictures(folder: Path) -> None:
    """Write pictures of many formats, in grey and in colour, of 8 and of 16 bits."""
    folder.mkdir()
    random = np.random.default_rng(0)
    grey = random.integers(0, 256, (18, 24)).astype(np.uint8)
    colour = random.integers(0, 65536, (18, 24, 3)).astype(np.uint16)
    for suffix in ("bmp", "jpg", "pgm", "ras", "webp"):
        cv2.imwrite(str(folder / f"grey.{suffix}"), grey)
    for suffix in ("png", "tif"):
        cv2.imwrite(str(folder / f"colour.{suffix}"), colour)
