"""Whether a copy is what processing would make again, told without what processing needs.

The note beside the stored results of the stages says for which recordings, calibration, options and
program a copy was written, and what its files were. Looking takes a fraction of the time that the
numerical libraries take to be loaded.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from acquisition.session import JOURNAL_FILE, MANIFEST_FILE
from workstation.json_output import write_json
from workstation.stage_cache import digest_of_files, digest_of_program

_NOTE = "written.json"


def digest_of_request(inputs: Mapping[str, Path | None], options: Mapping[str, Any]) -> str:
    """Digest of what a copy is asked to be made of, and how.

    Parameters
    ----------
    inputs : mapping of str to Path or None
        Sessions, of which manifest and journal count, other folders, and files.
    options : mapping of str to Any
        Plain values.
    """
    digests = {name: _digest(path) for name, path in inputs.items() if path is not None}
    what = json.dumps([digest_of_program(), digests, dict(options)], sort_keys=True)
    return hashlib.sha256(what.encode()).hexdigest()


def figures_if_written(out: Path, stages: Path | None, request: str) -> dict[str, Any] | None:
    """Figures of a copy that is there as it was written for a request; None if it is not."""
    if stages is None or not out.is_dir():
        return None
    try:
        note = json.loads((stages / _NOTE).read_text())
        known = note["request"], note["files"]
        figures: dict[str, Any] = dict(note["figures"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return figures if known == (request, digest_of_files(out)) else None


def note_written(out: Path, stages: Path | None, request: str, figures: dict[str, Any]) -> None:
    """Note that a copy was written for a request."""
    if stages is not None and stages.is_dir():
        note = {"request": request, "files": digest_of_files(out), "figures": figures}
        write_json(stages / _NOTE, note)


def _digest(path: Path) -> str:
    if (path / MANIFEST_FILE).is_file():
        parts = [path / MANIFEST_FILE, path / JOURNAL_FILE]
        return " ".join(hashlib.sha256(part.read_bytes()).hexdigest() for part in parts)
    if path.is_dir():
        return digest_of_files(path)
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "nothing"
