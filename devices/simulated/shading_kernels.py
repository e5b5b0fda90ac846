r"""Compiled reflection of a small light by a painted surface.

A microfacet model, per unit of what a white Lambertian surface reflects (f = π f_r):

* base: :math:`(1-m)\,\rho\,(1-F(n\cdot l))(1-F(n\cdot v)) + \pi D_\alpha V_\alpha F(v\cdot h)`:
  what enters the paint leaves it through the same surface. Fresnel's reflection is Schlick's
  (1994), :math:`F(c) = F_0 + (1-F_0)(1-c)^5` with :math:`F_0 = 0.04` for paint and the metal's own
  colour where there is metal (share m);
* GGX: :math:`D_\alpha = \alpha^2 / (\pi ((n\cdot h)^2(\alpha^2-1)+1)^2)` (Walter et al., EGSR
  2007), :math:`V_\alpha` Smith's height-correlated masking and shadowing over
  :math:`4(n\cdot l)(n\cdot v)` (Heitz, JCGT 2014);
* varnish covers a share with a smooth coat: :math:`(1-F_c(n\cdot l))(1-F_c(n\cdot v))` of the base
  comes through, and its own :math:`\pi D V F_c` is added.

The light falls off with the square of the distance and with :math:`\cos^n` from its axis.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

PAINT_F0 = 0.04
# A resin varnish of refractive index 1.53, dried smooth.
VARNISH_F0 = 0.0439
VARNISH_ROUGHNESS = 0.09


@njit(inline="always")
def _schlick(f0: float, cosine: float) -> float:
    away = 1 - min(max(cosine, 0.0), 1.0)
    square = away * away
    return f0 + (1 - f0) * square * square * away


@njit(inline="always")
def _facets(roughness: float, nl: float, nv: float, nh: float) -> float:
    """π D V of GGX."""
    a2 = roughness * roughness
    peak = nh * nh * (a2 - 1) + 1
    masking = nl * math.sqrt(nv * nv * (1 - a2) + a2) + nv * math.sqrt(nl * nl * (1 - a2) + a2)
    return a2 / (peak * peak) * 0.5 / masking


@njit(cache=True)
def reflected(
    finish: NDArray[np.float32],
    weights: NDArray[np.float64],
    nl: float,
    nv: float,
    nh: float,
    vh: float,
) -> float:
    """Reflection factor, summed over red, green and blue with weights (3,).

    Parameters
    ----------
    finish : (6,) array
        Albedo of red, green and blue, roughness, varnish, metal.
    weights : (3,) array
    nl, nv, nh, vh : float
        Cosines between normal, light, viewing direction and the half vector; nl, nv > 0.
    """
    metal = finish[5]
    lobe = _facets(max(finish[3], 0.02), nl, nv, nh)
    enters = (1 - _schlick(PAINT_F0, nl)) * (1 - _schlick(PAINT_F0, nv)) * (1 - metal)
    base = 0.0
    for k in range(3):
        f0 = PAINT_F0 * (1 - metal) + finish[k] * metal
        fresnel = _schlick(f0, vh)
        base += weights[k] * (enters * finish[k] + lobe * fresnel)
    varnish = finish[4]
    if varnish <= 0:
        return base
    white = weights[0] + weights[1] + weights[2]
    through = (1 - _schlick(VARNISH_F0, nl)) * (1 - _schlick(VARNISH_F0, nv))
    coat = _facets(VARNISH_ROUGHNESS, nl, nv, nh) * _schlick(VARNISH_F0, vh)
    return (1 - varnish) * base + varnish * (through * base + white * coat)


@njit(parallel=True, cache=True)
def shade(
    points: NDArray[np.float64],
    normals: NDArray[np.float32],
    finish: NDArray[np.float32],
    hidden: NDArray[np.bool_],
    eye: NDArray[np.float64],
    light: NDArray[np.float64],
    axis: NDArray[np.float64],
    exponent: float,
    reference: float,
    weights: NDArray[np.float64],
    width: int,
) -> NDArray[np.float32]:
    """Radiance towards ``eye`` of points (n, 3) lit by a small light.

    1 is the radiance of white paper that faces the light on its axis at the distance
    ``reference``, if the weights sum to 1.

    Parameters
    ----------
    points, normals : (n, 3) array
    finish : (n, 6) array
    hidden : (n,) bool array
        Where something stands before the light.
    eye, light : (3,) array
        Places of camera and light.
    axis : (3,) array
        Unit vector along which the light shines most.
    exponent : float
        Of the cosine by which it falls off from its axis.
    reference : float
        Distance of unit irradiance.
    weights : (2, 2, 3) array
        What red, green and blue contribute to a pixel, by parity of row and column.
    width : int
        Pixels of a row.
    """
    radiance = np.zeros(len(points), np.float32)
    for n in prange(len(points)):
        if hidden[n]:
            continue
        lx = light[0] - points[n, 0]
        ly = light[1] - points[n, 1]
        lz = light[2] - points[n, 2]
        reach2 = lx * lx + ly * ly + lz * lz
        shrink = 1 / math.sqrt(reach2)
        lx, ly, lz = lx * shrink, ly * shrink, lz * shrink
        vx = eye[0] - points[n, 0]
        vy = eye[1] - points[n, 1]
        vz = eye[2] - points[n, 2]
        shrink = 1 / math.sqrt(vx * vx + vy * vy + vz * vz)
        vx, vy, vz = vx * shrink, vy * shrink, vz * shrink
        nl = normals[n, 0] * lx + normals[n, 1] * ly + normals[n, 2] * lz
        off_axis = -(axis[0] * lx + axis[1] * ly + axis[2] * lz)
        # A point that is seen faces the camera, if only by an interpolated normal's rounding.
        nv = max(normals[n, 0] * vx + normals[n, 1] * vy + normals[n, 2] * vz, 1e-4)
        if not (nl > 0 and off_axis > 0):
            continue
        hx, hy, hz = lx + vx, ly + vy, lz + vz
        shrink = 1 / math.sqrt(hx * hx + hy * hy + hz * hz)
        nh = (normals[n, 0] * hx + normals[n, 1] * hy + normals[n, 2] * hz) * shrink
        vh = (vx * hx + vy * hy + vz * hz) * shrink
        row = n // width
        pixel = weights[row & 1, (n - row * width) & 1]
        factor = reflected(finish[n], pixel, nl, nv, min(nh, 1.0), vh)
        fall_off = reference * reference / reach2 * off_axis**exponent
        radiance[n] = nl * fall_off * factor
    return radiance
