"""The ``--json FILE`` of every command."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from acquisition.atomic_files import write_bytes


def write_json(path: Path | None, figures: Any) -> None:
    """Write figures as JSON, whole or not at all; nothing where ``path`` is None.

    Numbers that are not finite become null, because JSON has none.
    """
    if path is not None:
        write_bytes(path, (json.dumps(_finite(figures), indent=1) + "\n").encode())


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
