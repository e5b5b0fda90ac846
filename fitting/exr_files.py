"""OpenEXR files as this project writes them: scan lines, ZIP, whole or an error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray


def write_exr(path: Path, channels: dict[str, NDArray[Any]]) -> None:
    """Write channels (rows, cols) by their names.

    Raises
    ------
    OSError
        The file could not be written whole: a full disk, for one.
    """
    # ZIP compression: a flipped bit fails its checksum instead of passing for a height.
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    layers = {name: np.ascontiguousarray(values) for name, values in channels.items()}
    try:
        OpenEXR.File(header, layers).write(str(path))
        # A disk that is full when the last block is flushed goes unsaid, so it is read again.
        with OpenEXR.File(str(path), separate_channels=True) as written:
            whole = set(written.channels()) == set(layers)
    except RuntimeError as error:
        raise OSError(f"{path.name} cannot be written ({error}); is the disk full?") from error
    if not whole:
        raise OSError(f"{path.name} was not written whole; is the disk full?")
