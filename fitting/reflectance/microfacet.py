r"""Lafortune lobes as GGX microfacets, for viewers that know no other reflectance.

What such viewers evaluate is :math:`a/\pi + D_\alpha V_\alpha F`, with the diffuse albedo a, GGX's
distribution D (Walter et al., EGSR 2007), Smith's height-correlated visibility V (Heitz, JCGT 2014)
and Schlick's Fresnel term :math:`F = F_0 + (1 - F_0)(1 - v \cdot h)^5` (1994). Diffuse light
carries over as it is, :math:`a = \pi \rho_d`. For the highlight, F is linear in F_0: for each α of
a grid the best F_0 follows from inner products of lobes over directions, and the best α is
searched.

The error of a texel is that of f cos θ, root mean square over directions of view and light up to
65°, relative to that of f cos θ itself: the metric that measured paints are fitted under.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fitting.digital_copy import ReflectanceMaps

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

_WIDEST_ANGLE = np.radians(65.0)
_ALPHAS = np.geomspace(0.01, 1.0, 41)
_LN_K = np.linspace(0.0, np.log(3000.0), 49)
_LN_R = np.linspace(-0.9, 0.9, 19)
_LN_C = np.linspace(-0.8, 0.8, 5)
_LARGEST_LOG = 100.0
_CHUNK = 4096


@dataclass(frozen=True)
class MicrofacetMaps:
    """Reflectance of a copy as GGX microfacets.

    Attributes
    ----------
    albedo : (rows, cols, 3) float32 array
        Diffuse, π ρ_d.
    f0 : (rows, cols, 3) float32 array
        Reflectance of the facets at normal incidence.
    alpha : (rows, cols) float32 array
        Width α of GGX; glTF's roughness is its square root.
    error : (rows, cols) float32 array
        Relative RMS of f cos θ that the conversion costs.
    """

    albedo: Singles
    f0: Singles
    alpha: Singles
    error: Singles


@dataclass(frozen=True)
class _Moments:
    """Inner products over directions, weighted by cos² θ and solid angle.

    Of lobes L (one per k, r, c), of ``g``: D V times Schlick's 1 - (1 - v·h)⁵, of ``s``: D V times
    (1 - v·h)⁵ (both one per α), and of 1.
    """

    ll: Floats
    l1: Floats
    lg: Floats
    ls: Floats
    gg: Floats
    gs: Floats
    ss: Floats
    one: float


def microfacets_of(maps: ReflectanceMaps) -> MicrofacetMaps:
    """Convert a copy's lobes to microfacets.

    Parameters
    ----------
    maps : ReflectanceMaps

    Returns
    -------
    MicrofacetMaps
    """
    shape = maps.lobe.shape[:2]
    diffuse = maps.diffuse.reshape(-1, 3).astype(np.float64)
    specular = maps.specular.reshape(-1, 3).astype(np.float64)
    lobe = maps.lobe.reshape(-1, 4).astype(np.float64)
    f0 = np.zeros((len(lobe), 3))
    alpha, error = np.ones(len(lobe)), np.zeros(len(lobe))
    for start in range(0, len(lobe), _CHUNK):
        part = slice(start, start + _CHUNK)
        f0[part], alpha[part], error[part] = _convert(diffuse[part], specular[part], lobe[part])
    return MicrofacetMaps(
        (np.pi * maps.diffuse).astype(np.float32),
        f0.reshape(*shape, 3).astype(np.float32),
        alpha.reshape(shape).astype(np.float32),
        error.reshape(shape).astype(np.float32),
    )


def _convert(diffuse: Floats, specular: Floats, lobe: Floats) -> tuple[Floats, Floats, Floats]:
    """F_0 (n, 3), α (n,) and relative error (n,) of texels."""
    table = _moments()
    c_x, c_y, c_z = -lobe[:, 0], -lobe[:, 1], lobe[:, 2]
    ln_k = np.log(np.clip(lobe[:, 3], 1.0, 3000.0))
    usable = (c_x > 0) & (c_y > 0) & (c_z > 0)
    ln_r = np.where(usable, np.log(np.where(usable, c_z / np.where(usable, c_x, 1.0), 1.0)), 0.0)
    ln_c = np.where(usable, np.log(np.where(usable, c_y / np.where(usable, c_x, 1.0), 1.0)), 0.0)
    # On the scale where C_z = 1.
    strength = specular * np.where(c_z > 0, c_z, 0.0)[:, np.newaxis] ** lobe[:, 3:]
    k, r, c = (_nearest(_LN_K, ln_k), _nearest(_LN_R, ln_r), _nearest(_LN_C, ln_c))
    at = np.ravel_multi_index((k, r, c), (len(_LN_K), len(_LN_R), len(_LN_C)))
    # Spread over α: (n, alphas, channels).
    rho = strength[:, np.newaxis, :]
    lg, ls = table.lg[at][..., np.newaxis], table.ls[at][..., np.newaxis]
    gg, gs, ss = (m[:, np.newaxis] for m in (table.gg, table.gs, table.ss))
    # F = F_0 g + s: least squares in F_0, which is a share.
    best = np.clip((rho * lg - gs) / gg, 0.0, 1.0) * (rho > 0)
    ll = table.ll[at][:, np.newaxis, np.newaxis]
    off = rho**2 * ll + best**2 * gg + ss + 2 * best * gs - 2 * rho * (best * lg + ls)
    off = np.where(rho > 0, np.maximum(off, 0.0), 0.0).sum(axis=2)
    chosen = np.argmin(off, axis=1)
    texel = np.arange(len(at))
    step = _parabola(off, chosen)
    f0 = best[texel, chosen]
    # Between the grid's lobes: α² goes as 1 / k, and F_0 as α² at a highlight's given height.
    scale = np.exp(step * np.log(_ALPHAS[1] / _ALPHAS[0]) + 0.5 * (_LN_K[k] - ln_k))
    own = np.sum(
        diffuse**2 * table.one
        + 2 * diffuse * strength * table.l1[at][:, np.newaxis]
        + strength**2 * table.ll[at][:, np.newaxis],
        axis=1,
    )
    error = np.sqrt(off[texel, chosen] / np.maximum(own, 1e-300))
    shining = (strength > 0).any(axis=1)
    alpha = np.where(shining, np.clip(_ALPHAS[chosen] * scale, 0.005, 1.0), 1.0)
    return np.clip(f0 * scale[:, np.newaxis] ** 2, 0.0, 1.0), alpha, np.where(shining, error, 0.0)


def _nearest(grid: Floats, values: Floats) -> NDArray[np.int64]:
    step = grid[1] - grid[0]
    return np.clip(np.rint((values - grid[0]) / step), 0, len(grid) - 1).astype(np.int64)


def _parabola(off: Floats, chosen: NDArray[np.int64]) -> Floats:
    """Where between its neighbours the least error lies, in steps of the grid."""
    texel = np.arange(len(chosen))
    inner = np.clip(chosen, 1, off.shape[1] - 2)
    low, middle, high = (off[texel, inner + i] for i in (-1, 0, 1))
    curvature = low - 2 * middle + high
    step = np.where(curvature > 0, 0.5 * (low - high) / np.where(curvature > 0, curvature, 1), 0.0)
    return np.where(inner == chosen, np.clip(step, -0.5, 0.5), 0.0)


def ggx(alpha: Floats | float, nl: Floats, nv: Floats, nh: Floats) -> Floats:
    """D V of GGX with height-correlated masking, 1/sr, without Fresnel's term."""
    a2 = np.asarray(alpha, dtype=np.float64) ** 2
    peak = nh**2 * (a2 - 1) + 1
    masking = nl * np.sqrt(nv**2 * (1 - a2) + a2) + nv * np.sqrt(nl**2 * (1 - a2) + a2)
    return np.asarray(a2 / (np.pi * peak**2) * 0.5 / masking)


