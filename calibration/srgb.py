"""The curve of sRGB, by which linear light becomes numbers for a screen (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def encode_srgb(linear: NDArray[np.floating]) -> NDArray[np.floating]:
    """Display values from 0 to 1 of linear ones, which are cut off there.

    Parameters
    ----------
    linear : (...) array

    Returns
    -------
    (...) array
        Of the same type.
    """
    clipped = np.clip(linear, 0.0, 1.0)
    high = 1.055 * np.power(np.maximum(clipped, 0.0031308), 1 / 2.4) - 0.055
    return np.asarray(np.where(clipped <= 0.0031308, 12.92 * clipped, high))
