"""Which colour a pixel of a mosaic sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from devices.bayer import BayerPattern

_CHANNEL = {"R": 0, "G": 1, "B": 2}


def mosaic_channels(
    mosaic: BayerPattern | None, *, row: int = 0, column: int = 0
) -> NDArray[np.int64]:
    """Channel of each pixel by the parity of its row and column.

    Parameters
    ----------
    mosaic : BayerPattern or None
        From the first pixel of the full frame; None of a monochrome sensor.
    row, column : int
        Of the picture's first pixel in the full frame.

    Returns
    -------
    (2, 2) int64 array
        0, 1, 2 for red, green and blue; -1 if monochrome.
    """
    if mosaic is None:
        return np.full((2, 2), -1, np.int64)
    order = np.array([_CHANNEL[letter] for letter in mosaic.value], np.int64).reshape(2, 2)
    return np.roll(order, (-(row % 2), -(column % 2)), axis=(0, 1))
