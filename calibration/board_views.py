"""Board poses as they are seen: pixels of the corners in every lens, with their noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError


@dataclass(frozen=True)
class BoardView:
    """One pose of a board.

    Attributes
    ----------
    name : str
        What the pose is called in reports and errors.
    pixels : tuple of (rows, columns, 2) float64 arrays
        Corners in each lens; NaN where a corner is not seen.
    sigma_px : tuple of (rows, columns) float64 arrays
        Standard deviation of a corner along either axis.
    """

    name: str
    pixels: tuple[NDArray[np.float64], ...]
    sigma_px: tuple[NDArray[np.float64], ...]

    def __post_init__(self) -> None:
        if len(self.pixels) != len(self.sigma_px) or not self.pixels:
            raise CalibrationError(f"{self.name}: corners and their noise for every lens")
        shape = self.pixels[0].shape[:2]
        for pixels, sigma in zip(self.pixels, self.sigma_px, strict=True):
            if pixels.shape != (*shape, 2) or sigma.shape != shape:
                raise CalibrationError(
                    f"{self.name}: corners of {pixels.shape} with noise of {sigma.shape}; every "
                    f"lens needs {(*shape, 2)} and {shape}"
                )
            used = sigma[np.isfinite(pixels).all(axis=-1)]
            if not (np.isfinite(used).all() and (used > 0).all()):
                raise CalibrationError(f"{self.name}: the noise of a corner must be positive")

    @classmethod
    def of(
        cls, name: str, pixels: list[NDArray[np.float64]], *, sigma_px: float | list[float]
    ) -> BoardView:
        """A view whose corners have one noise per lens."""
        sigmas = np.broadcast_to(np.asarray(sigma_px, np.float64), len(pixels))
        noise = [np.full(p.shape[:2], s) for p, s in zip(pixels, sigmas, strict=True)]
        return cls(name, tuple(np.asarray(p, np.float64) for p in pixels), tuple(noise))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(lenses, rows, columns) bool array: corners with pixels."""
        return np.isfinite(np.stack(self.pixels)).all(axis=-1)

    def turned(self) -> BoardView:
        """The same view with the board's corners counted from the opposite corner."""
        return BoardView(
            self.name,
            tuple(np.ascontiguousarray(p[::-1, ::-1]) for p in self.pixels),
            tuple(np.ascontiguousarray(s[::-1, ::-1]) for s in self.sigma_px),
        )

    def without(self, corners: NDArray[np.bool_]) -> BoardView:
        """The same view with some of the corners (rows, columns) seen by no lens."""
        pixels = tuple(np.where(corners[..., np.newaxis], np.nan, p) for p in self.pixels)
        return BoardView(self.name, pixels, self.sigma_px)

    def moved(self, shifts: NDArray[np.float64]) -> BoardView:
        """The same view with (lenses, rows, columns, 2) added to the pixels."""
        pixels = tuple(p + shift for p, shift in zip(self.pixels, shifts, strict=True))
        return BoardView(self.name, pixels, self.sigma_px)
