"""Standard deviation of most samples, by the median of how far off they are.

Half of normal samples lie within Φ⁻¹(3/4) standard deviations of their middle, so the median
absolute deviation over that is consistent with the standard deviation (F. R. Hampel, 1974, J. Am.
Stat. Assoc. 69, p. 383). Up to half of the samples may be anything.
"""

from __future__ import annotations

from typing import TypeVar, overload

import numpy as np
from numpy.typing import NDArray

# 1/Φ⁻¹(3/4), rounded.
MEDIAN_TO_SIGMA = 1.4826

_Real = TypeVar("_Real", bound=np.floating)


@overload
def robust_sigma(residuals: NDArray[_Real], *, axis: None = None) -> float: ...
@overload
def robust_sigma(residuals: NDArray[_Real], *, axis: int) -> NDArray[_Real]: ...


def robust_sigma(residuals: NDArray[_Real], *, axis: int | None = None) -> float | NDArray[_Real]:
    """Standard deviation about zero, by the median of the absolute values.

    Parameters
    ----------
    residuals : (..., n, ...) array
        In any unit; NaN among them makes it NaN.
    axis : int, optional
        Along which the samples lie, of an array of two axes or more; by default all are samples of
        one.

    Returns
    -------
    float or array
        In the residuals' unit, and with an axis in their type and without that axis.
    """
    return _as_sigma(np.median(np.abs(residuals), axis=axis))


@overload
def nan_robust_sigma(residuals: NDArray[_Real], *, axis: None = None) -> float: ...
@overload
def nan_robust_sigma(residuals: NDArray[_Real], *, axis: int) -> NDArray[_Real]: ...


def nan_robust_sigma(
    residuals: NDArray[_Real], *, axis: int | None = None
) -> float | NDArray[_Real]:
    """As :func:`robust_sigma`, of the residuals that are not NaN."""
    return _as_sigma(np.nanmedian(np.abs(residuals), axis=axis))


def robust_spread(values: NDArray[np.floating]) -> float:
    """Standard deviation about the median, by the median absolute deviation.

    Parameters
    ----------
    values : array
        Samples of one distribution, in any unit; NaN among them makes it NaN.

    Returns
    -------
    float
        In the values' unit.
    """
    return robust_sigma(values - np.median(values))


def _as_sigma(median: NDArray[_Real] | np.floating) -> float | NDArray[_Real]:
    if isinstance(median, np.ndarray):
        return np.asarray(MEDIAN_TO_SIGMA * median)
    return MEDIAN_TO_SIGMA * float(median)
