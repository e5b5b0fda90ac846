"""What one lobe cannot say of real paint, as an error that is added to the samples' own.

Measured radiance is far more precise than any one-lobe model. Without a standard error for the
model, priors would count for nothing, skirts of a highlight would outweigh its peak, and every
error bar would be too short. Whether there is a misfit is told by the residuals; its size and its
shape (constant, or growing with the radiance) are chosen by held-out error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fitting.reflectance.materials import Material
from fitting.reflectance.samples import RadianceSamples
from fitting.reflectance.solver import SolverOptions, TexelFits, fit_texels

# Residuals up to this, in terms of χ² per degree of freedom, are put down to chance.
_UNREMARKABLE = 1.15


@dataclass(frozen=True)
class MisfitShape:
    """How the misfit is composed.

    Attributes
    ----------
    floor : float
        Share of the material's median radiance.
    relative : float
        Share of the sample's own radiance.
    """

    floor: float
    relative: float


MISFIT_SHAPES = tuple(
    MisfitShape(size, size * slope) for slope in (0.0, 1.0) for size in (0.05, 0.1, 0.2)
)


def median_radiance(samples: RadianceSamples) -> float:
    """Median over all valid samples and channels, never below zero."""
    valid = samples.radiance[samples.valid]
    return max(float(np.median(valid)), 0.0) if valid.size else 0.0


def independent_channels(samples: RadianceSamples) -> int:
    """One if the samples are grey, which carry one channel thrice under tripled variance."""
    red, green, blue = np.moveaxis(samples.radiance, -1, 0)
    grey = np.array_equal(red, green, equal_nan=True) and np.array_equal(red, blue, equal_nan=True)
    return 1 if grey else 3


def reduced_chi_square(fits: TexelFits, variant: int, *, channels: int = 3) -> float:
    """Median over texels of the cost per degree of freedom; 1 where nothing can be judged by."""
    unknowns = np.where(fits.has_highlight, 2 * channels + variant, channels)
    freedom = channels * fits.samples - unknowns
    judged = freedom > 0
    if not judged.any():
        return 1.0
    return float(np.median(fits.cost[judged] / freedom[judged]))


def has_misfit(samples: RadianceSamples, material: Material, *, options: SolverOptions) -> bool:
    """Whether residuals are larger than the samples' own errors explain.

    Parameters
    ----------
    samples : RadianceSamples
        Of a few hundred texels of the material.
    material : Material
        Its priors are used in the fits.
    options : SolverOptions
    """
    fits = fit_texels(samples, [material], options=options)
    channels = independent_channels(samples)
    return reduced_chi_square(fits, int(material.variant), channels=channels) > _UNREMARKABLE


def with_misfit(samples: RadianceSamples, material: Material, shape: MisfitShape) -> Material:
    """The material with a misfit of the given shape."""
    return replace(
        material,
        misfit_floor=shape.floor * median_radiance(samples),
        misfit_relative=shape.relative,
    )
