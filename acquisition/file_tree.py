"""The files below a folder."""

from __future__ import annotations

from pathlib import Path


def files_below(folder: Path) -> dict[str, Path]:
    """Every file below a folder, in order, by its path from there as POSIX writes it.

    Links to files count as files; links to folders are not followed.
    """
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {file.relative_to(folder).as_posix(): file for file in files}
