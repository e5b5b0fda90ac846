"""The digital copy of a painting in memory: what every renderer and report works from."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FittingError
from fitting.height_field import HeightField
from fitting.relief import Relief


@dataclass(frozen=True)
class ReflectanceQuality:
    """How well each texel's reflectance is known. Everything is finite, in gaps too.

    Attributes
    ----------
    diffuse_sigma, specular_sigma : (rows, cols, 3) float32 array
        Standard errors of ρ_d and ρ_s.
    lobe_sigma : (rows, cols, 3) float32 array
        Standard errors of ln k, of ln(C_z / |C_x|) and of ln(C_y / C_x).
    residual : (rows, cols) float32 array
        RMS of radiance over irradiance that the lobe leaves of the samples, 1/sr.
    samples : (rows, cols) uint16 array
        Photographs behind the texel.
    flags : (rows, cols) uint16 array
        Bits of :class:`~fitting.reflectance.flags.TexelFlag`.
    """

    diffuse_sigma: NDArray[np.float32]
    specular_sigma: NDArray[np.float32]
    lobe_sigma: NDArray[np.float32]
    residual: NDArray[np.float32]
    samples: NDArray[np.uint16]
    flags: NDArray[np.uint16]

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Every map by its name."""
        return {item.name: getattr(self, item.name) for item in fields(self)}


@dataclass(frozen=True)
class ReflectanceMaps:
    """One Lafortune lobe per texel (paper eq. 1).

    ``f = diffuse + specular * max(0, C_x v_x l_x + C_y v_y l_y + C_z v_z l_z) ** k``, in 1/sr.

    Attributes
    ----------
    diffuse, specular : (rows, cols, 3) float32 array
        ρ_d and ρ_s, linear RGB.
    lobe : (rows, cols, 4) float32 array
        C_x, C_y, C_z and k.
    quality : ReflectanceQuality or None
        None where it is not known.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    lobe: NDArray[np.float32]
    quality: ReflectanceQuality | None = None


@dataclass(frozen=True)
class DigitalCopy:
    """A painting's relief and, when it was photographed, its reflectance.

    Attributes
    ----------
    height_field : HeightField
        Heights and gaps.
    normal_xy : (rows, cols, 2) float32 array
        n_x and n_y of the unit normal in the canvas frame; n_z is the positive rest.
    relief : Relief
        δ0, n and the boxes.
    reflectance : ReflectanceMaps or None
        None for a copy that was only scanned, which is shown as matt plaster.
    slope_sigma : (rows, cols) float32 array
        Standard error of n_x and n_y (the same for both, to first order).
    provenance : dict
        Session digest, software version, parameters, error summary; plain JSON values.

    Raises
    ------
    FittingError
        Shapes disagree, or a normal of a measured texel is not finite.
    """

    height_field: HeightField
    normal_xy: NDArray[np.float32]
    relief: Relief
    slope_sigma: NDArray[np.float32]
    reflectance: ReflectanceMaps | None = None
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = self.height_field.shape
        expected = {"normal_xy": (*shape, 2), "slope_sigma": shape}
        arrays: dict[str, NDArray[Any]] = {
            "normal_xy": self.normal_xy,
            "slope_sigma": self.slope_sigma,
        }
        if self.reflectance is not None:
            expected |= {"diffuse": (*shape, 3), "specular": (*shape, 3), "lobe": (*shape, 4)}
            arrays |= {
                "diffuse": self.reflectance.diffuse,
                "specular": self.reflectance.specular,
                "lobe": self.reflectance.lobe,
            }
            if self.reflectance.quality is not None:
                quality = self.reflectance.quality.arrays
                triple = ("diffuse_sigma", "specular_sigma", "lobe_sigma")
                expected |= {name: (*shape, 3) if name in triple else shape for name in quality}
                arrays |= quality
        for name, array in arrays.items():
            if array.shape != expected[name]:
                raise FittingError(
                    f"{name} is {array.shape}, the height field needs {expected[name]}"
                )
            bad = ~np.isfinite(array) & self.height_field.mask.reshape(
                shape + (1,) * (array.ndim - 2)
            )
            if bad.any():
                raise FittingError(
                    f"{name} is not finite at {int(bad.sum())} values inside the mask"
                )
