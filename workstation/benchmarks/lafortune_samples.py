"""Radiance samples whose truth is a Lafortune lobe, for holding parameters and flags against it.

What single lobes cannot say of real paint does not matter here: the model is the one that is
fitted, so that errors are those of noise and directions alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitting.reflectance.lobe import LafortuneLobes
from fitting.reflectance.materials import Material
from fitting.reflectance.samples import RadianceSamples
from workstation.benchmarks.paint_samples import READ_NOISE, SHOT_NOISE, capture_directions

Floats = NDArray[np.float64]

_REACHED = 1e-3  # share of the highlight from which a sample shows it
_SMOOTH_SIDE = 40

# What is known of the lobes that make_lobes makes by default.
KNOWN_MATERIAL = Material(
    shape_mean=np.array([3.7, -0.03, 0.0]),
    shape_covariance=np.diag(np.square([0.4, 0.03, 0.02])),
    specular_mean=np.full(3, 0.4),
    specular_sd=np.full(3, 0.12),
)
# Of narrow ones, as in hidden_highlights.
NARROW_MATERIAL = Material(
    shape_mean=np.array([4.5, -0.03, 0.0]),
    shape_covariance=np.diag(np.square([0.1, 0.03, 0.02])),
    specular_mean=np.full(3, 0.4),
    specular_sd=np.full(3, 0.12),
)


def make_lobes(
    texels: int,
    rng: np.random.Generator,
    *,
    ln_k: tuple[float, float] = (3.7, 0.4),
    ln_r: tuple[float, float] = (-0.03, 0.03),
    ln_c: tuple[float, float] = (0.0, 0.0),
    specular: tuple[float, float] = (0.2, 0.6),
) -> LafortuneLobes:
    """Lobes at random: mean and deviation of the shape's logarithms, range of a grey ρ_s."""
    shape = np.column_stack([rng.normal(*p, texels) for p in (ln_k, ln_r, ln_c)])
    shine = np.repeat(rng.uniform(*specular, (texels, 1)), 3, axis=1)
    return LafortuneLobes(shape, rng.uniform(0.05, 0.25, (texels, 3)), shine)


def observe(
    lobes: LafortuneLobes, samples: int, seed: int, *, cameras: int = 3, noise: float = 1.0
) -> RadianceSamples:
    """Samples of lobes under the directions and noise of simulated paint."""
    rng = np.random.default_rng(seed)
    view, light = capture_directions(len(lobes.shape), samples, rng, cameras=cameras)
    clean = lobes.radiance(view, light)
    variance = noise**2 * (READ_NOISE**2 + SHOT_NOISE * clean)
    noisy = clean + np.sqrt(variance) * rng.standard_normal(clean.shape)
    seen = (light[..., 2] > 0) & (view[..., 2] > 0)
    arrays = (view, light, noisy, variance, seen)
    return RadianceSamples(*(array.astype(np.float32) for array in arrays))


def reached(lobes: LafortuneLobes, samples: RadianceSamples) -> NDArray[np.bool_]:
    """Samples that show a thousandth of the highlight's height head-on, or more, (n, m)."""
    none = np.zeros_like(lobes.diffuse)
    alone = LafortuneLobes(lobes.shape, none, none + 1.0)
    return np.asarray(alone.reflectance(samples.view, samples.light)[..., 0] >= _REACHED)


def narrow_highlights(texels: int, *, seed: int) -> tuple[LafortuneLobes, RadianceSamples]:
    """Narrow lobes, k near 90, that 60 samples each may or may not show."""
    truth = make_lobes(texels, np.random.default_rng(seed), ln_k=(4.5, 0.1))
    return truth, observe(truth, 60, seed)


def smooth_paint(*, seed: int) -> tuple[LafortuneLobes, RadianceSamples]:
    """A square of 40 × 40 texels whose lobe changes evenly across it, row by row."""
    y, x = np.mgrid[:_SMOOTH_SIDE, :_SMOOTH_SIDE] / float(_SMOOTH_SIDE)
    shape = np.stack([3.5 + 0.3 * x + 0.2 * y, -0.03 + 0.02 * x, np.zeros_like(x)], axis=2)
    flat = shape.reshape(-1, 3)
    truth = LafortuneLobes(flat, np.full(flat.shape, 0.15), np.full(flat.shape, 0.4))
    return truth, observe(truth, 96, seed)
