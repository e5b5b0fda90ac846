"""A choice of a picture's pixels, spread over it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def spread_pixels(mask: NDArray[np.bool_], count: int) -> NDArray[np.intp]:
    """Some pixels of a mask, evenly spread: one at random out of every few.

    Every n-th pixel would keep to a few columns where n divides the width of the mask.

    Parameters
    ----------
    mask : bool array
    count : int
        How many are wanted; up to twice as many come back.

    Returns
    -------
    (n,) array
        Rising indices into the flat mask, the same for the same mask.
    """
    index = np.flatnonzero(mask)
    step = len(index) // count
    if step < 2:
        return index
    first = np.arange(0, len(index) - step + 1, step)
    return index[first + np.random.default_rng(0).integers(0, step, len(first))]
