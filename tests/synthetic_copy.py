"""Made-up digital copies for the tests."""

from __future__ import annotations

import numpy as np

from fitting.digital_copy import DigitalCopy
from fitting.height_field import HeightField
from fitting.neighbour_kernels import triangle_normals
from fitting.relief_classification import ReliefOptions, classify_relief


def make_copy(
    height: np.ndarray,
    *,
    pitch: float = 0.5,
    mask: np.ndarray | None = None,
    cell: int = 10,
    **relief: float,
) -> DigitalCopy:
    height = np.asarray(height, np.float32)
    rows, cols = height.shape
    mask = np.ones(height.shape, bool) if mask is None else mask
    variance = np.where(mask, np.float32(1e-6), np.float32(0))
    origin = (-(cols - 1) / 2 * pitch, (rows - 1) / 2 * pitch)
    field = HeightField(
        np.where(mask, height, np.float32(0)),
        mask,
        variance,
        pitch,
        origin,
        np.array([0, 3.1, 0, 1.0, 2, 500]),
    )
    normal, sigma = triangle_normals(field.height, mask, variance, pitch)
    options = ReliefOptions(cell=cell, **relief)
    return DigitalCopy(
        field, normal, classify_relief(field, options), np.where(np.isfinite(sigma), sigma, 0)
    )


def strokes(rows: int = 120, cols: int = 160, pitch: float = 0.5) -> np.ndarray:
    x, y = np.meshgrid((np.arange(cols) - cols / 2) * pitch, (rows / 2 - np.arange(rows)) * pitch)
    ridge = 2.5 * np.exp(-(((x + y - 12) / 2.5) ** 2)) * (np.abs(x - y) < 20)
    dome = 3.0 * np.exp(-((x + 18) ** 2 + (y - 9) ** 2) / 20)
    return ridge + dome + 0.05 * np.sin(x) * np.sin(y)
