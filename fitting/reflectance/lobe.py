"""One Lafortune lobe per texel (paper eq. 1), and its gauge.

f = ρ_d + ρ_s (C_x v_x l_x + C_y v_y l_y + C_z v_z l_z)**k does not change where C is scaled and
ρ_s divided by the k-th power of the scale. The fit holds |C_x| = 1 and works with r = C_z / |C_x|,
c = C_y / C_x and logarithms; ρ_s is reported as the highlight's value at normal incidence seen
head-on, the scale on which C_z = 1, where it has a meaning whatever k is. A base below zero is no
light.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import FittingError

Floats = NDArray[np.float64]
_SMALLEST_BASE = 1e-30
_LARGEST_EXPONENT = 250.0


class LobeVariant(IntEnum):
    """Which lobes a fit may choose from; the value is the number of free shape parameters.

    Attributes
    ----------
    MIRROR
        C_z = |C_x| = |C_y|: the highlight stands where a mirror would show the light.
    FREE
        C_x = C_y: off-specular peaks; needs more than one angle of view or of light.
    ANISOTROPIC
        All different, along the axes of the texel's frame.
    """

    MIRROR = 1
    FREE = 2
    ANISOTROPIC = 3


@dataclass(frozen=True)
class LafortuneLobes:
    """Reflectance of ``n`` texels.

    Attributes
    ----------
    shape : (n, 3) array
        ln k, ln r, ln c.
    diffuse : (n, 3) array
        ρ_d, linear RGB, 1/sr.
    specular : (n, 3) array
        ρ_s: the highlight at normal incidence, seen head-on, 1/sr.
    """

    shape: Floats
    diffuse: Floats
    specular: Floats

    def __post_init__(self) -> None:
        n = len(self.shape)
        for name in ("shape", "diffuse", "specular"):
            array = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, array)
            if array.shape != (n, 3):
                raise FittingError(f"{name} of {n} lobes is {array.shape}: ({n}, 3) is needed")

    @property
    def exponent(self) -> Floats:
        """k, (n,)."""
        return np.exp(self.shape[:, 0])

    @property
    def coefficients(self) -> Floats:
        """C_x, C_y, C_z and k, (n, 4), on the scale of ``specular``: C_z = 1."""
        ln_k, ln_r, ln_c = self.shape.T
        c_x = -np.exp(-ln_r)
        return np.stack([c_x, c_x * np.exp(ln_c), np.ones_like(c_x), np.exp(ln_k)], axis=1)

    def reflectance(self, view: ArrayLike, light: ArrayLike) -> Floats:
        """Reflectance f in 1/sr for directions (n, m, 3) in the texels' frames; (n, m, 3)."""
        v = np.asarray(view, dtype=np.float64)
        l_ = np.asarray(light, dtype=np.float64)
        k, r, c = np.exp(self.shape).T[:, :, np.newaxis]
        base = r * v[..., 2] * l_[..., 2] - v[..., 0] * l_[..., 0] - c * v[..., 1] * l_[..., 1]
        lit = base > _SMALLEST_BASE
        exponent = k * (np.log(np.where(lit, base, 1.0)) - self.shape[:, 1:2])
        exponent = np.clip(exponent, -_LARGEST_EXPONENT, _LARGEST_EXPONENT)
        lobe = np.where(lit, np.exp(exponent), 0.0)
        return self.diffuse[:, np.newaxis] + self.specular[:, np.newaxis] * lobe[..., np.newaxis]

    def radiance(self, view: ArrayLike, light: ArrayLike) -> Floats:
        """Radiance f cos θ, as :class:`~fitting.reflectance.samples.RadianceSamples` hold it.

        Light from behind the surface gives none.
        """
        cosine = np.maximum(np.asarray(light, dtype=np.float64)[..., 2:3], 0.0)
        return self.reflectance(view, light) * cosine
