"""Files that join those of a folder all together, or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from acquisition.file_tree import files_below


@contextmanager
def files_in_progress(folder: Path | None) -> Iterator[Path | None]:
    """Yield a temporary folder whose files go to ``folder`` when the block ends without error.

    What ``folder`` holds besides stays; it is made if needed. Each file replaces that of its name
    whole. On any error, interruption included, nothing of it is there.

    Parameters
    ----------
    folder : Path or None
        None where there is nothing to write: then None is what the block gets.
    """
    if folder is None:
        yield None
        return
    near = next(place for place in folder.absolute().parents if place.is_dir())
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.in-progress-", dir=near))
    try:
        yield temporary
        for name, file in files_below(temporary).items():
            place = folder / name
            place.parent.mkdir(parents=True, exist_ok=True)
            file.replace(place)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
