"""Normals of the texels, as the photographs show them (photometric stereo with a known lobe).

A normal from heights is a mean over neighbours and carries their noise. The samples of a texel say
how the light falls on it itself, much as in photometric stereo (Woodham, Optical Engineering 19,
1980), here with the texel's own lobe in place of Lambert's law. The two are joined by their errors:
the normal from heights is the prior, with its standard error and with what the relief varies by
below the texel, which is learned from the samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fitting.reflectance.clusters import Palette
from fitting.reflectance.flags import TexelFlag
from fitting.reflectance.normal_kernels import fit_tilts
from fitting.reflectance.samples import DEFAULT_GRAZING_LIMIT, RadianceSamples, local_frames
from fitting.reflectance.solver import TexelFits

Floats = NDArray[np.float64]

# What a tilt may be by where nothing has been learned yet, and at least after that.
_WIDE_SPREAD = 0.5
_LEAST_SPREAD = 0.01
_WIDEST_TILT = 1.0


@dataclass(frozen=True)
class RefinedNormals:
    """Normals of ``n`` texels, by their samples and by the heights.

    Attributes
    ----------
    normals : (n, 3) array
        Unit, in the frame that the former normals were given in.
    sigma : (n,) array
        Standard error of the normal along X and Y, root mean square of both.
    tilt : (n, 2) array
        By which they moved, as slopes in the former frames of the texels.
    tilt_sigma : (n, 2) array
        Standard errors of ``tilt``.
    """

    normals: Floats
    sigma: Floats
    tilt: Floats
    tilt_sigma: Floats


def refine_normals(
    samples: RadianceSamples,
    fits: TexelFits,
    palette: Palette,
    normals: Floats,
    *,
    spread: NDArray[np.floating] | float = _WIDE_SPREAD,
    huber_limit: float = 3.0,
) -> RefinedNormals:
    """Fit the normals of texels under the lobes that were fitted to them.

    Parameters
    ----------
    samples : RadianceSamples
        In the frames of ``normals``.
    fits : TexelFits
        Of ``samples``.
    palette : Palette
        Whose materials the fits had; their misfit counts as noise.
    normals : (n, 3) array
    spread : (n,) array or float
        Standard deviation of what the normals may be off by, as a slope.
    huber_limit : float

    Returns
    -------
    RefinedNormals
        Texels without samples, or all dark, keep the normal that they had.
    """
    frames = local_frames(normals)
    misfits = np.array([(m.misfit_floor, m.misfit_relative) for m in palette.materials])
    sd = np.broadcast_to(np.asarray(spread, np.float64), samples.texels)
    tilt, error = fit_tilts(
        samples.view,
        samples.light,
        samples.radiance,
        samples.variance,
        np.where(samples.valid, samples.weight, np.float32(0)),
        misfits[fits.material],
        fits.lobes.coefficients,
        fits.lobes.diffuse,
        fits.lobes.specular,
        np.clip(sd, 1e-6, _WIDEST_TILT),
        huber_limit,
    )
    blind = fits.flagged(TexelFlag.NO_SAMPLES | TexelFlag.DARK)
    tilt[blind] = 0.0
    local = np.concatenate([tilt, np.ones((len(tilt), 1))], axis=1)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    turned = np.einsum("nij,ni->nj", frames, local)
    # A texel that no longer faces the viewer cannot be told by its n_x and n_y: it keeps its own.
    over = turned[:, 2] < 0.05
    turned[over] = normals[over]
    tilt[over] = 0.0
    return RefinedNormals(turned, np.sqrt(np.mean(error**2, axis=1)), tilt, error)


def learned_spread(refined: RefinedNormals, slope_sigma: NDArray[np.floating]) -> float:
    """How much normals vary from those of the heights beyond both errors, as a slope.

    Parameters
    ----------
    refined : RefinedNormals
        Under a wide prior.
    slope_sigma : (n,) array
        Standard errors of the normals from heights.
    """
    squares = np.mean(refined.tilt**2 - refined.tilt_sigma**2, axis=1) - slope_sigma**2
    known = refined.tilt_sigma.max(axis=1) < 0.5 * _WIDE_SPREAD
    if not known.any():
        return _LEAST_SPREAD
    return float(np.sqrt(max(float(np.mean(squares[known])), _LEAST_SPREAD**2)))


def turned_samples(
    samples: RadianceSamples,
    normals: Floats,
    refined: Floats,
    *,
    grazing_limit: float = DEFAULT_GRAZING_LIMIT,
) -> RadianceSamples:
    """The samples in the frames of other normals (n, 3)."""
    turn = local_frames(refined) @ local_frames(normals).swapaxes(1, 2)
    directions = {
        name: np.einsum("nij,nmj->nmi", turn, getattr(samples, name)) for name in ("view", "light")
    }
    return replace(samples, **directions).limited(grazing_limit)
