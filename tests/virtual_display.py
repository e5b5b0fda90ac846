"""An X display in memory for tests, and what a person would see on it."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest


@dataclass(frozen=True)
class VirtualDisplay:
    """A screen in memory, and the file that its X server keeps its picture in."""

    name: str
    file: Path

    def picture(self) -> np.ndarray:
        """Levels (rows, cols, 3) that the X server shows, from its dump in xwd's format."""
        raw = self.file.read_bytes()
        header = np.frombuffer(raw[:100], ">u4")
        begin, line = int(header[0] + 12 * header[19]), int(header[12])
        cols, rows = int(header[4]), int(header[5])
        pixels = np.frombuffer(raw, np.uint8, rows * line, begin).reshape(rows, -1, 4)
        return pixels[:, :cols, :3]


@contextmanager
def virtual_display(folder: Path, width: int, height: int) -> Iterator[VirtualDisplay]:
    """Run an X server while the block runs, its picture in a folder; skip where there is none."""
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not installed (apt install xvfb)")
    read, write = os.pipe()
    size = f"{width}x{height}x24"
    options = f"-displayfd {write} -screen 0 {size} -noreset -nolisten tcp -fbdir {folder}"
    server = subprocess.Popen(
        ["Xvfb", *options.split()],
        pass_fds=(write,),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        os.close(write)
        number = os.read(read, 16).decode().strip()
        if not number:
            pytest.skip("Xvfb did not start")
        yield VirtualDisplay(f":{number}", folder / "Xvfb_screen0")
    finally:
        os.close(read)
        server.kill()
        server.wait()
