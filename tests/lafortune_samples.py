"""Samples whose truth is a Lafortune lobe: for the recovery of parameters only."""

from __future__ import annotations

import numpy as np

from fitting.reflectance.lobe import LafortuneLobes
from fitting.reflectance.samples import RadianceSamples
from workstation.benchmarks.paint_samples import READ_NOISE, SHOT_NOISE, capture_directions


def make_lobes(
    texels: int,
    rng: np.random.Generator,
    *,
    ln_k=(3.7, 0.4),
    ln_r=(-0.03, 0.03),
    ln_c=(0.0, 0.0),
    specular=(0.2, 0.6),
) -> LafortuneLobes:
    shape = np.column_stack([rng.normal(*p, texels) for p in (ln_k, ln_r, ln_c)])
    shine = np.repeat(rng.uniform(*specular, (texels, 1)), 3, axis=1)
    return LafortuneLobes(shape, rng.uniform(0.05, 0.25, (texels, 3)), shine)


def observe(
    lobes: LafortuneLobes, samples: int, seed: int, *, cameras: int = 3, noise: float = 1.0
) -> RadianceSamples:
    rng = np.random.default_rng(seed)
    view, light = capture_directions(len(lobes.shape), samples, rng, cameras=cameras)
    clean = lobes.radiance(view, light)
    variance = noise**2 * (READ_NOISE**2 + SHOT_NOISE * clean)
    noisy = clean + np.sqrt(variance) * rng.standard_normal(clean.shape)
    seen = (light[..., 2] > 0) & (view[..., 2] > 0)
    return RadianceSamples(view, light, noisy, variance, seen)
