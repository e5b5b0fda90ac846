"""Photographs kept out of the fit are rendered from the copy and compared.

Each pixel's ray is followed to the height field; the lobes of the four texels around the point are
evaluated under the lamp, and a ray towards the lamp tells whether it is seen from there. Nothing of
the photograph itself is used but where camera and lamp were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.lens import rotation
from fitting.digital_copy import DigitalCopy
from fitting.errors import FittingError
from fitting.reflectance.colour_difference import colour_difference
from fitting.reflectance.photographs import Photograph, halved
from fitting.reflectance.ray_kernels import BLOCKED
from fitting.reflectance.relighting_kernels import relight
from fitting.reflectance.terrain import Terrain

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
_WHITE_PERCENTILE = 99.9
_NOISE_SEED = 0


@dataclass(frozen=True)
class Comparison:
    """A photograph beside its rendering.

    Attributes
    ----------
    name : str
    measured, rendered : (rows, cols, 3) float32 array
        Linear radiance; NaN beyond the canvas, and where the photograph has none.
    white : float
        The 99.9th percentile of the measured radiance: both are clipped there, as a camera would.
    psnr_db : float
        Linear, over pixels and channels of the canvas, with ``white`` as the peak.
    delta_e : (rows, cols) float32 array
        CIEDE2000, ``white`` being (1, 1, 1); NaN where either has no value.
    noise_psnr_db, noise_delta_e : float
        What the photograph's own noise would leave of a perfect rendering: PSNR, and mean ΔE.
    """

    name: str
    measured: Singles
    rendered: Singles
    white: float
    psnr_db: float
    delta_e: Singles
    noise_psnr_db: float
    noise_delta_e: float

    @property
    def mean_delta_e(self) -> float:
        """Mean over the canvas."""
        return float(np.nanmean(self.delta_e))

    @property
    def squared_error(self) -> float:
        """Mean squared error over the squared peak."""
        return float(10.0 ** (-0.1 * self.psnr_db))

    @property
    def squared_noise(self) -> float:
        """What of :attr:`squared_error` the photograph's noise is expected to make."""
        return float(10.0 ** (-0.1 * self.noise_psnr_db))

    def worst_blocks(self, *, block: int, number: int) -> list[tuple[int, int, float]]:
        """Row, column and mean squared error over the squared peak of the worst squares."""
        off = np.sum(((self._clipped("rendered") - self._clipped("measured")) / self.white) ** 2, 2)
        found = []
        for row in range(0, off.shape[0] - block + 1, block):
            for col in range(0, off.shape[1] - block + 1, block):
                part = off[row : row + block, col : col + block]
                if np.isfinite(part).mean() > 0.5:
                    found.append((row, col, float(np.nanmean(part)) / 3))
        return sorted(found, key=lambda place: -place[2])[:number]

    def _clipped(self, name: str) -> Singles:
        return np.asarray(np.minimum(getattr(self, name), np.float32(self.white)))


def compare(measured: Singles, variance: Singles, rendered: Singles, *, name: str) -> Comparison:
    """Compare a photograph (rows, cols, 3) of known noise with its rendering, where both are.

    Parameters
    ----------
    measured, variance, rendered : (rows, cols, 3) float32 arrays
        Linear radiance, the variance of its noise, and the rendering; NaN where there is none. A
        pixel whose variance is not known is compared, but takes no part in what noise would leave.
    name : str

    Raises
    ------
    FittingError
        They have no pixel in common, or the photograph is all dark.
    """
    both = np.isfinite(measured).all(axis=2) & np.isfinite(rendered).all(axis=2)
    if not both.any():
        raise FittingError(f"photograph {name} does not show the canvas")
    white = float(np.percentile(measured[both], _WHITE_PERCENTILE))
    if not white > 0.0:
        raise FittingError(f"photograph {name} is all dark")
    here, there = (np.minimum(image[both], white) / white for image in (measured, rendered))
    error = float(np.mean((here - there) ** 2))
    delta = np.full(both.shape, np.nan, np.float32)
    delta[both] = colour_difference(np.maximum(here, 0.0), np.maximum(there, 0.0))
    return Comparison(
        name,
        np.where(both[..., np.newaxis], measured, np.nan),
        np.where(both[..., np.newaxis], rendered, np.nan),
        white,
        _decibels(error),
        delta,
        *_left_by_noise(here, np.sqrt(np.maximum(variance[both], 0.0)) / white),
    )


