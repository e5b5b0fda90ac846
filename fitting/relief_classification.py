"""Relief classification (paper section 4.3): δ0, the mask of significant relief, and its boxes.

δ0 is given by hand, as in the paper, or proposed from the histogram of heights: the threshold that
parts ground and relief best in Otsu's sense (IEEE Trans. Syst. Man Cybern. 9, 1979), kept to the 20
to 40 % of H that the paper uses. Both are reported.

The paper thresholds the heights and drops small components against noise. On thin relief the
noise of single texels reaches the threshold itself, so here the heights are averaged, for the
classification only, until their predicted noise is small against δ0; on a relief well above its
noise nothing is averaged and the paper's rule is left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fitting.errors import FittingError
from fitting.height_field import HeightField
from fitting.option_limits import check_limits
from fitting.relief import Relief, ReliefBoxes

_BINS = 256
_LARGEST_CELL = 16384


@dataclass(frozen=True, kw_only=True)
class ReliefOptions:
    """How relief is classified.

    Attributes
    ----------
    delta0_mm : float or None
        δ0 by hand, above the canvas plane; None takes what the histogram proposes.
    share_of_height : (float, float)
        Shares of H between which a proposal is kept; the paper's are 0.2 and 0.4.
    cell : int
        Edge n of a cell in texels.
    smallest_mm2 : float
        Connected significant relief smaller than this is dropped.
    noise_share : float
        Share of δ0 that the noise of the classified heights may reach.

    Raises
    ------
    FittingError
        A threshold, a cell size or a limit that makes no sense.
    """

    delta0_mm: float | None = None
    share_of_height: tuple[float, float] = (0.2, 0.4)
    cell: int = 20
    smallest_mm2: float = 1.0
    noise_share: float = 0.2

    def __post_init__(self) -> None:
        if self.delta0_mm is not None and not math.isfinite(self.delta0_mm):
            raise FittingError(f"δ0 must be a finite height, not {self.delta0_mm} mm")
        check_limits(
            self, cell=(1, _LARGEST_CELL), smallest_mm2=(0, math.inf), noise_share=(0, math.inf)
        )
        least, greatest = self.share_of_height
        if not 0 <= least <= greatest <= 1:
            raise FittingError(
                f"share_of_height = {least}, {greatest}; shares of H rise from 0 to 1"
            )


def classify_relief(field: HeightField, options: ReliefOptions | None = None) -> Relief:
    """Split a height field into negligible and significant relief.

    Parameters
    ----------
    field : HeightField
        Heights above the canvas plane.
    options : ReliefOptions, optional
        Threshold, cell size and limits.

    Returns
    -------
    Relief
    """
    options = options or ReliefOptions()
    delta0, proposed, smoothed = _threshold(field, options)
    valid = field.mask & (smoothed > delta0)
    least = max(1, round(options.smallest_mm2 / field.pitch_mm**2))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(valid.astype(np.uint8), connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    significant = large[labels]
    boxes = _boxes(field, significant, options)
    return Relief(delta0, options.cell, significant, boxes, proposed)


def _threshold(
    field: HeightField, options: ReliefOptions
) -> tuple[float, float, NDArray[np.float32]]:
    """δ0, what is proposed for it, and heights averaged until their noise is small against it."""
    sigma = float(np.sqrt(np.median(field.variance[field.mask])))
    precise = field.mask & (field.variance <= 4 * sigma**2)
    # Errors that neighbours share average out more slowly.
    shared = 1.0 if field.correlation is None else max(float(field.correlation.sum()), 1.0)
    delta0, proposed, heights = 0.0, 0.0, field.height
    for blur in (0.0, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0):  # Gaussian width in texels
        if blur > max(options.cell / 2, 1.0):
            break
        noise = sigma
        if blur > 0:
            heights = _precision_blur(field, blur)
            # White noise of σ averaged by a Gaussian of width s keeps σ / (2 √π s).
            noise = sigma * min(1.0, np.sqrt(shared) / (2 * np.sqrt(np.pi) * blur))
        proposed = propose_threshold(heights[precise], options.share_of_height)
        delta0 = proposed if options.delta0_mm is None else options.delta0_mm
        if noise <= options.noise_share * abs(delta0):
            break
    return float(delta0), proposed, heights


def propose_threshold(
    heights: NDArray[np.floating], share_of_height: tuple[float, float] = (0.2, 0.4)
) -> float:
    """δ0 from the histogram of heights: Otsu's threshold, kept within shares of H.

    Parameters
    ----------
    heights : (n,) array
        Heights above the canvas plane, mm.
    share_of_height : (float, float)
        Least and greatest share of the greatest height H.

    Returns
    -------
    float
        0 where nothing rises above the plane.
    """
    highest = _highest(heights) if len(heights) else 0.0
    if not highest > 0:
        return 0.0
    count, edges = np.histogram(
        heights, bins=_BINS, range=(float(np.quantile(heights, 0.001)), highest)
    )
    below = np.cumsum(count)[:-1]
    moment = np.cumsum(count * 0.5 * (edges[1:] + edges[:-1]))
    total, whole = below[-1] + count[-1], moment[-1]
    with np.errstate(invalid="ignore", divide="ignore"):
        between = (whole * below / total - moment[:-1]) ** 2 / (below * (total - below))
    otsu = edges[1 + int(np.argmax(np.nan_to_num(between)))]
    return float(np.clip(otsu, share_of_height[0] * highest, share_of_height[1] * highest))


def _highest(measured: NDArray[np.float32]) -> float:
    """H without the few texels that noise or a highlight lifts above everything else."""
    return float(np.quantile(measured, 0.9995) if measured.size > 2000 else measured.max())


def _precision_blur(field: HeightField, sigma: float) -> NDArray[np.float32]:
    """Heights averaged by a Gaussian of ``sigma`` texels, weighted by their precision."""
    typical = max(float(np.median(field.variance[field.mask])), 1e-12)
    weight = np.where(field.mask, typical / np.maximum(field.variance, 1e-3 * typical), 0.0)
    weight = weight.astype(np.float32)
    total = cv2.GaussianBlur(field.height * weight, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    norm = cv2.GaussianBlur(weight, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(total / np.maximum(norm, 1e-9), dtype=np.float32)


def _boxes(
    field: HeightField, significant: NDArray[np.bool_], options: ReliefOptions
) -> ReliefBoxes:
    n = options.cell
    rows, cols = field.shape
    cells_down, cells_across = -(-rows // n), -(-cols // n)
    padded = np.zeros((cells_down * n, cells_across * n), np.bool_)
    padded[:rows, :cols] = significant
    heights = np.full(padded.shape, -np.inf, np.float32)
    heights[:rows, :cols] = np.where(field.mask, field.height, -np.inf)

    def by_cell(array: NDArray[np.generic]) -> NDArray[np.generic]:
        cells = array.reshape(cells_down, n, cells_across, n).swapaxes(1, 2)
        return cells.reshape(cells_down, cells_across, n * n)

    kept = np.argwhere(by_cell(padded).any(axis=2))
    inside = by_cell(heights)[kept[:, 0], kept[:, 1]].astype(np.float32)
    top = inside.argmax(axis=1) if len(kept) else np.zeros(0, np.int64)
    corner = kept * n
    return ReliefBoxes(
        corner.astype(np.int32),
        np.minimum(n, np.array([rows, cols]) - corner).astype(np.int32),
        inside[np.arange(len(kept)), top],
        (corner + np.stack([top // n, top % n], axis=1)).astype(np.int32),
    )
