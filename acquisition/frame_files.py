"""One frame, one file: lossless PNG, sensor numbers as they came.

PNG carries a checksum of its own, holds 8 and 16 bits, and opens everywhere.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from acquisition.errors import SessionError

Samples = NDArray[np.uint8] | NDArray[np.uint16]
SUFFIX = ".png"
# Fast: fringes compress little better with more effort.
_COMPRESSION = 1


def encode_frame(image: Samples, *, name: str) -> bytes:
    """Encode a frame.

    Parameters
    ----------
    image : (rows, cols) uint8 or uint16 array
        Sensor numbers.
    name : str
        For error messages.

    Raises
    ------
    SessionError
        Another shape or type.
    """
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise SessionError(
            f"frame {name}: {image.dtype} of shape {image.shape}; frames are two-dimensional, "
            "8 or 16 bit"
        )
    done, encoded = cv2.imencode(SUFFIX, image, [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION])
    if not done:
        raise SessionError(f"frame {name}: cannot be encoded as PNG")
    return encoded.tobytes()


def decode_frame(content: bytes, *, path: Path) -> Samples:
    """Decode what :func:`encode_frame` wrote.

    Raises
    ------
    SessionError
        The content is not a whole picture.
    """
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise SessionError(f"{path}: truncated, or not a picture")
    return image  # type: ignore[return-value]
