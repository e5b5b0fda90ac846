"""The demo as a whole process: time, memory, and its figures against truth and photographs."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from workstation.benchmark_records import Record, Sense
from workstation.stage_cache import digest_of_files


def bench() -> list[Record]:
    """The demo as a whole process, twice, and its copy made again from what it recorded."""
    with TemporaryDirectory() as folder:
        first = Path(folder) / "first"
        started = time.perf_counter()
        figures = _demo(first)
        seconds = time.perf_counter() - started
        _demo(Path(folder) / "second")
        copies = [digest_of_files(Path(folder) / name / "copy") for name in ("first", "second")]
    truth, held = figures["truth"], figures["reflectance"]["held_out"]
    slowest = sorted(figures["stages"], key=lambda stage: -stage["seconds"])[:3]
    note = ", ".join(f"{stage['name']} {stage['seconds']:.0f} s" for stage in slowest)
    return [
        Record(
            name="demo.seconds",
            value=seconds,
            unit="s",
            bound=150.0,
            sense=Sense.AT_MOST,
            note=f"the longest: {note}",
        ),
        Record(
            name="demo.peak_mb",
            value=figures["peak_mb"],
            unit="MB",
            bound=3000.0,
            sense=Sense.AT_MOST,
        ),
        Record(
            name="demo.height_rms_over_predicted",
            value=truth["height_rms_over_predicted"],
            unit="",
            bound=(0.8, 1.25),
            sense=Sense.WITHIN,
            note=f"{1e3 * truth['height_rms_mm']:.1f} µm, by a calibration from a board",
        ),
        Record(
            name="demo.heldout_psnr_db",
            value=held["psnr_db"],
            unit="dB",
            bound=35.0,
            sense=Sense.AT_LEAST,
            runs=len(held["photographs"]),
            note=f"mean ΔE2000 {held['delta_e']:.2f}",
        ),
        Record(
            name="demo.lamp_direction_deg",
            value=truth["lamp_direction_deg"],
            unit="°",
            bound=0.5,
            sense=Sense.AT_MOST,
        ),
        Record(
            name="demo.differing_copies",
            value=len(set(copies)) - 1,
            unit="",
            bound=0,
            sense=Sense.AT_MOST,
            runs=2,
            note="of two runs with one seed",
        ),
    ]


def _demo(out: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "workstation.command_line", "demo", "--out", str(out)]
    subprocess.run(command, check=True, capture_output=True)
    figures: dict[str, Any] = json.loads((out / "report.json").read_text())
    return figures
