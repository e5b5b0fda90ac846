"""Reflectance of a copy from photographs, checked by photographs that the fit has not seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calibration.lens import invert, transform
from fitting.digital_copy import DigitalCopy
from fitting.reflectance.back_projection import PhotographSampler, SamplingOptions
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.held_out import (
    Comparison,
    compare_held_out,
    pooled_noise_psnr_db,
    pooled_psnr_db,
)
from fitting.reflectance.maps import FittedReflectance, MapOptions, fit_maps
from fitting.reflectance.photographs import Photograph
from fitting.reflectance.terrain import Terrain
from fitting.surface import Surface
from workstation.interruption import interruption_held

# With fewer photographs than this none is kept out by default.
_ENOUGH = 12


@dataclass(frozen=True, kw_only=True)
class ReflectanceOptions:
    """Options of the reflectance stages.

    Attributes
    ----------
    sampling : SamplingOptions
    maps : MapOptions
    hold_out_every : int
        Every so many photographs one is kept out of the fit; 0 keeps none.
    """

    sampling: SamplingOptions = field(default_factory=SamplingOptions)
    maps: MapOptions = field(default_factory=MapOptions)
    hold_out_every: int = 8


@dataclass(frozen=True)
class AddedReflectance:
    """A copy with reflectance.

    Attributes
    ----------
    copy : DigitalCopy
    comparisons : list of Comparison
        Of the photographs kept out of the fit.
    figures : dict
        Plain JSON values.
    """

    copy: DigitalCopy
    comparisons: list[Comparison]
    figures: dict[str, Any]


def add_reflectance(
    copy: DigitalCopy,
    photographs: Sequence[Photograph],
    *,
    surface: Surface | None = None,
    options: ReflectanceOptions | None = None,
    begin: Callable[[str], None] = lambda stage: None,
) -> AddedReflectance:
    """Fit reflectance to a copy and check it.

    Parameters
    ----------
    copy : DigitalCopy
    photographs : sequence of Photograph
    surface : Surface, optional
        Of the scan: what it saw beyond the canvas, the frame above all, throws shadows too.
    options : ReflectanceOptions, optional
    begin : callable, optional
        Called with the name of each stage as it starts.

    Raises
    ------
    FittingError
    """
    options = options or ReflectanceOptions()
    every = options.hold_out_every if len(photographs) >= _ENOUGH else 0
    held = [p for n, p in enumerate(photographs) if every and n % every == every // 2]
    used = [p for n, p in enumerate(photographs) if not (every and n % every == every // 2)]
    begin("fitting the reflectance")
    with interruption_held():
        terrain = Terrain.of(copy.height_field, surroundings=surroundings_of(copy, surface))
    sampler = PhotographSampler(copy, used, terrain, options.sampling)
    fitted = fit_maps(sampler, options=options.maps, guarded=interruption_held)
    copy = fitted.added_to(copy)
    begin("checking against photographs kept out")
    with interruption_held():
        comparisons = compare_held_out(copy, terrain, held)
    return AddedReflectance(copy, comparisons, _figures(sampler, fitted, comparisons))


def surroundings_of(copy: DigitalCopy, surface: Surface | None) -> np.ndarray | None:
    """Points (n, 3) in the canvas frame, mm, that a scan saw beyond the canvas: they cast shadows.

    None where there was no scan.
    """
    if surface is None:
        return None
    image = surface.range_image
    beyond = image.points[image.valid & ~surface.canvas.outline]
    return transform(invert(copy.height_field.rt_cam_canvas), beyond)


def comparison_figures(one: Comparison) -> dict[str, Any]:
    """Plain JSON values of a photograph that was kept out."""
    return {
        "name": one.name,
        "psnr_db": one.psnr_db,
        "delta_e": one.mean_delta_e,
        "noise_psnr_db": one.noise_psnr_db,
        "noise_delta_e": one.noise_delta_e,
    }


def _figures(
    sampler: PhotographSampler, fitted: FittedReflectance, comparisons: list[Comparison]
) -> dict[str, Any]:
    quality = fitted.maps.quality
    assert quality is not None  # fitted maps have it
    mask = sampler.copy.height_field.mask
    flags = quality.flags[mask]
    figures: dict[str, Any] = {
        "photographs": len(sampler.photographs),
        "samples_median": float(np.median(quality.samples[mask])),
        "residual_median": float(np.median(quality.residual[mask])),
        "normal_spread": fitted.normal_spread,
        "flags": {
            flag.name: float(np.mean((flags & int(flag)) != 0)) for flag in TexelFlag if flag.name
        },
        "materials": [
            {
                "k": float(np.exp(material.shape_mean[0])),
                "variant": material.variant.name,
                "misfit": material.misfit_floor,
                "misfit_relative": material.misfit_relative,
            }
            for material in fitted.palette.materials
        ],
        "rays": {
            "tested": sampler.rays.tested,
            "cast": sampler.rays.cast,
            "blocked": sampler.rays.blocked,
        },
    }
    if comparisons:
        figures["held_out"] = {
            "psnr_db": pooled_psnr_db(comparisons),
            "delta_e": float(np.mean([one.mean_delta_e for one in comparisons])),
            "noise_psnr_db": pooled_noise_psnr_db(comparisons),
            "noise_delta_e": float(np.mean([one.noise_delta_e for one in comparisons])),
            "photographs": [comparison_figures(one) for one in comparisons],
        }
    return figures
