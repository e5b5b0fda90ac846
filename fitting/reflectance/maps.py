"""Reflectance maps of a copy: its texels fitted tile by tile under one palette of materials."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from fitting.digital_copy import DigitalCopy, ReflectanceMaps, ReflectanceQuality
from fitting.errors import FittingError
from fitting.reflectance.back_projection import PhotographSampler, Tile
from fitting.reflectance.clusters import ClusterOptions, Palette, find_materials, fit_tile
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.normals import learned_spread, refine_normals, turned_samples
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.solver import DEFAULT_OPTIONS, SolverOptions, TexelFits

_BLOCK = 12  # texels a side of the blocks that are surveyed
_SURVEY = 1.5  # times as many texels are looked at as are surveyed; some have no samples


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """How the maps are fitted.

    Attributes
    ----------
    clusters : ClusterOptions
    solver : SolverOptions
    refine_normals : bool
        Whether the texels' normals are fitted as well (:mod:`fitting.reflectance.normals`).
    """

    clusters: ClusterOptions = field(default_factory=ClusterOptions)
    solver: SolverOptions = DEFAULT_OPTIONS
    refine_normals: bool = True


@dataclass(frozen=True)
class FittedReflectance:
    """Maps, and what they came from.

    Attributes
    ----------
    maps : ReflectanceMaps
        With their quality.
    palette : Palette
        The materials found.
    texels : int
        Texels fitted.
    normal_xy : (rows, cols, 2) float32 array
        Normals under which they were fitted.
    slope_sigma : (rows, cols) float32 array
        Their standard errors.
    normal_spread : float
        How much normals differ from those of the heights beyond the errors of both, as a slope;
        zero where they were not refined.
    """

    maps: ReflectanceMaps
    palette: Palette
    texels: int
    normal_xy: NDArray[np.float32]
    slope_sigma: NDArray[np.float32]
    normal_spread: float

    def added_to(self, copy: DigitalCopy) -> DigitalCopy:
        """The copy with this reflectance, and with the normals that go with it."""
        return replace(
            copy,
            reflectance=self.maps,
            normal_xy=self.normal_xy,
            slope_sigma=self.slope_sigma,
        )


def fit_maps(
    sampler: PhotographSampler,
    *,
    options: MapOptions | None = None,
    surveyed: PhotographSampler | None = None,
    guarded: Callable[[], AbstractContextManager[None]] = nullcontext,
    advance: Callable[[float], None] = lambda share: None,
) -> FittedReflectance:
    """Fit a lobe to every measured texel of a copy.

    Texels without a sample, in shadow under every lamp say, and gaps take the values of the nearest
    fitted texel, so that interpolation meets no hole; the flag ``NO_SAMPLES`` tells.

    Parameters
    ----------
    sampler : PhotographSampler
    options : MapOptions, optional
    surveyed : PhotographSampler, optional
        Takes the samples that materials are learned from: of fewer of many photographs of the same
        copy, since that takes the most time. By default ``sampler`` does.
    guarded : callable, optional
        Makes the context in which each tile is worked on, to hold interruptions off.
    advance : callable, optional
        Called with the share of texels done.

    Returns
    -------
    FittedReflectance

    Raises
    ------
    FittingError
        No texel has a sample.
    """
    options = options or MapOptions()
    with guarded():
        palette, spread = _survey(surveyed or sampler, options)
    mask = sampler.copy.height_field.mask
    maps = _empty_maps(mask.shape)
    normal_xy, slope_sigma = sampler.copy.normal_xy.copy(), sampler.copy.slope_sigma.copy()
    done, total = 0, int(mask.sum())
    for tile in sampler.tiles():
        with guarded():
            samples = sampler.samples(tile)
            fits = fit_tile(samples, palette, options=options.solver)
            if options.refine_normals:
                own = mask[tile.slices]
                prior = np.hypot(slope_sigma[tile.slices][own], spread)
                before = sampler.normals(tile)
                refined = refine_normals(samples, fits, palette, before, spread=prior)
                normal_xy[tile.slices][own] = refined.normals[:, :2]
                slope_sigma[tile.slices][own] = refined.sigma
                samples = _turned(sampler, samples, before, refined.normals)
                fits = fit_tile(samples, palette, options=options.solver)
            _store(maps, tile, mask[tile.slices], samples, fits)
        done += samples.texels
        advance(done / total)
    assert maps.quality is not None  # made just above
    fitted = mask & (maps.quality.samples > 0)
    if not fitted.any():
        raise FittingError(
            f"none of {total} texels has a sample: do the photographs show the canvas, and do the "
            "lamps stand before it?"
        )
    return FittedReflectance(
        _without_holes(maps, fitted), palette, total, normal_xy, slope_sigma, spread
    )


def _survey(sampler: PhotographSampler, options: MapOptions) -> tuple[Palette, float]:
    """The materials, and how much normals vary below the texels."""
    survey, normals, sigma = survey_samples(sampler, options.clusters)

    def find(samples: RadianceSamples, most: int) -> Palette:
        clusters = replace(options.clusters, most=most)
        return find_materials(samples, cluster_options=clusters, options=options.solver)

    if not options.refine_normals:
        return find(survey, options.clusters.most), 0.0
    # One lobe for all texels is enough to tell normals by, and most of the work is in telling
    # materials apart.
    palette = find(survey, 1)
    fits = fit_tile(survey, palette, options=options.solver)
    spread = learned_spread(refine_normals(survey, fits, palette, normals), sigma)
    refined = refine_normals(survey, fits, palette, normals, spread=np.hypot(sigma, spread))
    # Misfit and priors are learned with normals that are no longer off.
    turned = _turned(sampler, survey, normals, refined.normals)
    return find(turned, options.clusters.most), spread


def _turned(
    sampler: PhotographSampler,
    samples: RadianceSamples,
    normals: NDArray[np.float64],
    refined: NDArray[np.float64],
) -> RadianceSamples:
    limit = sampler.options.grazing_limit
    return turned_samples(samples, normals, refined, grazing_limit=limit)


def survey_samples(
    sampler: PhotographSampler, options: ClusterOptions
) -> tuple[RadianceSamples, NDArray[np.float64], NDArray[np.float64]]:
    """Samples of texels from all over the copy, in small blocks, for finding its materials.

    Returns
    -------
    samples : RadianceSamples
    normals : (n, 3) array
    slope_sigma : (n,) array
    """
    mask = sampler.copy.height_field.mask
    rng = np.random.default_rng(options.seed)
    wanted = _SURVEY * options.survey
    parts, normals, sigma = [], [], []
    count = 0
    for tile in _blocks(mask, rng):
        part = sampler.samples(tile)
        seen = part.valid.any(axis=1)
        parts.append(part.take(seen))
        normals.append(sampler.normals(tile)[seen])
        sigma.append(sampler.copy.slope_sigma[tile.slices][mask[tile.slices]][seen])
        count += parts[-1].texels
        if count >= wanted:
            break
    samples = RadianceSamples(
        *(
            np.concatenate([getattr(part, item.name) for part in parts])
            for item in fields(RadianceSamples)
        )
    )
    return samples, np.concatenate(normals), np.concatenate(sigma).astype(np.float64)


def _blocks(mask: NDArray[np.bool_], rng: np.random.Generator) -> Iterator[Tile]:
    """Every block that holds a measured texel, in random order."""
    rows, cols = mask.shape
    corners = [(r, c) for r in range(0, rows, _BLOCK) for c in range(0, cols, _BLOCK)]
    for i in rng.permutation(len(corners)):
        row, col = corners[i]
        tile = Tile((row, min(row + _BLOCK, rows)), (col, min(col + _BLOCK, cols)))
        if mask[tile.slices].any():
            yield tile


def _empty_maps(shape: tuple[int, ...]) -> ReflectanceMaps:
    def zeros(*channels: int) -> NDArray[np.float32]:
        return np.zeros((*shape, *channels), np.float32)

    counts = [np.zeros(shape, np.uint16) for _ in range(2)]
    quality = ReflectanceQuality(zeros(3), zeros(3), zeros(3), zeros(), *counts)
    return ReflectanceMaps(zeros(3), zeros(3), zeros(4), quality)


def _store(
    maps: ReflectanceMaps,
    tile: Tile,
    own: NDArray[np.bool_],
    samples: RadianceSamples,
    fits: TexelFits,
) -> None:
    """Write the fits of a tile's measured texels into the maps."""
    quality = maps.quality
    assert quality is not None  # of maps made here
    errors = fits.standard_errors
    for target, values in (
        (maps.diffuse, fits.lobes.diffuse),
        (maps.specular, fits.lobes.specular),
        (maps.lobe, fits.lobes.coefficients),
        (quality.lobe_sigma, errors[:, :3]),
        (quality.diffuse_sigma, errors[:, 3:6]),
        (quality.specular_sigma, errors[:, 6:]),
        (quality.residual, residual_rms(samples, fits)),
        (quality.samples, np.minimum(fits.samples, np.iinfo(np.uint16).max)),
        (quality.flags, fits.flags),
    ):
        target[tile.slices][own] = values


