"""Compiled re-rendering of photographs: lobes of four texels under one lamp, for every pixel."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


@njit(parallel=True, cache=True)
def relight(
    normal_xy: NDArray[np.float32],
    diffuse: NDArray[np.float32],
    specular: NDArray[np.float32],
    lobe: NDArray[np.float32],
    places: NDArray[np.float64],
    view: NDArray[np.float64],
    light: NDArray[np.float64],
    irradiance: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Radiance (n, 3) of surface points: f cos θ of the four texels around each, interpolated.

    Parameters
    ----------
    normal_xy, diffuse, specular, lobe : (rows, cols, ...) arrays
        Maps of a copy.
    places : (n, 2) array
        Column and row among the texels, inside the outermost centres.
    view, light : (n, 3) arrays
        Unit vectors in the canvas frame.
    irradiance : (n, 3) array
        On a surface that faces the light; zero in shadow.
    """
    rows, cols = normal_xy.shape[:2]
    radiance = np.zeros((len(places), 3), np.float32)
    for n in prange(len(places)):
        if not (irradiance[n, 0] > 0.0 or irradiance[n, 1] > 0.0 or irradiance[n, 2] > 0.0):
            continue
        col = min(max(int(places[n, 0]), 0), cols - 2)
        row = min(max(int(places[n, 1]), 0), rows - 2)
        u = places[n, 0] - col
        v = places[n, 1] - row
        vx, vy, vz = view[n]
        lx, ly, lz = light[n]
        for i in range(2):
            for j in range(2):
                share = (v if i else 1.0 - v) * (u if j else 1.0 - u)
                nx = float(normal_xy[row + i, col + j, 0])
                ny = float(normal_xy[row + i, col + j, 1])
                nz = math.sqrt(max(1.0 - nx * nx - ny * ny, 1e-6))
                cosine = nx * lx + ny * ly + nz * lz
                front = nx * vx + ny * vy + nz * vz
                if cosine <= 0.0 or share == 0.0:
                    continue
                # The texel's x: the canvas's X laid into the tangent plane; y completes it.
                shrink = 1.0 / math.sqrt(max(1.0 - nx * nx, 1e-12))
                tx, ty, tz = (1.0 - nx * nx) * shrink, -nx * ny * shrink, -nx * nz * shrink
                bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
                base = (
                    lobe[row + i, col + j, 0]
                    * (tx * vx + ty * vy + tz * vz)
                    * (tx * lx + ty * ly + tz * lz)
                    + lobe[row + i, col + j, 1]
                    * (bx * vx + by * vy + bz * vz)
                    * (bx * lx + by * ly + bz * lz)
                    + lobe[row + i, col + j, 2] * front * cosine
                )
                height = base ** lobe[row + i, col + j, 3] if base > 0.0 else 0.0
                for c in range(3):
                    f = diffuse[row + i, col + j, c] + specular[row + i, col + j, c] * height
                    radiance[n, c] += share * f * cosine * irradiance[n, c]
    return radiance
