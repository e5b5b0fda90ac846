"""Which smooth region of a range image is the canvas: the seed fill of paper section 4.2, hardened.

The smooth pixels fall into regions. Before they are told apart, bridges a few pixels wide are cut,
so that a smear of paint over the seam of a frame does not join the two. The canvas is the region
that holds most of the picture's centre, or the one on which a pixel was named; regions that run
off the picture on three sides or more are the wall behind, if anything else will do. What a thick
stroke cuts off inside the rectangle or the convex hull that the canvas spans, and every hole,
belongs to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fitting.errors import FittingError

# A region below this share of the picture is a stroke or a speck, not a canvas.
_SMALLEST_SHARE = 0.01
# Another region of this share of the canvas's size makes the choice worth telling.
_RIVAL_SHARE = 0.3
# A region that fills this share of its smallest rectangle has lost its corners to strokes.
_RECTANGLE_FILL = 0.85


@dataclass(frozen=True)
class CanvasRegion:
    """The canvas in the picture.

    Attributes
    ----------
    outline : (rows, cols) bool array
        The canvas with its holes filled.
    warnings : tuple of str
        What was ambiguous about the choice.
    """

    outline: NDArray[np.bool_]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Regions:
    """Connected regions: labels (rows, cols), 0 for none, and by label their size and extent."""

    labels: NDArray[np.int32]
    area: NDArray[np.int64]
    box: NDArray[np.int64]  # first column, first row, end column, end row

    def sides(self, label: int) -> int:
        """How many sides of the picture a region touches."""
        rows, cols = self.labels.shape
        x0, y0, x1, y1 = self.box[label]
        return int(x0 == 0) + int(y0 == 0) + int(x1 == cols) + int(y1 == rows)


def find_region(
    smooth: NDArray[np.bool_],
    *,
    seed: tuple[int, int] | None,
    window: float,
    bridge_px: int,
) -> CanvasRegion:
    """Find the canvas among smooth pixels.

    Parameters
    ----------
    smooth : (rows, cols) bool array
        Pixels of gentle slope.
    seed : (int, int) or None
        Row and column of a pixel on the canvas; None for the picture's centre.
    window : float
        Side of the window around the centre in which regions are weighed, as a share of the
        picture.
    bridge_px : int
        Bridges between regions up to twice this wide are cut.

    Raises
    ------
    FittingError
        Nothing smooth anywhere, or none at the seed.
    """
    regions = _label(_eroded(smooth, bridge_px))
    if len(regions.area) < 2:
        raise FittingError(
            "the canvas is empty: no smooth surface anywhere in the range image; check exposure "
            "and focus of the scan"
        )
    chosen = _at_seed(regions, seed) if seed is not None else _at_centre(regions, window)
    region = _whole(regions, chosen, smooth, bridge_px)
    warnings = () if seed is not None else _doubts(regions, chosen, region)
    return CanvasRegion(region, warnings)


def _label(mask: NDArray[np.bool_]) -> _Regions:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        mask.astype(np.uint8), connectivity=4
    )
    table = np.asarray(stats, dtype=np.int64)[:count]
    corner = table[:, [cv2.CC_STAT_LEFT, cv2.CC_STAT_TOP]]
    size = table[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
    box = np.concatenate([corner, corner + size], axis=1)
    area = table[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    return _Regions(np.asarray(labels), area, box)


def _at_seed(regions: _Regions, seed: tuple[int, int]) -> int:
    rows, cols = regions.labels.shape
    row, col = (int(place) for place in seed)
    if not (0 <= row < rows and 0 <= col < cols):
        raise FittingError(f"the seed pixel ({row}, {col}) is outside the {rows} × {cols} picture")
    reach = max(rows, cols) // 50
    near = regions.labels[
        max(0, row - reach) : row + reach + 1, max(0, col - reach) : col + reach + 1
    ]
    here = int(regions.labels[row, col])
    votes = np.bincount(near.ravel(), minlength=2)
    votes[0] = 0
    if here == 0 and not votes.any():
        raise FittingError(f"no smooth surface at or near the seed pixel ({row}, {col})")
    return here or int(votes.argmax())


def _at_centre(regions: _Regions, window: float) -> int:
    """The region that holds most of the central window, or of ever larger ones."""
    rows, cols = regions.labels.shape
    large = regions.area >= _SMALLEST_SHARE * rows * cols
    inner = np.array([regions.sides(label) < 3 for label in range(len(regions.area))])
    for share in (window, 0.5, 1.0):
        half_rows, half_cols = max(1, round(rows * share / 2)), max(1, round(cols * share / 2))
        central = regions.labels[
            max(0, rows // 2 - half_rows) : rows // 2 + half_rows + 1,
            max(0, cols // 2 - half_cols) : cols // 2 + half_cols + 1,
        ]
        votes = np.bincount(central.ravel(), minlength=len(large))
        votes[0] = 0
        for allowed in (large & inner, large):
            best = int(np.where(allowed, votes, 0).argmax())
            if allowed[best] and votes[best] > 0.05 * central.size:
                return best
    return int(regions.area.argmax())


def _whole(
    regions: _Regions, chosen: int, smooth: NDArray[np.bool_], bridge_px: int
) -> NDArray[np.bool_]:
    """A region grown back to where bridges were cut, with islands in its hull, holes filled."""
    hull = _hull(regions.labels == chosen)
    inside = np.bincount(regions.labels[hull], minlength=len(regions.area))
    islands = inside > 0.9 * regions.area
    islands[[0, chosen]] = False, True
    return fill_holes(_dilated(islands[regions.labels], bridge_px) & smooth)


def _hull(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What a region spans: its smallest rectangle where it all but fills that, else its hull."""
    corners = np.asarray(cv2.convexHull(outline_pixels(mask)[:, ::-1].astype(np.int32)))
    rectangle = cv2.minAreaRect(corners)
    width, height = rectangle[1]
    if cv2.contourArea(corners) > _RECTANGLE_FILL * width * height:
        corners = np.rint(cv2.boxPoints(rectangle)).astype(np.int32)
    filled = np.zeros(mask.shape, np.uint8)
    cv2.fillConvexPoly(filled, corners, [1])
    return filled.astype(bool)