def residual_rms(samples: RadianceSamples, fits: TexelFits) -> NDArray[np.float64]:
    """RMS of radiance over irradiance that the fits leave of the valid samples, (n,)."""
    valid = samples.valid
    off = fits.lobes.radiance(samples.view, samples.light) - samples.radiance
    squares = np.where(valid, np.sum(off**2, axis=2), 0.0).sum(axis=1)
    return np.asarray(np.sqrt(squares / np.maximum(3 * valid.sum(axis=1), 1)))


def _without_holes(maps: ReflectanceMaps, fitted: NDArray[np.bool_]) -> ReflectanceMaps:
    """The maps with the lobes of the nearest fitted texel where there is none."""
    if fitted.all():
        return maps
    nearest = tuple(distance_transform_edt(~fitted, return_distances=False, return_indices=True))
    assert maps.quality is not None  # of maps made here
    flags = maps.quality.flags | np.where(fitted, 0, int(TexelFlag.NO_SAMPLES)).astype(np.uint16)
    errors = {
        name: getattr(maps.quality, name)[nearest]
        for name in ("diffuse_sigma", "specular_sigma", "lobe_sigma")
    }
    quality = ReflectanceQuality(
        **errors, residual=maps.quality.residual, samples=maps.quality.samples, flags=flags
    )
    return ReflectanceMaps(
        maps.diffuse[nearest], maps.specular[nearest], maps.lobe[nearest], quality
    )
