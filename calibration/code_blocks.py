"""A decoded picture in small blocks: where each lies on the projector's panel, and how it runs.

In a block of a few pixels the projector's coordinates are nearly a quadratic of the pixel. Its fit
(pixels are exact, coordinates carry the noise) averages the noise of the block, leaves out wrongly
decoded pixels, and tells where in the block a coordinate is. An affine fit would err alike on the
tops of all strokes, which moves a pose. Blocks do not overlap, so that their errors are independent
where those of the pixels are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from acquisition.patterns import Axis
from calibration.errors import CalibrationError

_LEAST_SHARE = 0.7
_ROUNDS = 3
# Of an even ramp the farthest sample is twice the median deviation from the middle.
_FAR_FROM_MEDIAN = 6.0
_FAR_FROM_FIT = 4.5
# Mean squares of residuals of a block that a quadratic describes scatter about 1 by no more.
_SMOOTH = 1.6
_ROUGH = 25.0
_LEAST_SIZE = 4
_TERMS = 6
_NEWTON_ROUNDS = 8


@dataclass(frozen=True)
class CodeBlocks:
    """Blocks of a picture that see one piece of surface each.

    Attributes
    ----------
    pixels : (n, 2) float64 array
        Column and row of each block's centre in the camera's full frame.
    quadratics : (n, 6, 2) float64 array
        Projector column and row by 1, x, y, x², xy, y² of the pixel, from the block's centre.
    cofactors : (n, 6, 6) float64 array
        Covariance of the coefficients for noise of unit variance.
    noise : (n, 2) float64 array
        Variance of the noise of one pixel's coordinates, square projector pixels.
    size_px : int
        Side of a block.
    """

    pixels: NDArray[np.float64]
    quadratics: NDArray[np.float64]
    cofactors: NDArray[np.float64]
    noise: NDArray[np.float64]
    size_px: int

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def coordinates(self) -> NDArray[np.float64]:
        """(n, 2) projector column and row at the blocks' centres."""
        return self.quadratics[:, 0]

    @property
    def variance(self) -> NDArray[np.float64]:
        """(n, 2) of :attr:`coordinates`, square projector pixels."""
        return self.noise * self.cofactors[:, :1, 0]

    def chosen(self, which: NDArray[np.generic]) -> CodeBlocks:
        """Some of the blocks, by index or mask; one may be there twice."""
        return CodeBlocks(
            self.pixels[which],
            self.quadratics[which],
            self.cofactors[which],
            self.noise[which],
            self.size_px,
        )

    def locate(
        self, coordinates: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Where in each block a coordinate is.

        Parameters
        ----------
        coordinates : (n, 2) array
            One for each block.

        Returns
        -------
        offset : (n, 2) float64 array
            Pixels from the block's centre; NaN where it is not in the block.
        slopes : (n, 2, 2) float64 array
            Derivative of the coordinates by the pixel there.
        variance : (n, 2) float64 array
            Of the block's coordinates there.
        """
        offset = np.zeros((len(self), 2))
        reach = self.size_px / 2
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_ROUNDS):
                value = np.einsum("nt,nta->na", terms_of(offset), self.quadratics)
                step = _solve2(self._slopes(offset), coordinates - value)
                offset = offset + np.clip(step, -reach, reach)
            # Newton's steps have ended.
            lost = ~(np.abs(step).max(axis=1) < 1e-6) | ~(np.abs(offset).max(axis=1) <= reach)
        offset[lost] = np.nan
        row = terms_of(offset)
        spread = np.einsum("nt,nts,ns->n", row, self.cofactors, row)
        return offset, self._slopes(offset), self.noise * spread[:, np.newaxis]

    def _slopes(self, offset: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y = offset[:, :1], offset[:, 1:]
        q = self.quadratics
        by_x = q[:, 1] + 2 * x * q[:, 3] + y * q[:, 4]
        by_y = q[:, 2] + x * q[:, 4] + 2 * y * q[:, 5]
        return np.stack([by_x, by_y], axis=2)


def terms_of(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 6) terms 1, x, y, x², xy, y² of offsets (..., 2)."""
    x, y = offset[..., 0], offset[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _solve2(matrix: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solutions (n, 2) of n systems of two equations; not finite where one has none."""
    (a, b), (c, d) = matrix[:, 0].T, matrix[:, 1].T
    determinant = a * d - b * c
    x = (d * right[:, 0] - b * right[:, 1]) / determinant
    y = (a * right[:, 1] - c * right[:, 0]) / determinant
    return np.stack([x, y], axis=1)


def find_blocks(correspondence: CorrespondenceMap, *, size_px: int | None = None) -> CodeBlocks:
    """Fit the projector's coordinates over blocks of a picture.

    Parameters
    ----------
    correspondence : CorrespondenceMap
        With columns and rows decoded.
    size_px : int, optional
        Side of a block; by default so that there are some ten thousand, between 4 and 8.

    Returns
    -------
    CodeBlocks

    Raises
    ------
    CalibrationError
        One axis only was decoded, or the blocks are too small.
    """
    if set(correspondence.axes) != set(Axis):
        raise CalibrationError(
            "pictures are paired by the projector's columns and rows, and only one of them was "
            "decoded; project a code along both axes"
        )
    if size_px is None:
        size_px = int(np.clip(round(np.sqrt(correspondence.valid.sum() / 10_000)), _LEAST_SIZE, 8))
    if size_px < _LEAST_SIZE:
        raise CalibrationError(f"blocks of {size_px} pixels: the least is {_LEAST_SIZE}")
    axes = [correspondence.axes[axis] for axis in (Axis.COLUMN, Axis.ROW)]
    samples = _blocked(np.stack([axis.coordinate for axis in axes], axis=-1), size_px)
    noise = _blocked(np.stack([axis.variance for axis in axes], axis=-1), size_px)
    valid = _blocked(correspondence.valid[..., np.newaxis], size_px)[..., 0].astype(bool)
    pixels = _blocked(correspondence.pixels(), size_px)
    valid &= np.isfinite(samples).all(-1) & np.isfinite(noise).all(-1) & (noise > 0).all(-1)
    full = valid.mean(axis=1) >= _LEAST_SHARE
    return _fit(pixels[full], samples[full], noise[full], valid[full], size_px)


def _blocked(picture: NDArray[np.generic], size: int) -> NDArray[np.float64]:
    """(blocks, size², channels) of a picture (rows, cols, channels)."""
    rows, cols = (length // size for length in picture.shape[:2])
    cut = picture[: rows * size, : cols * size]
    split = cut.reshape(rows, size, cols, size, -1).swapaxes(1, 2)
    return np.asarray(split.reshape(rows * cols, size * size, -1), np.float64)


def _fit(
    pixels: NDArray[np.float64],
    samples: NDArray[np.float64],
    noise: NDArray[np.float64],
    valid: NDArray[np.bool_],
    size: int,
) -> CodeBlocks:
    """Affine fits, one per block, without what lies far from the rest of its block."""
    keep = valid & _near_median(samples, valid, np.sqrt(noise))
    middle = pixels.mean(axis=1)
    for _ in range(_ROUNDS):
        enough = keep.sum(axis=1) >= _LEAST_SHARE * size**2
        pixels, samples, noise, keep, middle = (
            a[enough] for a in (pixels, samples, noise, keep, middle)
        )
        terms = terms_of(pixels - middle[:, np.newaxis])
        used = terms * keep[..., np.newaxis]
        known = np.where(keep[..., np.newaxis], samples, 0)
        normal = np.swapaxes(used, 1, 2) @ terms
        # Any block keeps enough pixels for a quadratic, but they may lie badly.
        cofactors = np.linalg.inv(normal + 1e-12 * np.eye(_TERMS))
        quadratics = cofactors @ (np.swapaxes(used, 1, 2) @ known)
        risen = (known - terms @ quadratics) * keep[..., np.newaxis] / np.sqrt(noise)
        scatter = np.sum(risen**2, axis=1) / (keep.sum(axis=1)[:, np.newaxis] - _TERMS)
        far = np.abs(risen) > _FAR_FROM_FIT * np.sqrt(np.maximum(scatter, 1))[:, np.newaxis]
        if not far.any():
            break
        keep = keep & ~far.any(axis=-1)
    kept = keep[..., np.newaxis]
    usual = np.sum(np.where(kept, noise, 0), axis=1) / np.maximum(kept.sum(axis=1), 1)
    usual = usual * np.where(scatter > _SMOOTH, scatter, 1.0)
    slopes = quadratics[:, 1:3]
    rough = scatter.max(axis=1) if len(scatter) else np.empty(0)
    # A few blocks far rougher than the rest hold more than one piece of surface, or wrong orders.
    regular = rough <= _ROUGH * max(1.0, float(np.median(rough)) if len(rough) else 1.0)
    regular &= np.abs(np.linalg.det(slopes)) > 1e-3
    return CodeBlocks(middle, quadratics, cofactors, usual, size).chosen(regular)


def _near_median(
    samples: NDArray[np.float64], valid: NDArray[np.bool_], sigma: NDArray[np.float64]
) -> NDArray[np.bool_]:
    known = np.where(valid[..., np.newaxis], samples, np.nan)
    distance = np.abs(known - np.nanmedian(known, axis=1, keepdims=True))
    usual = np.nanmedian(distance, axis=1, keepdims=True)
    limit = _FAR_FROM_MEDIAN * np.maximum(usual, sigma)
    return np.asarray((distance <= limit).all(axis=-1))
