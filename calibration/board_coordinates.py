"""Projector coordinates of a board's corners, from the dense correspondence map around them.

At a corner the fringes cannot be read: half of what surrounds it is black, and the phase of one
pixel is noise. So a polynomial of second order, wider than noise and harmonics and narrower than a
warped board's blisters, is fitted to the thousands of decoded pixels around each corner, weighted
by their variance, and evaluated at the corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from acquisition.patterns import Axis
from acquisition.robust_spread import robust_sigma
from calibration.errors import CalibrationError

_TUKEY = 5.0
_ROUNDS = 4
# Blocks across a window: residuals that agree within a block do not average out.
_BLOCKS = 4
_LEAST_SHARE = 0.35


@dataclass(frozen=True)
class CornerCoordinates:
    """Projector coordinates of corners.

    Attributes
    ----------
    pixels : (rows, columns, 2) float64 array
        Projector column and row; NaN where too little was decoded around a corner.
    variance : (rows, columns, 2) float64 array
        Variances of the two in square projector pixels; columns and rows are decoded apart, so
        they are independent. Of the fit alone: an error of the corner's place in the picture
        comes on top.
    slope : (rows, columns) float64 array
        Projector pixels by which a coordinate moves with one camera pixel, root mean square.
    """

    pixels: NDArray[np.float64]
    variance: NDArray[np.float64]
    slope: NDArray[np.float64]

    def sigma_px(self, *, camera_sigma_px: float) -> NDArray[np.float64]:
        """Standard deviation of a corner's projector coordinates along either axis.

        Parameters
        ----------
        camera_sigma_px : float
            Of the corner's place in the picture: the coordinate is read off there.

        Returns
        -------
        (rows, columns) float64 array
            1 where there are no coordinates.
        """
        fit = np.mean(self.variance, axis=-1)
        sigma = np.sqrt(fit + (self.slope * camera_sigma_px) ** 2)
        return np.where(np.isfinite(sigma), sigma, 1.0)


def projector_coordinates(
    correspondence: CorrespondenceMap,
    corners: NDArray[np.float64],
    *,
    half_width_squares: float = 0.5,
    name: str = "the view",
) -> CornerCoordinates:
    """Projector coordinates of corners by local polynomials.

    Parameters
    ----------
    correspondence : CorrespondenceMap
        Decoded on both axes.
    corners : (rows, columns, 2) array
        Corners in the camera's full frame; NaN where not seen.
    half_width_squares : float
        Half the width of the window around a corner, in squares of the board.
    name : str
        What to call the view in an error.

    Raises
    ------
    CalibrationError
        Only one axis was decoded, or no corner has decoded pixels around it.
    """
    missing = [str(axis) for axis in Axis if axis not in correspondence.axes]
    if missing:
        raise CalibrationError(
            f"{name}: no {missing[0]} coordinates were decoded; a projector is calibrated from "
            "fringes along both axes"
        )
    here = corners - np.asarray(correspondence.origin, np.float64)
    reach = _reach(here) * half_width_squares
    pixels = np.full(corners.shape, np.nan)
    variance = np.full(corners.shape, np.nan)
    slope = np.full(corners.shape[:2], np.nan)
    for index in np.ndindex(corners.shape[:2]):
        if np.isfinite(here[index]).all():
            pixels[index], variance[index], slope[index] = _at(
                correspondence, here[index], max(reach, 4.0)
            )
    lost = ~np.isfinite(pixels).all(axis=-1)
    pixels[lost], variance[lost] = np.nan, np.nan
    if lost.all():
        raise CalibrationError(
            f"{name}: no corner has decoded pixels around it; check the exposure of the fringes"
        )
    return CornerCoordinates(pixels, variance, slope)


def _reach(corners: NDArray[np.float64]) -> float:
    gaps = [np.linalg.norm(np.diff(corners, axis=axis), axis=-1) for axis in (0, 1)]
    return float(np.nanmedian(np.concatenate([gap.ravel() for gap in gaps])))


def _at(
    correspondence: CorrespondenceMap, corner: NDArray[np.float64], reach: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Coordinates, variances and slope at one corner; NaN where too little was decoded."""
    nothing = np.full(2, np.nan), np.full(2, np.nan), float("nan")
    x, y = corner
    rows, cols = correspondence.shape
    window = (
        slice(max(0, int(y - reach)), max(0, min(rows, int(y + reach) + 1))),
        slice(max(0, int(x - reach)), max(0, min(cols, int(x + reach) + 1))),
    )
    good = correspondence.valid[window]
    if good.sum() < _LEAST_SHARE * (2 * reach) ** 2:
        return nothing
    row, col = np.nonzero(good)
    u = (col + window[1].start - x) / reach
    v = (row + window[0].start - y) / reach
    # The corner must lie within what was decoded, not beside it.
    if min((u < -0.2).sum(), (u > 0.2).sum(), (v < -0.2).sum(), (v > 0.2).sum()) < 10:
        return nothing
    design = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    across, down = (
        np.clip(np.floor((w + 1) * _BLOCKS / 2).astype(int), 0, _BLOCKS - 1) for w in (u, v)
    )
    block = across * _BLOCKS + down
    found = [
        _fit(
            design,
            correspondence.axes[axis].coordinate[window][good],
            np.asarray(correspondence.axes[axis].variance[window][good], np.float64),
            block,
        )
        for axis in (Axis.COLUMN, Axis.ROW)
    ]
    slopes = np.array([f[0][1:3] for f in found]) / reach
    return (
        np.array([f[0][0] for f in found]),
        np.array([f[1] for f in found]),
        float(np.sqrt(np.sum(slopes**2) / 2)),
    )


def _fit(
    design: NDArray[np.float64],
    observed: NDArray[np.float64],
    variance: NDArray[np.float64],
    block: NDArray[np.int_],
) -> tuple[NDArray[np.float64], float]:
    """Robust coefficients about the corner, and the variance of the value there."""
    weight = 1 / np.sqrt(variance)
    robust = weight
    for _ in range(_ROUNDS):
        weighted = design * robust[:, np.newaxis]
        normal = weighted.T @ weighted
        solution = np.linalg.lstsq(normal, weighted.T @ (observed * robust), rcond=None)[0]
        residual = (observed - design @ solution) * weight
        scale = robust_sigma(residual) + 1e-9
        robust = weight * np.clip(1 - (residual / (_TUKEY * scale)) ** 2, 0, None)
    # Means of blocks: with white noise their squares, weighted, are 1 on average.
    total = np.bincount(block, robust**2)
    mean = np.bincount(block, robust**2 * (observed - design @ solution)) / np.maximum(total, 1e-30)
    inflation = max(1.0, scale**2, float(np.mean((mean**2 * total)[total > 0])))
    return solution, float(np.linalg.pinv(normal)[0, 0] * inflation)
