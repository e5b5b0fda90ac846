"""What exposures truly were, from the overlap of the pictures taken at them.

Cameras round exposure times, and some lie (a nominal 0.1 ms was really 0.087 ms in a published
set). Two pictures of one scene are proportional above black, wherever both are exposed well: the
ratio is the slope of a line through the means of small blocks. Both coordinates carry noise, which
is known, so the line is that of York (D. York et al., *Unified equations for the slope, intercept,
and standard errors of the best straight line*, American Journal of Physics 72, 2004); an ordinary
fit would be too flat.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import DecodingError
from acquisition.frame_files import Samples
from acquisition.sample_noise import SampleNoise

# Edge of a block, in samples of one colour of a mosaic: every second one both ways.
_BLOCK = 8
# Blocks that a line needs.
_LEAST_BLOCKS = 30
# Share of the range up to the ceiling that samples may reach: sensors bend just below it.
_HEADROOM = 0.95
_ITERATIONS = 30
# Standard errors by which the scatter of blocks exceeds what noise alone would give, for a ratio.
_SIGNIFICANT = 6.0


@dataclass(frozen=True)
class ExposureEstimate:
    """Exposure times relative to the longest, which is taken as true.

    Attributes
    ----------
    exposures_s : (n,) float64 array
        In the order given.
    relative_error : (n,) float64 array
        Standard error over value; 0 for the longest.
    black_level : float
        Sensor number at which the lines say that there is no light, by least variance over the
        pairs.
    black_level_error : float
        Its standard error.
    """

    exposures_s: NDArray[np.float64]
    relative_error: NDArray[np.float64]
    black_level: float
    black_level_error: float


@dataclass(frozen=True)
class FittedLine:
    """A line ``y = slope x + offset``.

    Attributes
    ----------
    slope, offset : float
    slope_error, offset_error : float
        Standard errors, scaled by the scatter about the line where that is larger than predicted.
    """

    slope: float
    offset: float
    slope_error: float
    offset_error: float


def estimate_exposures(
    frames: list[Samples],
    nominal_s: list[float] | NDArray[np.float64],
    *,
    noise: SampleNoise,
    black_level: float,
    saturation_level: int,
) -> ExposureEstimate:
    """Estimate the exposures of a bracket from its own pictures.

    Parameters
    ----------
    frames : list of (rows, cols) uint8 or uint16 array
        The same scene at every exposure.
    nominal_s : list of float
        What the camera says; the longest is taken as true.
    noise : SampleNoise
        Variance of a sample by its level above black, squared sensor numbers.
    black_level : float
        Sensor number without light, as far as it is known.
    saturation_level : int
        Sensor number at and above which a sample is saturated.

    Returns
    -------
    ExposureEstimate

    Raises
    ------
    DecodingError
        Exposures that are not positive or occur twice, or two neighbouring ones that have too
        little in common that is neither dark nor saturated, or is all of one grey.
    """
    nominal = np.asarray(nominal_s, np.float64)
    if not frames or len(frames) != len(nominal):
        raise DecodingError(f"{len(frames)} frames at {len(nominal)} exposures tell no ratio")
    if not (np.isfinite(nominal) & (nominal > 0)).all() or len(set(nominal)) < len(nominal):
        raise DecodingError(f"a bracket has distinct positive exposures, not {nominal.tolist()}")
    order = np.argsort(nominal)[::-1]
    exposures, relative = nominal.copy(), np.zeros(len(nominal))
    blacks, weights = [], []
    for longer, shorter in pairwise(order):
        blocks = _blocks_in_common(frames[shorter], frames[longer], black_level, saturation_level)
        if len(blocks[0]) < _LEAST_BLOCKS:
            raise DecodingError(
                f"exposures of {nominal[longer]:g} s and {nominal[shorter]:g} s have too little in "
                "common that is neither dark nor saturated; take one in between"
            )
        variances = [noise.variance(block - black_level) / _BLOCK**2 for block in blocks]
        if not all(map(_is_more_than_noise, blocks, variances)):
            raise DecodingError(
                f"exposures of {nominal[longer]:g} s and {nominal[shorter]:g} s have one grey in "
                "common, which tells no ratio; take pictures of something with light and shade"
            )
        line = fit_york_line(*blocks, *variances)
        exposures[shorter] = exposures[longer] / line.slope
        relative[shorter] = np.hypot(relative[longer], line.slope_error / line.slope)
        # Without light both exposures read black: the line meets the diagonal there.
        blacks.append(line.offset / (1 - line.slope))
        weights.append(((1 - line.slope) / line.offset_error) ** 2)
    if not blacks:
        return ExposureEstimate(exposures, relative, black_level, float("inf"))
    return ExposureEstimate(
        exposures,
        relative,
        float(np.average(blacks, weights=weights)),
        float(1 / np.sqrt(np.sum(weights))),
    )


def fit_york_line(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    x_variance: NDArray[np.float64],
    y_variance: NDArray[np.float64],
) -> FittedLine:
    """Best line through points (n,) with independent errors in both coordinates (York 2004).

    Raises
    ------
    DecodingError
        The points do not determine a line.
    """
    slope = float(np.std(y) / np.std(x)) if np.std(x) > 0 else float("nan")
    for _ in range(_ITERATIONS):
        weight = 1 / (y_variance + slope**2 * x_variance)
        x_mean, y_mean = np.average(x, weights=weight), np.average(y, weights=weight)
        u, v = x - x_mean, y - y_mean
        beta = weight * (u * y_variance + slope * v * x_variance)
        before, slope = slope, float((weight * beta * v).sum() / (weight * beta * u).sum())
        if abs(slope - before) <= 1e-12 * abs(slope):
            break
    if not (np.isfinite(slope) and slope > 0):
        raise DecodingError("two exposures of a bracket are not proportional to one another")
    weight = 1 / (y_variance + slope**2 * x_variance)
    offset = float(np.average(y, weights=weight) - slope * np.average(x, weights=weight))
    fitted = np.average(x, weights=weight) + beta
    centre = np.average(fitted, weights=weight)
    slope_variance = 1 / (weight * (fitted - centre) ** 2).sum()
    offset_variance = 1 / weight.sum() + centre**2 * slope_variance
    scatter = (weight * (y - slope * x - offset) ** 2).sum() / max(1, len(x) - 2)
    scale = np.sqrt(max(1.0, float(scatter)))
    return FittedLine(
        slope,
        offset,
        float(scale * np.sqrt(slope_variance)),
        float(scale * np.sqrt(offset_variance)),
    )


def measure_saturation_level(frames: list[Samples]) -> int | None:
    """Sensor number at which samples pile up, or None if none do.

    A saturated sensor gives its ceiling, or numbers just below it, far more often than the levels
    further down. The lowest level of the pile is returned.

    Parameters
    ----------
    frames : list of (rows, cols) uint8 or uint16 array
        Pictures with saturated parts: the longest exposures of a bracket.
    """
    top = max(int(frame.max()) for frame in frames)
    counts = sum(
        (np.bincount(frame.ravel(), minlength=top + 1) for frame in frames),
        start=np.zeros(top + 1, np.int64),
    )
    reach = max(4, top // 50)
    if top < 3 * reach:
        return None
    ordinary = counts[top - 3 * reach : top - reach].mean()
    above = 4 * (ordinary + 6 * np.sqrt(ordinary + 1))
    pile = np.nonzero(counts[top - reach :] > above)[0]
    return int(top - reach + pile[0]) if len(pile) else None


def _is_more_than_noise(block: NDArray[np.float64], variance: NDArray[np.float64]) -> bool:
    """Whether means of blocks differ by more than their noise makes them."""
    expected = float(variance.mean()) * (1 + _SIGNIFICANT * np.sqrt(2 / block.size))
    return float(block.var()) > expected


def _blocks_in_common(
    short: Samples, long: Samples, black: float, saturation: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means of the blocks that are well exposed in both pictures, in sensor numbers.

    Blocks are of one colour of a mosaic each, so that one which is saturated leaves the others. A
    block is judged by its brightest sample, whose noise is a small part of the mean's.
    """
    if long.shape != short.shape:
        raise DecodingError(f"frames of one bracket differ in size: {short.shape}, {long.shape}")
    rows, cols = (n // (2 * _BLOCK) for n in short.shape)

    def blocks(frame: Samples) -> NDArray[np.generic]:
        cut = frame[: rows * 2 * _BLOCK, : cols * 2 * _BLOCK]
        colours = cut.reshape(rows, _BLOCK, 2, cols, _BLOCK, 2)
        return colours.transpose(0, 3, 2, 5, 1, 4).reshape(-1, _BLOCK**2)

    if rows * cols == 0:
        return np.empty(0), np.empty(0)
    brightest = blocks(long).max(axis=1)
    clear = brightest < black + _HEADROOM * (saturation - black)
    return (
        blocks(short)[clear].mean(axis=1, dtype=np.float64),
        blocks(long)[clear].mean(axis=1, dtype=np.float64),
    )
