"""Whether coordinates run on unbroken elsewhere, at which the border of a component breaks off.

A wrong code is a function of the panel's coordinates: where it breaks off it does so wherever that
coordinate is seen. An upright side of a frame keeps to a coordinate too; but above and below the
frame its wall passes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# A border keeps to a coordinate in an order where this share of it is near the median; one that
# runs across the fringes has a fifth there. Of each jump among an order's, half is enough.
_KEEPS_SHARE = 0.75
_LEAST_OF_AN_ORDER = 5
# A line passes a coordinate that goes on from this share of a period before, or a pixel, to as much
# behind; nothing passes it where that is no more than this share of the border's pixels.
_PASSED_PERIODS = 0.05
_PASSED_SHARE = 0.05
_PASSAGE_LINES = 200
_SAMPLED_LINES = 40


def sampling_stride(count: int) -> int:
    """Stride that takes some of many lines, odd so that it does not keep to one of a mosaic's."""
    return (count // _SAMPLED_LINES + 1) | 1


@dataclass(frozen=True)
class Passages:
    """Stretches of pixels along which coordinates run on unbroken, on lines across the picture.

    ``before`` (stretches,) is the coordinate at which each begins, sorted, and ``after`` that at
    which it ends, on the ``line``-th of the lines, which are ``apart`` pixels apart.
    """

    before: NDArray[np.float64]
    after: NDArray[np.float64]
    line: NDArray[np.int64]
    apart: int
    period_px: float
    margin: float

    @classmethod
    def of(
        cls, axis: tuple[NDArray[np.float64], float], other: tuple[NDArray[np.float64], float]
    ) -> Passages:
        """Of one axis, its (rows, cols) coordinates and their period; broken where either's are."""
        (coordinate, period_px), (beside, other_px) = axis, other
        pictures = [(coordinate, beside), (coordinate.T, beside.T)]
        steps = [_signed_step(own) for own, _ in pictures]
        along = int(abs(steps[1]) > abs(steps[0]))
        apart = max(1, len(pictures[along][0]) // _PASSAGE_LINES)
        own, others = (lines[::apart] for lines in pictures[along])
        step = max(abs(steps[along]), 1e-6)
        margin = max(_PASSED_PERIODS * period_px, step)
        length = max(1, min(int(np.ceil(2 * margin / step)) + 1, own.shape[1] - 1))
        before, after = own[:, :-length], own[:, length:]
        if steps[along] < 0:
            before, after = after, before
        unbroken = (after > before) & (after - before < 0.9 * period_px)
        unbroken &= np.abs(others[:, length:] - others[:, :-length]) < other_px / 2
        line = np.broadcast_to(np.arange(len(own))[:, np.newaxis], unbroken.shape)[unbroken]
        order = np.argsort(before[unbroken], kind="stable")
        ends = before[unbroken][order], after[unbroken][order]
        return cls(*ends, line[order], apart, period_px, margin)

    def kept_to(
        self, at: NDArray[np.float64], beyond: NDArray[np.float64], near: float
    ) -> tuple[float, int]:
        """Share of orders in which a border keeps to a coordinate, and where no line passes that.

        The latter in pixels of the border. Their coordinates ``at`` (n,) are ``beyond`` (n,) more
        on its other side; they keep to one if most of an order's are ``near`` to it.
        """
        order = np.floor(at / self.period_px)
        keep, unpassed = [], 0
        for one in np.unique(order):
            own, further = at[order == one], beyond[order == one]
            if len(own) < _LEAST_OF_AN_ORDER:
                continue
            keep.append(np.mean(np.abs(own - np.median(own)) <= near) >= _KEEPS_SHARE)
            for jump in np.unique(further):
                same = own[further == jump]
                middle = float(np.median(same))
                kept = int((np.abs(same - middle) <= near).sum())
                if kept < max(_LEAST_OF_AN_ORDER, len(same) / 2):
                    continue
                past = max(self.lines_past(middle), self.lines_past(middle + float(jump)))
                unpassed += kept if past <= _PASSED_SHARE * kept else 0
        return float(np.mean(keep)) if keep else 0.0, unpassed

    def lines_past(self, coordinate: float) -> int:
        """About how many of the picture's lines pass a coordinate."""
        places = [coordinate - self.period_px, coordinate - self.margin]
        first, last = np.searchsorted(self.before, places)
        past = self.after[first:last] > coordinate + self.margin
        return self.apart * len(np.unique(self.line[first:last][past]))


def _signed_step(lines: NDArray[np.float64]) -> float:
    """Median change of a coordinate from pixel to pixel along lines; 0 where there is none."""
    some = lines[:: sampling_stride(len(lines))]
    # Of a mosaic with one colour saturated every second pixel is left.
    steps = (some[:, 2:] - some[:, :-2]) / 2
    steps = steps[np.isfinite(steps)]
    return float(np.median(steps)) if len(steps) else 0.0
