"""The ``--json FILE`` of every command."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any

import typer

from acquisition.atomic_files import write_bytes
from workstation.destinations import why_no_file


def check_json_path(path: Path | None) -> Path | None:
    """Refuse a file that cannot be written, before minutes of work and not after them.

    Raises
    ------
    typer.BadParameter
        It has no folder to lie in, is one, or is neither file nor folder.
    """
    if path is not None and (reason := why_no_file(path)):
        raise typer.BadParameter(reason)
    return path


JsonOption = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Write figures here.", callback=check_json_path),
]


def write_json(path: Path | None, figures: Any) -> None:
    """Write figures as JSON, whole or not at all; nothing where ``path`` is None.

    Numbers that are not finite become null, because JSON has none.
    """
    if path is not None:
        write_bytes(path, (json.dumps(plain_figures(figures), indent=1) + "\n").encode())


def plain_figures(value: Any) -> Any:
    """Figures as they come back from a JSON file, but for keys that are no texts."""
    if isinstance(value, dict):
        return {key: plain_figures(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_figures(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
