"""Relief classification: which part of the relief is worth true geometry (paper section 4.3).

Texels above a threshold δ0 are *significant*; specks too small to be relief are dropped; the grid
is cut into cells of n × n texels, and every cell that holds a significant texel becomes a box.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ReliefBoxes:
    """Boxes around the significant relief, one per cell that holds some of it.

    A box spans the texels ``[row, row + rows) × [col, col + cols)`` and, for the renderer, the
    heights from δ0 to H of the whole canvas.

    Attributes
    ----------
    corner : (count, 2) int32 array
        Row and column of the first texel of each box ((v_b, u_b) of the paper).
    size : (count, 2) int32 array
        Rows and columns of each box ((h_b, w_b) of the paper); n except at the far edges.
    h_max : (count,) float32 array
        Greatest height inside each box, mm.
    peak : (count, 2) int32 array
        Row and column of that height ((v_max, u_max) of the paper).
    """

    corner: NDArray[np.int32]
    size: NDArray[np.int32]
    h_max: NDArray[np.float32]
    peak: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.corner)


@dataclass(frozen=True)
class Relief:
    """A height field's relief, classified.

    Attributes
    ----------
    delta0_mm : float
        Threshold δ0 above the canvas plane.
    cell : int
        Edge n of a cell in texels.
    significant : (rows, cols) bool array
        Mask M_v after specks were dropped.
    boxes : ReliefBoxes
        The boxes.
    proposed_delta0_mm : float or None
        What the histogram of heights proposes for δ0, whether it was taken or not; None where it
        is not known.
    """

    delta0_mm: float
    cell: int
    significant: NDArray[np.bool_]
    boxes: ReliefBoxes
    proposed_delta0_mm: float | None = None
