"""Compiled fit of each texel's normal to its radiance samples, under its own lobe.

Unknown are the tilt (p, q), by which the normal becomes (p, q, 1) in the texel's frame, and how
much more or less there is of diffuse and of specular light. Levenberg-Marquardt on Huber's loss of
the standardised residuals, with a normal prior on the tilt.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

UNKNOWNS = 4
_STEP = 1e-3
_ROUNDS = 12
_STEEPEST = 1.0  # a tilt of 45°
_HARDLY = 1e-10


@njit(inline="always")
def _turned(p, q, v, l_, lobe):  # type: ignore[no-untyped-def]
    """Cosine of light, and height of the lobe, in the frame of the tilted normal."""
    shrink = 1.0 / math.sqrt(p * p + q * q + 1.0)
    zx, zy, zz = p * shrink, q * shrink, shrink
    across = 1.0 / math.sqrt(max(1.0 - zx * zx, 1e-12))
    xx, xy, xz = (1.0 - zx * zx) * across, -zx * zy * across, -zx * zz * across
    yx, yy, yz = zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx
    cosine = zx * l_[0] + zy * l_[1] + zz * l_[2]
    base = lobe[0] * (xx * v[0] + xy * v[1] + xz * v[2]) * (xx * l_[0] + xy * l_[1] + xz * l_[2])
    base += lobe[1] * (yx * v[0] + yy * v[1] + yz * v[2]) * (yx * l_[0] + yy * l_[1] + yz * l_[2])
    base += lobe[2] * (zx * v[0] + zy * v[1] + zz * v[2]) * cosine
    height = base ** lobe[3] if base > 0.0 else 0.0
    return max(cosine, 0.0), height


@njit(cache=True)
def _sums(view, light, radiance, noise, weight, lobe, diffuse, specular, x, prior, limit, square):  # type: ignore[no-untyped-def]
    """Cost at ``x``, and the sums of the normal equations: gradient, and Hessian in ``square``."""
    gradient = np.zeros(UNKNOWNS)
    square[:] = 0.0
    cost = 0.0
    for k in range(UNKNOWNS):
        cost += prior[k] * x[k] * x[k]
        gradient[k] += prior[k] * x[k]
        square[k, k] += prior[k]
    slope = np.zeros(UNKNOWNS)
    for i in range(len(weight)):
        if not weight[i] > 0.0:
            continue
        cosine, height = _turned(x[0], x[1], view[i], light[i], lobe)
        cosine_p, height_p = _turned(x[0] + _STEP, x[1], view[i], light[i], lobe)
        cosine_q, height_q = _turned(x[0], x[1] + _STEP, view[i], light[i], lobe)
        for c in range(3):
            matt = diffuse[c] * (1.0 + x[2])
            shine = specular[c] * (1.0 + x[3])
            model = (matt + shine * height) * cosine
            scale = 1.0 / math.sqrt(noise[i, c])
            slope[0] = ((matt + shine * height_p) * cosine_p - model) / _STEP * scale
            slope[1] = ((matt + shine * height_q) * cosine_q - model) / _STEP * scale
            slope[2] = diffuse[c] * cosine * scale
            slope[3] = specular[c] * height * cosine * scale
            off = (model - radiance[i, c]) * scale
            far = abs(off)
            trust = weight[i]
            if far > limit:
                cost += trust * limit * (2.0 * far - limit)
                trust *= limit / far
            else:
                cost += trust * off * off
            for a in range(UNKNOWNS):
                gradient[a] += trust * slope[a] * off
                for b in range(a + 1):
                    square[a, b] += trust * slope[a] * slope[b]
    for a in range(UNKNOWNS):
        for b in range(a):
            square[b, a] = square[a, b]
    return cost, gradient


@njit(parallel=True, cache=True)
def fit_tilts(
    view: NDArray[np.float32],
    light: NDArray[np.float32],
    radiance: NDArray[np.float32],
    variance: NDArray[np.float32],
    weight: NDArray[np.float32],
    misfit: NDArray[np.float64],
    lobe: NDArray[np.float64],
    diffuse: NDArray[np.float64],
    specular: NDArray[np.float64],
    spread: NDArray[np.float64],
    limit: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Tilts (n, 2) of the texels' normals and their standard errors (n, 2).

    Where a lobe is beyond all numbers at its samples, lamps being far from where they are said to
    be, the tilt is zero and its error that of the prior.

    Parameters
    ----------
    view, light, radiance, variance, weight : arrays
        As of :class:`~fitting.reflectance.samples.RadianceSamples`; weights are zero for whatever
        is not valid.
    misfit : (n, 2) array
        What the model is off by: floor and share, as of
        :class:`~fitting.reflectance.materials.Material`.
    lobe : (n, 4) array
        C_x, C_y, C_z, k.
    diffuse, specular : (n, 3) arrays
    spread : (n,) array
        Standard deviation of the tilt before anything is known.
    limit : float
        Huber's.
    """
    n = len(weight)
    tilt = np.zeros((n, 2))
    error = np.empty((n, 2))
    for t in prange(n):
        prior = np.array([1.0, 1.0, 1.0, 1.0])
        prior[:2] = 1.0 / (spread[t] * spread[t])
        noise = np.empty((weight.shape[1], 3))
        for i in range(weight.shape[1]):
            for c in range(3):
                own = misfit[t, 1] * radiance[t, i, c]
                noise[i, c] = variance[t, i, c] + misfit[t, 0] * misfit[t, 0] + own * own
        x = np.zeros(UNKNOWNS)
        square = np.zeros((UNKNOWNS, UNKNOWNS))
        other = np.zeros((UNKNOWNS, UNKNOWNS))
        data = (view[t], light[t], radiance[t], noise, weight[t], lobe[t], diffuse[t], specular[t])
        cost, gradient = _sums(*data, x, prior, limit, square)
        damping = 1e-3
        sound = math.isfinite(cost + np.sum(square) + np.sum(gradient))
        for _ in range(_ROUNDS if sound else 0):
            damped = square.copy()
            for k in range(UNKNOWNS):
                damped[k, k] *= 1.0 + damping + _HARDLY
            step = np.linalg.solve(damped, gradient)
            trial = x - step
            steep = max(abs(trial[0]), abs(trial[1])) > _STEEPEST
            new_cost = math.inf
            new_gradient = gradient
            if not steep:
                new_cost, new_gradient = _sums(*data, trial, prior, limit, other)
                if not math.isfinite(np.sum(other) + np.sum(new_gradient)):
                    new_cost = math.inf
            if new_cost <= cost:
                done = cost - new_cost < 1e-4 * (1.0 + cost)
                x = trial
                cost = new_cost
                gradient = new_gradient
                square[:] = other
                damping *= 0.2
                if done:
                    break
            else:
                damping *= 10.0
        error[t] = spread[t]
        if not sound:
            continue
        for k in range(UNKNOWNS):
            # Two unknowns that the samples cannot tell apart must not make it singular.
            square[k, k] *= 1.0 + _HARDLY
        covariance = np.linalg.inv(square)
        for k in range(2):
            tilt[t, k] = x[k]
            error[t, k] = math.sqrt(max(covariance[k, k], 0.0))
    return tilt, error
