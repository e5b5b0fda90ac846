"""Maps of a copy, rounded to what is known of them: what is below their errors only takes room.

Heights and normals become multiples of a power of two that follows their standard error, and
reflectance and standard errors keep a few significant bits. Deflate, which OpenEXR's ZIP is, then
finds low bits that are all zero.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy, ReflectanceMaps, ReflectanceQuality

Map = NDArray[np.float32]

# Quanta in standard errors: they add 0.5 % to the variance of heights, 2 % to that of normals.
_HEIGHT_SHARE, _NORMAL_SHARE = 0.25, 0.5
# Significant bits of reflectance: no more than eight, which leave at most 0.4 %, less than one
# level of a monitor; no fewer than six.
_FEWEST_BITS, _MOST_BITS = 6, 8
_ERROR_BITS = 4


@dataclass(frozen=True)
class MapRounding:
    """How finely the maps of a copy are kept.

    Attributes
    ----------
    height_mm, normal : float
        Quanta of heights, and of n_x and n_y; 0 keeps every bit.
    diffuse_bits, specular_bits, k_bits : int
        Significant bits of ρ_d, ρ_s and k. C_x, C_y and C_z keep all of theirs: they are raised to
        the power of k.
    error_bits : int
        Significant bits of standard errors.
    """

    height_mm: float
    normal: float
    diffuse_bits: int
    specular_bits: int
    k_bits: int
    error_bits: int = _ERROR_BITS

    @classmethod
    def of(cls, copy: DigitalCopy) -> MapRounding:
        """As finely as a copy's own standard errors ask for."""
        field = copy.height_field
        height_mm = _quantum(_HEIGHT_SHARE * float(np.sqrt(np.median(field.variance[field.mask]))))
        normal = _quantum(_NORMAL_SHARE * float(np.median(copy.slope_sigma[field.mask])))
        maps = copy.reflectance
        if maps is None or maps.quality is None:
            return cls(height_mm, normal, _MOST_BITS, _MOST_BITS, _MOST_BITS)
        known, quality = field.mask & (maps.quality.samples > 0), maps.quality
        return cls(
            height_mm,
            normal,
            _bits(quality.diffuse_sigma[known], maps.diffuse[known]),
            _bits(quality.specular_sigma[known], maps.specular[known]),
            # Of the logarithm, which is relative already.
            _bits(quality.lobe_sigma[known][:, 0], np.ones(1, np.float32)),
        )

    def as_json(self) -> dict[str, float]:
        """Every figure by its name."""
        return asdict(self)

    def applied(self, copy: DigitalCopy) -> DigitalCopy:
        """The copy with its maps rounded."""
        field = replace(
            copy.height_field,
            height=multiples(copy.height_field.height, self.height_mm),
            variance=significant(np.sqrt(copy.height_field.variance), self.error_bits) ** 2,
        )
        return replace(
            copy,
            height_field=field,
            normal_xy=self._normals(copy.normal_xy),
            slope_sigma=significant(copy.slope_sigma, self.error_bits),
            reflectance=None if copy.reflectance is None else self._maps(copy.reflectance),
        )

    def _normals(self, normal_xy: Map) -> Map:
        nearest = multiples(normal_xy, self.normal)
        # Along the canvas a normal must not become longer than 1.
        too_long = (nearest**2).sum(axis=-1, keepdims=True) > 1
        return np.where(too_long, normal_xy, nearest)

    def _maps(self, maps: ReflectanceMaps) -> ReflectanceMaps:
        lobe = maps.lobe.copy()
        lobe[..., 3] = significant(lobe[..., 3], self.k_bits)
        return ReflectanceMaps(
            significant(maps.diffuse, self.diffuse_bits),
            significant(maps.specular, self.specular_bits),
            lobe,
            None if maps.quality is None else self._quality(maps.quality),
        )

    def _quality(self, quality: ReflectanceQuality) -> ReflectanceQuality:
        bits = self.error_bits
        return replace(
            quality,
            diffuse_sigma=significant(quality.diffuse_sigma, bits),
            specular_sigma=significant(quality.specular_sigma, bits),
            lobe_sigma=significant(quality.lobe_sigma, bits),
            residual=significant(quality.residual, bits),
        )


def multiples(values: Map, quantum: float) -> Map:
    """The nearest multiples of a quantum; 0 leaves values as they are."""
    if quantum == 0:
        return values
    return (np.round(values.astype(np.float64) / quantum) * quantum).astype(np.float32)


def significant(values: Map, bits: int) -> Map:
    """The nearest numbers of so many significant bits."""
    share, exponent = np.frexp(values)
    return np.asarray(np.ldexp(np.round(np.ldexp(share, bits)), exponent - bits), np.float32)


def _quantum(wanted: float) -> float:
    """The power of two nearest to a quantum, by ratio; 0 where every bit is wanted."""
    return 2.0 ** round(math.log2(wanted)) if 0 < wanted < math.inf else 0.0


def _bits(sigma: Map, values: Map) -> int:
    """Significant bits whose last one is half a standard error or less, for half of the values."""
    seen = np.abs(values) > 0
    relative = sigma / np.where(seen, np.abs(values), 1)
    relative = relative[np.broadcast_to(seen, relative.shape)]
    typical = float(np.median(relative)) if relative.size else 0.0
    if not 0 < typical < math.inf:
        return _MOST_BITS
    return min(max(2 - round(math.log2(typical)), _FEWEST_BITS), _MOST_BITS)
