"""A small lamp close to a painting: where it stands and what it lights.

The lamp is a point seen from the painting; its intensity falls from its axis by a power of the
cosine. What it sends to a surface point that faces it is

    e = I cosᵐ(a) / d²,   a: angle from the axis, d: distance in mm

and the radiance of a texel under it is ``f(l, v) · e · cos θ``, with f the reflectance in 1/sr.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.lens import rotation, transform


@dataclass(frozen=True)
class Lamp:
    """One pose of a lamp, in the frame of the points that are asked for.

    Attributes
    ----------
    position : (3,) float64 array
        Where it stands, in mm.
    axis : (3,) float64 array
        Unit vector along which it shines brightest, away from the lamp.
    intensity : (3,) float64 array
        I of linear RGB, relative to the white reference, times mm².
    exponent : float
        m; 0 for a lamp that shines alike in all directions.

    Raises
    ------
    CalibrationError
        A value is not finite, the axis is no unit vector, or the intensity is not positive.
    """

    position: NDArray[np.float64]
    axis: NDArray[np.float64]
    intensity: NDArray[np.float64]
    exponent: float = 0.0

    def __post_init__(self) -> None:
        for name in ("position", "axis", "intensity"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise CalibrationError(f"a lamp's {name} is three finite numbers, not {value}")
            object.__setattr__(self, name, value)
        if abs(np.linalg.norm(self.axis) - 1.0) > 1e-6:
            raise CalibrationError(f"a lamp's axis is a unit vector, not {self.axis}")
        if not (self.intensity > 0.0).all():
            raise CalibrationError(f"a lamp's intensity is positive, not {self.intensity}")
        if not 0.0 <= self.exponent < np.inf:
            raise CalibrationError(f"a lamp's exponent is 0 or more, not {self.exponent}")

    def directions(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit vectors from points to the lamp.

        Parameters
        ----------
        points : (..., 3) array
            In mm.

        Returns
        -------
        (..., 3) float64 array
        """
        towards = self.position - points
        return np.asarray(towards / np.linalg.norm(towards, axis=-1, keepdims=True))

    def irradiance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the lamp sends to surface points that face it.

        Parameters
        ----------
        points : (..., 3) array
            In mm.

        Returns
        -------
        (..., 3) float64 array
            Linear RGB; zero behind the lamp.
        """
        return np.asarray(
            fall_off(self.position, self.axis, self.exponent, points)[..., None] * self.intensity
        )

    def transformed(self, rt_other_this: NDArray[np.float64]) -> Lamp:
        """The same lamp in another frame, whose pose takes points of this frame to it.

        Parameters
        ----------
        rt_other_this : (6,) array
            Rodrigues, mm.
        """
        axis = rotation(rt_other_this) @ self.axis
        return replace(self, position=transform(rt_other_this, self.position), axis=axis)


def fall_off(
    position: NDArray[np.float64],
    axis: NDArray[np.float64],
    exponent: float,
    points: NDArray[np.float64],
) -> NDArray[np.float64]:
    """What lamps of unit intensity send to points that face them.

    Parameters
    ----------
    position, axis : (..., 3) arrays
        Of the lamps, mm and unit.
    exponent : float
    points : (..., 3) array
        In mm; broadcast against the lamps.

    Returns
    -------
    (...) float64 array
        1/mm²; zero behind a lamp.
    """
    towards = position - points
    squared = np.sum(towards**2, axis=-1)
    cosine = np.maximum(-np.sum(towards * axis, axis=-1) / np.sqrt(squared), 0.0)
    return np.asarray(cosine**exponent / squared)
