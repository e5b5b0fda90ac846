"""How different two linear RGB pictures look: CIEDE2000 between them.

Primaries and white are those of sRGB (IEC 61966-2-1, D65).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.colour_chart import delta_e_2000

Floats = NDArray[np.float64]
_XYZ_OF_RGB = np.array(
    [
        [0.4123907993, 0.3575843394, 0.1804807884],
        [0.2126390059, 0.7151686788, 0.0721923154],
        [0.0193308187, 0.1191947798, 0.9505321522],
    ]
)
_WHITE = _XYZ_OF_RGB.sum(axis=1)
_LINEAR_BELOW = (6 / 29) ** 3


def lab_of_linear_rgb(rgb: ArrayLike) -> Floats:
    """CIELAB of linear RGB (..., 3) in which (1, 1, 1) is white."""
    xyz = np.asarray(rgb, dtype=np.float64) @ _XYZ_OF_RGB.T / _WHITE
    f = np.where(xyz > _LINEAR_BELOW, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def colour_difference(rgb: ArrayLike, other: ArrayLike) -> Floats:
    """CIEDE2000 between linear RGB colours (..., 3) in which (1, 1, 1) is white, (...)."""
    return delta_e_2000(lab_of_linear_rgb(rgb), lab_of_linear_rgb(other))
