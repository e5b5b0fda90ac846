"""Whether a copy is what processing would make again, told without what processing needs.

The note beside the stored results of the stages says for which recordings, calibration, options and
program a copy was written, and what its files were. Looking takes a fraction of the time that the
numerical libraries take to be loaded. Of recordings it looks at sizes and times of change alone: a
copy of a session, or one that was touched, is not known, and processing looks at it more closely.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from acquisition.file_tree import files_below
from acquisition.session import MANIFEST_FILE
from workstation.copy_places import places_beside
from workstation.json_output import plain_figures, write_json
from workstation.stage_cache import digest_of_files, digest_of_program

_NOTE = "written.json"


def digest_of_request(inputs: Mapping[str, Path | None], options: Mapping[str, Any]) -> str:
    """Digest of what a copy is asked to be made of, and how.

    Parameters
    ----------
    inputs : mapping of str to Path or None
        Sessions, other folders, and files.
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
        known = note["request"], note["files"], note["digest"]
        figures: dict[str, Any] = dict(note["figures"])
        written = _digest_of_written(out)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return figures if known == (request, written, _digest_of_figures(figures)) else None


def note_written(out: Path, stages: Path | None, request: str, figures: dict[str, Any]) -> None:
    """Note that a copy was written for a request, and what is beside it.

    Where there is no room for the note, the next run looks more closely.
    """
    if stages is not None and stages.is_dir():
        plain = plain_figures(figures)
        note = {
            "request": request,
            "files": _digest_of_written(out),
            "figures": plain,
            "digest": _digest_of_figures(plain),
        }
        with contextlib.suppress(OSError):
            write_json(stages / _NOTE, note)


def _digest_of_figures(figures: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(figures, sort_keys=True).encode()).hexdigest()


def _digest_of_written(out: Path) -> str:
    beside = (_digest(path) for path in places_beside(out).values())
    return " ".join([digest_of_files(out), *beside])


def _digest(path: Path) -> str:
    if (path / MANIFEST_FILE).is_file():
        manifest = hashlib.sha256((path / MANIFEST_FILE).read_bytes()).hexdigest()
        return f"{manifest} {_changed(path)}"
    if path.is_dir():
        return digest_of_files(path)
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "nothing"


def _changed(folder: Path) -> str:
    """Digest of the names, sizes and times of change of all files below a folder."""
    known = [(name, file.stat()) for name, file in files_below(folder).items()]
    told = [[name, stat.st_size, stat.st_mtime_ns] for name, stat in known]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()
