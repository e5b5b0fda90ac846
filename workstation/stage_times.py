"""What each stage took when it last ran at a quality, kept beside the stages' results.

A result of one quality replaces that of another; what both took is worth knowing.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable
from pathlib import Path

from workstation.json_output import write_json
from workstation.stage_cache import StageRun

_FILE = "times.json"


def times_before(folder: Path | None, quality: str) -> dict[str, float]:
    """Seconds of each stage at a quality, by its name; empty where nothing is known.

    Parameters
    ----------
    folder : Path or None
        Of the stages' results.
    quality : str
    """
    return _noted(folder).get(quality, {})


def note_times(folder: Path | None, quality: str, runs: Iterable[StageRun]) -> None:
    """Note what stages took, those too whose result was kept from an earlier run.

    Parameters
    ----------
    folder : Path or None
        Where it is None or missing, nothing is noted.
    quality : str
    runs : iterable of StageRun
    """
    if folder is None or not folder.is_dir():
        return
    times = {run.name: run.saved_s if run.skipped else run.seconds for run in runs}
    taken = {name: seconds for name, seconds in times.items() if seconds > 0}
    noted = _noted(folder)
    with contextlib.suppress(OSError):
        write_json(folder / _FILE, noted | {quality: noted.get(quality, {}) | taken})


def _noted(folder: Path | None) -> dict[str, dict[str, float]]:
    """By quality and stage."""
    try:
        found = json.loads((folder / _FILE).read_bytes()) if folder is not None else {}
        return {
            str(quality): {str(name): float(seconds) for name, seconds in times.items()}
            for quality, times in found.items()
        }
    except (OSError, ValueError, TypeError, AttributeError):
        return {}
