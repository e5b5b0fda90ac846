"""Radiance samples of simulated paint, for holding the reflectance fit against what it is not.

The paint is the simulated rig's microfacet model, seen by some cameras under a ring of lights, with
the noise of a sensor. The model that is fitted is another one.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from devices.simulated.shading_kernels import reflected
from fitting.reflectance.samples import RadianceSamples

Floats = NDArray[np.float64]
READ_NOISE = 0.001  # radiance over irradiance
SHOT_NOISE = 2e-5  # variance per unit of it


@njit(cache=True, parallel=True)
def _shade(finish: NDArray[np.float32], view: Floats, light: Floats, radiance: Floats) -> None:
    """Fill f cos θ (n, m, 3) of texels with a finish each (n, 6)."""
    channels = np.eye(3)
    for t in prange(view.shape[0]):
        for i in range(view.shape[1]):
            half = view[t, i] + light[t, i]
            half /= math.sqrt(np.sum(half * half))
            nl = light[t, i, 2]
            for c in range(3):
                factor = reflected(
                    finish[t],
                    channels[c],
                    nl,
                    view[t, i, 2],
                    half[2],
                    np.sum(half * view[t, i]),
                )
                radiance[t, i, c] = factor / math.pi * nl


def directions(polar: Floats, azimuth: Floats) -> Floats:
    """Unit vectors from angles in radians."""
    sine = np.sin(polar)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(polar)], axis=-1)


def capture_directions(
    texels: int, samples: int, rng: np.random.Generator, *, cameras: int = 3
) -> tuple[Floats, Floats]:
    """Directions of view and light (n, m, 3) in the frames of texels whose normals tilt a little.

    Cameras stand within 40° of the canvas's normal, lights within 65°, normals within about 10°.
    """
    light = directions(
        np.arccos(rng.uniform(math.cos(math.radians(65)), 1.0, samples)),
        rng.uniform(0, 2 * math.pi, samples),
    )
    seen_from = directions(
        np.radians(np.linspace(0, 40, cameras)),
        np.linspace(0, 2 * math.pi, cameras, endpoint=False),
    )
    view = seen_from[np.arange(samples) % cameras]
    tilt = np.radians(np.abs(rng.normal(0, 5, texels)))
    spin = rng.uniform(0, 2 * math.pi, texels)
    z = directions(tilt, spin)
    x = directions(tilt + math.pi / 2, spin)
    frames = np.stack([x, np.cross(z, x), z], axis=1)
    return np.einsum("nij,mj->nmi", frames, view), np.einsum("nij,mj->nmi", frames, light)


def glossy_finishes(texels: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Paint with a highlight: albedo of three channels, roughness, varnish, metal (n, 6)."""
    return np.column_stack(
        [
            rng.uniform(0.02, 0.8, (texels, 3)),
            rng.uniform(0.12, 0.4, texels),
            np.where(rng.random(texels) < 0.3, rng.uniform(0.2, 0.8, texels), 0.0),
            np.zeros(texels),
        ]
    ).astype(np.float32)


def paint_samples(
    finish: NDArray[np.float32] | None,
    texels: int,
    samples: int,
    *,
    seed: int,
    cameras: int = 3,
    noise: bool = True,
) -> RadianceSamples:
    """Samples of simulated paint.

    Parameters
    ----------
    finish : (n, 6) array or None
        None: matt paint, perfectly diffuse.
    texels, samples : int
    seed : int
    cameras : int
    noise : bool
        Whether the sensor's noise is drawn; the variance is given either way.
    """
    rng = np.random.default_rng(seed)
    view, light = capture_directions(texels, samples, rng, cameras=cameras)
    clean = np.empty((texels, samples, 3))
    if finish is None:
        clean[:] = rng.uniform(0.02, 0.8, (texels, 1, 3)) / math.pi * light[..., 2:]
    else:
        _shade(finish, view, light, clean)
    seen = (light[..., 2] > 0.0) & (view[..., 2] > 0.0)
    clean = np.where(seen[..., np.newaxis], clean, 0.0)
    variance = READ_NOISE**2 + SHOT_NOISE * clean
    if noise:
        clean = clean + np.sqrt(variance) * rng.standard_normal(clean.shape)
    arrays = (view, light, clean, variance, seen)
    return RadianceSamples(*(array.astype(np.float32) for array in arrays))