def _left_by_noise(seen: Singles, sigma: Singles) -> tuple[float, float]:
    """PSNR and mean ΔE that noise would leave of pixels (n, 3), 1 being the peak; NaN if unknown.

    A pixel with ``sigma`` (n, 3) not known takes no part.
    """
    # A value at the peak is there whatever its noise.
    noise = np.where(seen < 1.0, sigma, 0.0)
    known = np.isfinite(noise).all(axis=1)
    if not known.any():
        return float("nan"), float("nan")
    seen, noise = seen[known], noise[known]
    drawn = np.random.default_rng(_NOISE_SEED).standard_normal(noise.shape)
    again = np.clip(seen + noise * drawn, 0.0, 1.0)
    delta = colour_difference(np.maximum(seen, 0.0), again)
    return _decibels(float(np.mean(noise**2))), float(np.mean(delta))


def _decibels(squared_error: float) -> float:
    return -10.0 * float(np.log10(max(squared_error, 1e-15)))


class Relighting:
    """A copy seen from one place of the camera, to be lit by any lamp.

    Parameters
    ----------
    copy : DigitalCopy
        With reflectance.
    terrain : Terrain
        What throws shadows.
    photograph : Photograph
        Whose camera is used; its radiance is not looked at.

    Raises
    ------
    FittingError
        The copy has no reflectance.
    """

    def __init__(self, copy: DigitalCopy, terrain: Terrain, photograph: Photograph) -> None:
        if copy.reflectance is None:
            raise FittingError("a copy without reflectance cannot be lit")
        self._maps = copy.reflectance
        self._copy = copy
        self._terrain = terrain
        rows_px, cols_px = photograph.radiance.shape[:2]
        self._shape = (rows_px, cols_px)
        eye = photograph.eye
        slopes = photograph.lens.pixel_slopes(origin=photograph.first_pixel, shape=self._shape)
        rays = np.concatenate([slopes, np.ones((*self._shape, 1))], axis=2).reshape(-1, 3)
        rays = rays @ rotation(photograph.rt_cam_canvas)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        points = terrain.seen_from(eye, rays)
        heights = copy.height_field
        places = np.stack(
            [
                (points[:, 0] - heights.origin_mm[0]) / heights.pitch_mm,
                (heights.origin_mm[1] - points[:, 1]) / heights.pitch_mm,
            ],
            axis=1,
        )
        rows, cols = heights.shape
        inside = (places >= 0).all(axis=1) & (places <= [cols - 1, rows - 1]).all(axis=1)
        on = np.flatnonzero(inside)
        col = np.minimum(places[on, 0].astype(int), cols - 2)
        row = np.minimum(places[on, 1].astype(int), rows - 2)
        whole = np.ones(len(on), np.bool_)
        for i in (0, 1):
            for j in (0, 1):
                whole &= heights.mask[row + i, col + j]
        self._pixels = on[whole]
        self._points = points[self._pixels]
        self._places = places[self._pixels]
        self._view = -rays[self._pixels]
        self._clearance = np.sqrt(heights.variance)[row[whole], col[whole]]
        self._horizons = terrain.horizons(self._points)

    def rendered(self, photograph: Photograph) -> Singles:
        """Radiance (rows, cols, 3) under the photograph's lamp; NaN beyond the canvas."""
        lamp, pitch = photograph.lamp, self._copy.height_field.pitch_mm
        found = self._terrain.findings(
            self._points,
            lamp.position,
            clearance_mm=self._clearance + 1e-3 * pitch,
            horizons=self._horizons,
        )
        irradiance = lamp.irradiance(self._points)
        irradiance[found == BLOCKED] = 0.0
        image = np.full((self._shape[0] * self._shape[1], 3), np.nan, np.float32)
        image[self._pixels] = relight(
            self._copy.normal_xy,
            self._maps.diffuse,
            self._maps.specular,
            self._maps.lobe,
            self._places,
            self._view,
            lamp.directions(self._points),
            irradiance,
        )
        return image.reshape(*self._shape, 3)

    def compared(self, photograph: Photograph) -> Comparison:
        """A photograph from this place, beside its rendering."""
        rendered = self.rendered(photograph)
        if photograph.mosaic is not None:
            rendered = halved(rendered, photograph.channels)
        return compare(*photograph.colour_planes(), rendered, name=photograph.name)


def compare_held_out(
    copy: DigitalCopy, terrain: Terrain, photographs: Sequence[Photograph]
) -> list[Comparison]:
    """Compare photographs that the fit has not seen with their renderings."""
    places: dict[tuple[bytes, ...], Relighting] = {}
    compared = []
    for photograph in photographs:
        key = photograph.viewpoint
        if key not in places:
            places = {key: Relighting(copy, terrain, photograph)}  # one view in memory
        compared.append(places[key].compared(photograph))
    return compared


def pooled_psnr_db(comparisons: Sequence[Comparison]) -> float:
    """PSNR of all photographs together, each relative to its own peak."""
    return _decibels(float(np.mean([one.squared_error for one in comparisons])))


def pooled_noise_psnr_db(comparisons: Sequence[Comparison]) -> float:
    """The same of a perfect copy, by the noise of the photographs alone."""
    return _decibels(float(np.mean([one.squared_noise for one in comparisons])))
