"""The height field: heights above the canvas plane on a regular, canvas-aligned grid.

Paper section 3 ("a map defining at each point an elevation with respect to a reference plane").
Row 0 is the top edge of the painting: texel ``[r, c]`` is centred on
``X = origin_mm[0] + c * pitch_mm``, ``Y = origin_mm[1] - r * pitch_mm`` in the canvas frame
(X to the right, Y up, Z towards the viewer).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FittingError

# Texels, in either direction, to which a height field's correlation reaches.
CORRELATION_REACH = 3


@dataclass(frozen=True)
class HeightField:
    """Heights over the canvas, with gaps kept as gaps.

    Attributes
    ----------
    height : (rows, cols) float32 array
        Height above the canvas plane in mm; 0 in gaps.
    mask : (rows, cols) bool array
        True where the height was measured.
    variance : (rows, cols) float32 array
        Variance of ``height`` in mm²; 0 in gaps.
    pitch_mm : float
        Distance between texel centres.
    origin_mm : (float, float)
        X and Y of the centre of texel ``[0, 0]``.
    rt_cam_canvas : (6,) float64 array
        Pose of the canvas in the frame of the camera that scanned it (Rodrigues vector, then
        translation in mm): ``x_cam = R x_canvas + t``.
    correlation : (7, 7) float64 array or None
        Correlation of a texel's error with those of its neighbours up to three texels away, as
        resampling left it; element [3, 3] is the texel itself. None where it is not known.
    unresolved_mm : float
        RMS of the part of the standard errors that comes of detail finer than the samples.

    Raises
    ------
    FittingError
        Shapes disagree, the pitch is not positive, the mask is empty, or a measured height or
        variance is not finite.
    """

    height: NDArray[np.float32]
    mask: NDArray[np.bool_]
    variance: NDArray[np.float32]
    pitch_mm: float
    origin_mm: tuple[float, float]
    rt_cam_canvas: NDArray[np.float64]
    correlation: NDArray[np.float64] | None = None
    unresolved_mm: float = 0.0

    def __post_init__(self) -> None:
        if self.height.ndim != 2 or self.height.size == 0:
            raise FittingError(f"a height field is two-dimensional, not {self.height.shape}")
        if not self.height.shape == self.mask.shape == self.variance.shape:
            raise FittingError(
                f"height {self.height.shape}, mask {self.mask.shape} and variance "
                f"{self.variance.shape} differ in shape"
            )
        side = 2 * CORRELATION_REACH + 1
        if self.correlation is not None and (
            self.correlation.shape != (side, side) or not np.isfinite(self.correlation).all()
        ):
            raise FittingError(
                f"the correlation of neighbours is {side} × {side} finite numbers, not "
                f"{self.correlation.shape}"
            )
        if not (np.isfinite(self.pitch_mm) and self.pitch_mm > 0):
            raise FittingError(f"the pitch must be positive, not {self.pitch_mm} mm")
        if not self.mask.any():
            raise FittingError(
                "the canvas is empty: no texel of the height field was measured; check exposure "
                "and focus of the scan, and that the painting fills the centre of the picture"
            )
        bad = ~(np.isfinite(self.height) & np.isfinite(self.variance)) & self.mask
        if bad.any():
            row, col = np.argwhere(bad)[0]
            raise FittingError(
                f"{int(bad.sum())} measured texels of the height field are not finite (the first "
                f"at row {row}, column {col}); mark gaps in the mask instead"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, cols = self.height.shape
        return rows, cols

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the grid in mm, from outer edge to outer edge of its texels."""
        rows, cols = self.shape
        return cols * self.pitch_mm, rows * self.pitch_mm

    @property
    def height_range_mm(self) -> tuple[float, float]:
        """Lowest and highest measured height; the second is H of the paper."""
        measured = self.height[self.mask]
        return float(measured.min()), float(measured.max())

    def without(self, texels: NDArray[np.bool_]) -> HeightField:
        """The same height field with more gaps, where ``texels`` (rows, cols) is true."""
        mask = self.mask & ~texels
        return replace(
            self,
            mask=mask,
            height=np.where(mask, self.height, np.float32(0)),
            variance=np.where(mask, self.variance, np.float32(0)),
        )

    def texel_x_mm(self) -> NDArray[np.float64]:
        """X of the texel centres by column, (cols,) float64."""
        return self.origin_mm[0] + self.pitch_mm * np.arange(self.shape[1])

    def texel_y_mm(self) -> NDArray[np.float64]:
        """Y of the texel centres by row, (rows,) float64, falling."""
        return self.origin_mm[1] - self.pitch_mm * np.arange(self.shape[0])
