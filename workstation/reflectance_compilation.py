"""Compile the kernels that reflectance needs, on a canvas of a few texels."""

from __future__ import annotations

import math

import numpy as np

from calibration.lamp import Lamp
from calibration.lens import Lens, rt_from_matrix
from fitting.digital_copy import DigitalCopy
from fitting.height_field import HeightField
from fitting.reflectance.back_projection import PhotographSampler
from fitting.reflectance.clusters import ClusterOptions
from fitting.reflectance.held_out import compare_held_out
from fitting.reflectance.maps import MapOptions, fit_maps
from fitting.reflectance.photographs import Photograph
from fitting.reflectance.terrain import Terrain
from fitting.relief import Relief, ReliefBoxes

_SIDE = 12
_AWAY_MM = 100.0


def compile_reflectance() -> None:
    """Fit and check the reflectance of a small flat board under eight lamps."""
    copy = _board()
    photographs = [_photograph(number) for number in range(8)]
    terrain = Terrain.of(copy.height_field)
    sampler = PhotographSampler(copy, photographs, terrain)
    options = MapOptions(clusters=ClusterOptions(most=2, survey=100, per_material=30, fewest=20))
    fitted = fit_maps(sampler, options=options)
    compare_held_out(fitted.added_to(copy), terrain, photographs[:1])


def _board() -> DigitalCopy:
    shape = (_SIDE, _SIDE)
    zeros = np.zeros(shape, np.float32)
    ones = np.ones(shape, np.bool_)
    half = (_SIDE - 1) / 2
    field = HeightField(zeros, ones, zeros + np.float32(1e-4), 1.0, (-half, half), np.zeros(6))
    none = np.zeros((0, 2), np.int32)
    relief = Relief(0.0, 4, ~ones, ReliefBoxes(none, none, np.zeros(0, np.float32), none))
    normals = np.zeros((*shape, 2), np.float32)
    return DigitalCopy(field, normals, relief, zeros + np.float32(0.02))


def _photograph(number: int) -> Photograph:
    side = 3 * _SIDE
    random = np.random.default_rng(number)
    elevation, azimuth = math.radians(35 + 6 * number), 2.4 * number
    towards = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    # Brighter the closer the lamp is to where a mirror would show it.
    level = 0.2 * towards[2] + 2.0 * towards[2] ** 40
    image = level * (1 + 0.01 * random.standard_normal((side, side, 3)))
    focal = _AWAY_MM * 2.0
    middle = (side - 1) / 2
    return Photograph(
        name=f"board under lamp {number}",
        radiance=image.astype(np.float32),
        variance=np.full(image.shape, 1e-5, np.float32),
        lens=Lens("LENSMODEL_PINHOLE", np.array([focal, focal, middle, middle]), side, side),
        rt_cam_canvas=rt_from_matrix(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, _AWAY_MM])),
        lamp=Lamp(_AWAY_MM * towards, -towards, np.full(3, math.pi * _AWAY_MM**2), 0.0),
    )
