"""CIEDE2000, the colour difference that an eye sees, between linear RGB pictures.

Primaries and white are those of sRGB (IEC 61966-2-1, D65). The formula follows Sharma, Wu and
Dalal, *The CIEDE2000 Color-Difference Formula: Implementation Notes, Supplementary Test Data, and
Mathematical Observations*, Color Research and Application 30, 2005; the tests hold it against their
table.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
_FAR = 25.0**7


def lab_of_linear_rgb(rgb: ArrayLike) -> Floats:
    """CIELAB of linear RGB (..., 3) in which (1, 1, 1) is white."""
    xyz = np.asarray(rgb, dtype=np.float64) @ _XYZ_OF_RGB.T / _WHITE
    f = np.where(
        xyz > _LINEAR_BELOW,
        np.cbrt(xyz),
        xyz / (3 * (6 / 29) ** 2) + 4 / 29,
    )
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def delta_e_2000(lab: ArrayLike, other: ArrayLike) -> Floats:
    """CIEDE2000 between CIELAB colours (..., 3), (...)."""
    l1, a1, b1 = np.moveaxis(np.asarray(lab, dtype=np.float64), -1, 0)
    l2, a2, b2 = np.moveaxis(np.asarray(other, dtype=np.float64), -1, 0)
    mean7 = ((np.hypot(a1, b1) + np.hypot(a2, b2)) / 2) ** 7
    stretch = 1.5 - 0.5 * np.sqrt(mean7 / (mean7 + _FAR))
    a1, a2 = a1 * stretch, a2 * stretch
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = np.arctan2(b1, a1) % (2 * np.pi), np.arctan2(b2, a2) % (2 * np.pi)
    grey = c1 * c2 == 0
    turn = np.where(grey, 0.0, (h2 - h1 + np.pi) % (2 * np.pi) - np.pi)
    d_l, d_c, d_h = l2 - l1, c2 - c1, 2 * np.sqrt(c1 * c2) * np.sin(turn / 2)
    l_, c_ = (l1 + l2) / 2, (c1 + c2) / 2
    h_ = np.where(grey, h1 + h2, (h1 + turn / 2) % (2 * np.pi))
    t = (
        1
        - 0.17 * np.cos(h_ - np.radians(30))
        + 0.24 * np.cos(2 * h_)
        + 0.32 * np.cos(3 * h_ + np.radians(6))
        - 0.20 * np.cos(4 * h_ - np.radians(63))
    )
    lower = (l_ - 50) ** 2
    s_l = 1 + 0.015 * lower / np.sqrt(20 + lower)
    s_c, s_h = 1 + 0.045 * c_, 1 + 0.015 * c_ * t
    around = np.radians(30) * np.exp(-(((np.degrees(h_) - 275) / 25) ** 2))
    r_t = -np.sin(2 * around) * 2 * np.sqrt(c_**7 / (c_**7 + _FAR))
    d_l, d_c, d_h = d_l / s_l, d_c / s_c, d_h / s_h
    return np.asarray(np.sqrt(d_l**2 + d_c**2 + d_h**2 + r_t * d_c * d_h))
