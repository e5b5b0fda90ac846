"""Radiance samples of a tile of texels: what a reflectance fit is made from.

A sample is what one photograph says of one texel: directions to the camera and to the light in the
texel's own frame, and the radiance divided by the irradiance that the light would give a surface
facing it, so that its expectation is f · cos θ (paper section 4.4 and eq. 1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import FittingError
from fitting.reflectance.texel_kernels import SampleArrays

Singles = NDArray[np.float32]
DEFAULT_GRAZING_LIMIT = math.radians(75.0)


@dataclass(frozen=True)
class RadianceSamples:
    """Samples of ``n`` texels, at most ``m`` of each; unused places have weight zero.

    Samples that are not finite, or without a positive variance, or from behind the surface, may be
    present: the solver leaves them out, texel by texel, and flags the texel.

    Attributes
    ----------
    view, light : (n, m, 3) float32 array
        Unit vectors from the surface to camera and light; z along the texel's normal.
    radiance : (n, m, 3) float32 array
        Linear RGB over the irradiance at normal incidence, 1/sr.
    variance : (n, m, 3) float32 array
        Of ``radiance``.
    weight : (n, m) float32 array
        Zero for samples not to be used (occluded, saturated, none), one otherwise; anything
        between for samples that deserve less trust than their variance says.
    """

    view: Singles
    light: Singles
    radiance: Singles
    variance: Singles
    weight: Singles

    def __post_init__(self) -> None:
        for name in ("view", "light", "radiance", "variance", "weight"):
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float32)
            object.__setattr__(self, name, array)
        if self.weight.ndim != 2:
            raise FittingError(
                f"weights of radiance samples are {self.weight.shape}: (texels, samples) is needed"
            )
        for name in ("view", "light", "radiance", "variance"):
            shape = getattr(self, name).shape
            if shape != (*self.weight.shape, 3):
                raise FittingError(
                    f"{name} of radiance samples is {shape}: the weights ask for "
                    f"{(*self.weight.shape, 3)}"
                )
        if np.any(self.weight < 0.0):
            raise FittingError(
                f"{int(np.sum(self.weight < 0.0))} radiance samples have a negative weight; "
                "zero leaves a sample out"
            )

    @property
    def texels(self) -> int:
        """Number of texels."""
        return int(self.weight.shape[0])

    @property
    def arrays(self) -> SampleArrays:
        """The arrays as the compiled kernels take them."""
        return SampleArrays(self.view, self.light, self.radiance, self.variance, self.weight)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(n, m) array: finite, of positive variance and weight, lit and seen from the front."""
        finite = np.isfinite(self.weight) & (self.weight > 0.0)
        for array in (self.view, self.light, self.radiance, self.variance):
            finite &= np.isfinite(array).all(axis=2)
        front = (self.light[..., 2] > 0.0) & (self.view[..., 2] > 0.0)
        return finite & front & (self.variance > 0.0).all(axis=2)

    def take(self, texels: ArrayLike) -> RadianceSamples:
        """The samples of some texels, by index or mask."""
        chosen = np.asarray(texels)
        return RadianceSamples(
            self.view[chosen],
            self.light[chosen],
            self.radiance[chosen],
            self.variance[chosen],
            self.weight[chosen],
        )

    def masked(self, keep: ArrayLike) -> RadianceSamples:
        """The same samples with zero weight wherever ``keep``, (m,) or (n, m), is false."""
        return replace(self, weight=np.where(np.asarray(keep), self.weight, np.float32(0.0)))

    def limited(self, grazing_limit: float = DEFAULT_GRAZING_LIMIT) -> RadianceSamples:
        """Without samples that graze the surface.

        Within the limit no further weight is needed: a residual of radiance is cos θ times one of
        reflectance, so that grazing light counts by cos² θ.

        Parameters
        ----------
        grazing_limit : float
            Largest angle of light and of view to the normal, radians.
        """
        if not 0.0 < grazing_limit <= math.pi / 2.0:
            raise FittingError(
                f"grazing limit is {grazing_limit} rad: it must lie between 0 and π/2"
            )
        lowest = math.cos(grazing_limit)
        return self.masked((self.light[..., 2] >= lowest) & (self.view[..., 2] >= lowest))


def local_frames(normals: ArrayLike, *, along: ArrayLike = (1.0, 0.0, 0.0)) -> NDArray[np.float64]:
    """Rotations into the frames of texels: z along the normal, x as near ``along`` as can be.

    Parameters
    ----------
    normals : (..., 3) array
        Unit normals.
    along : (3,) array
        Direction that x follows, the canvas's X by default, so that anisotropic lobes of
        neighbouring texels have the same axes.

    Returns
    -------
    (..., 3, 3) array
        Rows are the axes x, y, z: ``frames @ direction`` is the direction in the texel's frame.

    Raises
    ------
    FittingError
        Some normals are not finite or have no length.
    """
    z = np.asarray(normals, dtype=np.float64)
    length = np.linalg.norm(z, axis=-1, keepdims=True)
    if not np.all(np.isfinite(z)) or np.any(length == 0.0):
        raise FittingError("some normals are not finite or zero: texels without one have no frame")
    z = z / length
    x = np.asarray(along, dtype=np.float64)
    x = x / np.linalg.norm(x)
    parallel = np.abs(z @ x) > 0.999
    other = np.eye(3)[(np.argmax(np.abs(x)) + 1) % 3]
    x = np.where(parallel[..., np.newaxis], other, x)
    x = x - np.sum(x * z, axis=-1, keepdims=True) * z
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-2)
