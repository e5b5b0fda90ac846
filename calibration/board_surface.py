"""The relief of a board as a surface: cubic B-splines over its plane.

Paper blisters between the corners too. A tensor product of uniform cubic B-splines holds the height
over the board's plane; its roughness is the sum of squared second differences of the coefficients
(Eilers & Marx 1996, "Flexible smoothing with B-splines and penalties").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from calibration.boards import Chessboard

# Squares beyond the outer corners that a surface covers.
MARGIN_SQUARES = 1.25
_SUPPORT = 4


@dataclass(frozen=True)
class SplineGrid:
    """Knots of a surface over a board.

    Attributes
    ----------
    start_mm : (2,) float64 array
        The first knot's x and y in the board's frame.
    pitch_mm : float
    columns, rows : int
        Coefficients along x and y.
    """

    start_mm: NDArray[np.float64]
    pitch_mm: float
    columns: int
    rows: int

    @classmethod
    def over(cls, board: Chessboard, *, knots_per_square: float) -> SplineGrid:
        """Knots over a board and :data:`MARGIN_SQUARES` around its outer corners."""
        pitch = board.square_mm / knots_per_square
        margin = MARGIN_SQUARES * board.square_mm + 2 * pitch
        far = board.points[-1, -1, :2]
        columns, rows = (int(np.ceil((size + 2 * margin) / pitch)) + 1 for size in far)
        return cls(np.full(2, -margin), pitch, columns, rows)

    @property
    def size(self) -> int:
        """Coefficients altogether."""
        return self.columns * self.rows

    def basis(self, places: NDArray[np.float64]) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
        """Coefficients that act at places, and by how much.

        Parameters
        ----------
        places : (n, 2) array
            x and y in the board's frame, mm; beyond the margin the surface goes on.

        Returns
        -------
        index : (n, 16) int array
        weight : (n, 16, 3) float64 array
            Of the height, and of its slopes along x and y.
        """
        at = (np.nan_to_num(places) - self.start_mm) / self.pitch_mm
        last = np.array([self.columns, self.rows]) - 3
        cell = np.clip(np.floor(at).astype(int), 1, last)
        (along, rate), (down, fall) = (_cubic(at[:, k] - cell[:, k]) for k in (0, 1))
        steps = np.arange(-1, 3)
        index = (cell[:, 1, None] + steps)[:, :, None] * self.columns
        index = index + (cell[:, 0, None] + steps)[:, None, :]
        weight = np.stack(
            [
                down[:, :, None] * along[:, None, :],
                down[:, :, None] * rate[:, None, :] / self.pitch_mm,
                fall[:, :, None] * along[:, None, :] / self.pitch_mm,
            ],
            axis=-1,
        )
        return index.reshape(len(at), _SUPPORT**2), weight.reshape(len(at), _SUPPORT**2, 3)

    def heights(
        self, coefficients: NDArray[np.float64], places: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(n, 3) height in mm and its slopes along x and y at places (n, 2)."""
        index, weight = self.basis(places)
        return np.asarray(np.einsum("nk,nkj->nj", coefficients[index], weight))

    def roughness(self) -> sparse.csr_matrix:
        """Second differences of the coefficients along x, along y, and mixed, (m, size)."""

        def difference(count: int, order: int) -> sparse.csr_matrix:
            return sparse.csr_matrix(np.diff(np.eye(count), order, axis=0))

        across, down = sparse.eye(self.columns), sparse.eye(self.rows)
        return sparse.vstack(
            [
                sparse.kron(down, difference(self.columns, 2)),
                sparse.kron(difference(self.rows, 2), across),
                np.sqrt(2) * sparse.kron(difference(self.rows, 1), difference(self.columns, 1)),
            ]
        ).tocsr()


def _cubic(t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The four cubic B-splines that act at a fraction of a cell, and their derivatives."""
    t = np.asarray(t, np.float64)[:, None]
    value = [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]
    slope = [-((1 - t) ** 2), 3 * t**2 - 4 * t, -3 * t**2 + 2 * t + 1, t**2]
    return np.hstack(value) / 6, np.hstack(slope) / 2