def outline_pixels(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(n, 2) rows and columns of the first and last pixels of a mask along its rows and columns.

    The corners of its convex hull are among them.
    """
    found = []
    for axis, lines in ((1, mask), (0, mask.T)):
        held = np.flatnonzero(lines.any(axis=1))
        first = lines[held].argmax(axis=1)
        last = lines.shape[1] - 1 - lines[held][:, ::-1].argmax(axis=1)
        for end in (first, last):
            found.append(np.stack([held, end][:: 1 if axis else -1], axis=1))
    return np.concatenate(found)


def fill_holes(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask with everything filled that it encloses."""
    padded = np.pad(~mask, 1, constant_values=True).astype(np.uint8)
    _, labels = cv2.connectedComponents(padded, connectivity=4)
    return np.asarray(labels[1:-1, 1:-1] != labels[0, 0])


def _doubts(regions: _Regions, chosen: int, region: NDArray[np.bool_]) -> tuple[str, ...]:
    rows, cols = region.shape
    warnings = []
    if not region[rows // 2, cols // 2]:
        warnings.append(
            "the centre of the picture is not on the canvas that was taken; name a seed pixel if "
            "another was meant"
        )
    x0, y0, x1, y1 = regions.box[chosen]
    for label in np.flatnonzero(regions.area > _RIVAL_SHARE * regions.area[chosen]):
        a, b, c, d = regions.box[label]
        surrounds = a <= x0 and b <= y0 and c >= x1 and d >= y1
        if label == chosen or surrounds or regions.sides(int(label)) >= 3:
            continue
        row, col = np.argwhere(regions.labels == label).mean(axis=0).round().astype(int)
        warnings.append(
            f"another smooth region of {regions.area[label] / regions.area[chosen]:.0%} of the "
            f"canvas's size lies around row {row}, column {col}; the one at the centre was taken, "
            "name a seed pixel to take the other"
        )
    if regions.sides(chosen) >= 3:
        warnings.append(
            "the canvas runs off the picture on three sides or more: its edges were not seen, or "
            "it is the wall"
        )
    return tuple(warnings)


def _eroded(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    if pixels == 0:
        return mask
    # What lies beyond the picture does not cut.
    return cv2.erode(mask.astype(np.uint8), disc(pixels)).astype(bool)


def _dilated(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    if pixels == 0:
        return mask
    return cv2.dilate(mask.astype(np.uint8), disc(pixels)).astype(bool)


def erode_outline(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """A mask without its outermost pixels; beyond the picture nothing is known, so that counts."""
    if pixels == 0:
        return mask
    eroded = cv2.erode(
        mask.astype(np.uint8), disc(pixels), borderType=cv2.BORDER_CONSTANT, borderValue=(0,)
    )
    return eroded.astype(bool)


def disc(pixels: int) -> NDArray[np.uint8]:
    """A disc of a radius in pixels, as OpenCV's morphology takes it."""
    side = 2 * pixels + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)
