"""The low-order shape of a canvas: what its stretcher bows and twists.

A warped stretcher is no plane. The heights keep what it deviates; this says how much that is: a
quadric fitted to the medians of blocks of the height field, robustly, so that strokes do not count
as shape. Relief is correlated over many texels and its scatter is far larger than the noise, so
the standard errors come from the residuals of whole tiles of the canvas, the sandwich estimator of
Huber's regression. A tile at a corner has pulled the fit towards itself, and what it leaves is too
small for that; the tiles' sums are scaled back by (1 - leverage)^-1/2 (CR2: Bell and McCaffrey,
Survey Methodology 28, 2002). Leaving out one tile after the other, the jackknife, scales by the
whole inverse, and errs by a fifth to a third on the safe side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import MEDIAN_TO_SIGMA
from fitting.height_field import HeightField

_BLOCKS = 32
_SAMPLES_A_SIDE = 8
_TILES = (5, 4)
_TERMS = 6
_ITERATIONS = 8
# Share of a tile's residual that a fit leaves at least.
_LEAST_FREEDOM = 1e-3


@dataclass(frozen=True)
class CanvasShape:
    """Quadric of a canvas; positive bows stand out towards the viewer in the middle.

    Attributes
    ----------
    bow_x_mm, bow_y_mm : float
        Height of the middle above the ends of the canvas's width and height.
    twist_mm : float
        Height by which the upper right and lower left corners stand above the middle and the
        other two below it.
    sigma_mm : (float, float, float)
        Standard errors of the three.
    """

    bow_x_mm: float
    bow_y_mm: float
    twist_mm: float
    sigma_mm: tuple[float, float, float]


def measure_shape(field: HeightField) -> CanvasShape | None:
    """Fit the low-order shape of a height field.

    Returns
    -------
    CanvasShape or None
        None where too little of the canvas was measured to tell.
    """
    x, y, height = _block_medians(field)
    terms = quadric_terms(x, y)
    tile = np.minimum(((x + 1) / 2 * _TILES[0]).astype(int), _TILES[0] - 1)
    tile = tile * _TILES[1] + np.minimum(((y + 1) / 2 * _TILES[1]).astype(int), _TILES[1] - 1)
    groups = np.unique(tile)
    if len(height) < 4 * _TERMS or len(groups) < _TERMS + 2:
        return None
    if np.linalg.matrix_rank(terms, tol=1e-3 * np.sqrt(len(terms))) < _TERMS:
        return None
    quadric, limit = _fit(terms, height)
    whole = shape_of(quadric)
    sigma = _standard_errors(terms, height - terms @ quadric, limit, tile)
    return CanvasShape(
        float(whole[0]),
        float(whole[1]),
        float(whole[2]),
        (float(sigma[0]), float(sigma[1]), float(sigma[2])),
    )


def _standard_errors(
    terms: NDArray[np.float64],
    left: NDArray[np.float64],
    limit: float,
    tile: NDArray[np.intp],
) -> NDArray[np.float64]:
    """Standard errors of bows and twist, from residuals that are independent by tile only."""
    pull = np.clip(left, -limit, limit)
    # Beyond the limit the pull does not grow, so those places determine nothing.
    free = np.abs(left) <= limit
    values, vectors = np.linalg.eigh(terms[free].T @ terms[free])
    factor = vectors / np.sqrt(np.maximum(values, 1e-6 * len(terms)))
    covariance = np.zeros((_TERMS, _TERMS))
    for one in np.unique(tile):
        inside = tile == one
        held = terms[inside & free] @ factor
        leverage, axes = np.linalg.eigh(held.T @ held)
        scale = 1 / np.sqrt(np.maximum(1 - leverage, _LEAST_FREEDOM))
        score = factor.T @ (terms[inside].T @ pull[inside])
        change = factor @ (axes * scale) @ axes.T @ score
        covariance += np.outer(change, change)
    # A change of sign changes no variance.
    return np.sqrt(np.abs(shape_of(np.diagonal(covariance))))


def quadric_terms(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 6) terms 1, x, y, x², xy, y² of places (n,) in half-sizes of the canvas."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def shape_of(quadric: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bow along X, bow along Y and twist (..., 3) of quadrics (..., 6)."""
    return np.stack([-quadric[..., 3], -quadric[..., 5], quadric[..., 4]], axis=-1)


def _block_medians(
    field: HeightField,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Places, in half-sizes from the middle, and median heights of blocks at least half measured.

    A block's median is taken of a regular choice of its texels.
    """
    rows, cols = field.shape
    side = max(1, -(-max(rows, cols) // _BLOCKS))
    inner = np.unique(np.linspace(0, side - 1, min(side, _SAMPLES_A_SIDE)).round().astype(int))
    down, across = rows // side, cols // side
    row = (np.arange(down)[:, np.newaxis] * side + inner)[:, np.newaxis, :, np.newaxis]
    col = (np.arange(across)[:, np.newaxis] * side + inner)[np.newaxis, :, np.newaxis, :]
    blocks = down, across, len(inner) ** 2
    heights = field.height[row, col].reshape(blocks).astype(np.float64)
    there = field.mask[row, col].reshape(blocks)
    count = there.sum(axis=2)
    ordered = np.sort(np.where(there, heights, np.inf), axis=2)
    middle = np.maximum(count - 1, 0) // 2
    median = np.take_along_axis(ordered, middle[..., np.newaxis], axis=2)[..., 0]
    kept = np.argwhere(2 * count > there.shape[2])
    centre = kept * side + 0.5 * (side - 1)
    x = (centre[:, 1] - 0.5 * (cols - 1)) / (0.5 * cols)
    y = (0.5 * (rows - 1) - centre[:, 0]) / (0.5 * rows)
    return x, y, median[kept[:, 0], kept[:, 1]]


def _fit(
    terms: NDArray[np.float64], height: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Least squares with Huber's weights, and the residual beyond which they limit its pull."""
    weight = np.ones(len(height))
    limit = 0.0
    for _ in range(_ITERATIONS):
        root = np.sqrt(weight)
        model = np.linalg.lstsq(terms * root[:, np.newaxis], height * root, rcond=None)[0]
        off = np.abs(height - terms @ model)
        limit = float(1.5 * MEDIAN_TO_SIGMA * np.median(off))
        if not limit > 0:
            break
        weight = np.minimum(1.0, limit / np.maximum(off, 1e-3 * limit))
    return np.asarray(model), limit
