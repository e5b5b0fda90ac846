"""The demo as a whole process: time, memory, and its figures against the truth."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from workstation.benchmark_records import Record, Sense


def bench() -> list[Record]:
    """The demo as a whole process."""
    with TemporaryDirectory() as folder:
        figures = Path(folder) / "figures.json"
        command = [sys.executable, "-m", "workstation.command_line", "demo"]
        started = time.perf_counter()
        subprocess.run(
            [*command, "--out", f"{folder}/demo", "--json", str(figures)],
            check=True,
            capture_output=True,
        )
        seconds = time.perf_counter() - started
        peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        truth = json.loads(figures.read_text())["truth"]
    return [
        Record(name="demo.seconds", value=seconds, unit="s", bound=60.0, sense=Sense.AT_MOST),
        Record(name="demo.peak_mb", value=peak_mb, unit="MB", bound=3000.0, sense=Sense.AT_MOST),
        Record(
            name="demo.height_rms_over_predicted",
            value=truth["height_rms_over_predicted"],
            unit="",
            bound=(0.8, 1.25),
            sense=Sense.WITHIN,
        ),
    ]
