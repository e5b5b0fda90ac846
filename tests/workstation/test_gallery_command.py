from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path

import cv2
import pytest
from impasto_command import IMPASTO
from synthetic_copy import make_copy, strokes

from fitting.copy_files import write_copy


@pytest.fixture
def copy(tmp_path) -> Path:
    write_copy(make_copy(strokes(40, 50)), tmp_path / "harbour")
    return tmp_path / "harbour"


def test_a_walk_is_written_as_frames_and_a_video(tmp_path, copy):
    words = [IMPASTO, "gallery", copy, copy, "--frames", "3", "--size", "96x54", "--video"]
    words += ["--out", tmp_path / "walk", "--json", tmp_path / "walk.json"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "walk.json").read_text())
    names = [frame["frame"] for frame in figures["frames"]]
    assert names == ["frame_0001.png", "frame_0002.png", "frame_0003.png"]
    written = sorted(file.name for file in (tmp_path / "walk").iterdir())
    assert written == sorted([*names, figures["video"]])
    pictures = [cv2.imread(str(tmp_path / "walk" / name)) for name in names]
    assert all(picture.shape == (54, 96, 3) and picture.std() > 5 for picture in pictures)
    assert (pictures[0] != pictures[1]).mean() > 0.5
    reader = cv2.VideoCapture(str(tmp_path / "walk" / figures["video"]))
    assert reader.get(cv2.CAP_PROP_FRAME_COUNT) == 3


def test_ctrl_c_leaves_no_half_walk(tmp_path, copy):
    words = [IMPASTO, "gallery", copy, "--frames", "900", "--size", "96x54"]
    running = subprocess.Popen(
        [*words, "--out", tmp_path / "walk", "--video"], stderr=subprocess.PIPE, text=True
    )
    try:
        assert running.stderr is not None
        for line in running.stderr:
            if "frame 3" in line:
                break
        running.send_signal(signal.SIGINT)
        _, messages = running.communicate(timeout=60)
    finally:
        running.kill()
    assert running.returncode == 130
    assert "Traceback" not in messages
    assert [file.name for file in tmp_path.iterdir()] == ["harbour"]