def _directions() -> tuple[Floats, Floats, Floats, Floats]:
    """View, light and half vectors (m, 3), and weights (m,): finest where highlights are.

    Half vectors are laid out about the normal, evenly in the logarithm of their angle; a solid
    angle of light is 4 v·h times one of the half vector.
    """
    view_angle = np.radians([2.0, 15.0, 30.0, 45.0, 58.0])
    spin = np.radians([0.0, 45.0, 90.0])
    edges = np.concatenate([[0.0], np.geomspace(np.radians(0.15), np.radians(75.0), 36)])
    polar = 0.5 * (edges[1:] + edges[:-1])
    area = np.cos(edges[:-1]) - np.cos(edges[1:])
    turn = (np.arange(16) + 0.5) * 2 * np.pi / 16
    tv, sv, th, ph = (a.ravel() for a in np.meshgrid(view_angle, spin, polar, turn, indexing="ij"))
    solid = np.broadcast_to(area[np.newaxis, np.newaxis, :, np.newaxis], (5, 3, 36, 16)).ravel()
    view = np.stack([np.sin(tv) * np.cos(sv), np.sin(tv) * np.sin(sv), np.cos(tv)], axis=1)
    half = np.stack([np.sin(th) * np.cos(ph), np.sin(th) * np.sin(ph), np.cos(th)], axis=1)
    along = np.sum(view * half, axis=1)
    light = 2 * along[:, np.newaxis] * half - view
    # Rings of the hemisphere of views count by their area.
    weight = 4 * along * solid * np.sin(tv) * light[:, 2] ** 2
    keep = (along > 0) & (light[:, 2] >= np.cos(_WIDEST_ANGLE))
    return view[keep], light[keep], half[keep], weight[keep]


@lru_cache(maxsize=1)
def _moments() -> _Moments:
    view, light, half, weight = _directions()
    vh = np.sum(view * half, axis=1)
    facets = np.stack([ggx(alpha, light[:, 2], view[:, 2], half[:, 2]) for alpha in _ALPHAS])
    rise = (1 - vh) ** 5
    g, s = facets * (1 - rise), facets * rise
    lobes = np.empty((len(_LN_K), len(_LN_R), len(_LN_C), len(view)))
    xx, yy, zz = (view * light).T
    for i, ln_r in enumerate(_LN_R):
        for j, ln_c in enumerate(_LN_C):
            base = zz - np.exp(-ln_r) * (xx + np.exp(ln_c) * yy)
            logarithm = np.log(np.maximum(base, 1e-30))
            exponent = np.exp(_LN_K)[:, np.newaxis] * logarithm
            lobes[:, i, j] = np.exp(np.minimum(exponent, _LARGEST_LOG)) * (base > 0)
    flat = lobes.reshape(-1, len(view))
    weighted = flat * weight
    return _Moments(
        ll=np.einsum("nm,nm->n", weighted, flat),
        l1=weighted.sum(axis=1),
        lg=weighted @ g.T,
        ls=weighted @ s.T,
        gg=np.einsum("am,am,m->a", g, g, weight),
        gs=np.einsum("am,am,m->a", g, s, weight),
        ss=np.einsum("am,am,m->a", s, s, weight),
        one=float(weight.sum()),
    )
