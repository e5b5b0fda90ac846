"""A photograph whose camera and light are known: what radiance samples are taken from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.lamp import Lamp
from calibration.lens import Lens, invert
from devices.bayer import BayerPattern
from fitting.errors import FittingError

Singles = NDArray[np.float32]
_CHANNEL = {"R": 0, "G": 1, "B": 2}


@dataclass(frozen=True, kw_only=True)
class Photograph:
    """A linear photograph under one light, registered to the canvas.

    The arrays may be memory maps: they are read where a tile of texels is seen, and no further.

    Attributes
    ----------
    name : str
    radiance : (rows, cols, 3) or (rows, cols) float32 array
        Linear, black level subtracted; NaN where saturated. Without the last axis, a mosaic.
    variance : array of the same shape
        Of ``radiance``.
    lens : Lens
    rt_cam_canvas : (6,) float64 array
        Where the camera stands: takes canvas points to its frame.
    lamp : Lamp
        In the canvas frame. Its intensity is on the scale of ``radiance`` over ``exposure``: it
        gives white paper, 1/π of reflectance, the radiance that was recorded of white paper.
    mosaic : BayerPattern or None
        Order of the colours of a mosaic, from its first pixel.
    first_pixel : (int, int)
        Column and row of the first pixel in the lens's full frame.
    exposure : float
        By which ``radiance`` is divided; 1 for merged brackets, which are per second already.
    flat_field : (rows, cols) float32 array or None
        What the camera makes of even light: vignetting and the pixels' sensitivity; positive.

    Raises
    ------
    FittingError
        Shapes disagree, a mosaic without order, a flat field that is not positive, or an exposure
        or pose that is no number.
    """

    name: str
    radiance: Singles
    variance: Singles
    lens: Lens
    rt_cam_canvas: NDArray[np.float64]
    lamp: Lamp
    mosaic: BayerPattern | None = None
    first_pixel: tuple[int, int] = (0, 0)
    exposure: float = 1.0
    flat_field: Singles | None = None

    def __post_init__(self) -> None:
        shape = self.radiance.shape
        if self.variance.shape != shape:
            raise FittingError(
                f"photograph {self.name}: radiance is {shape}, its variance {self.variance.shape}"
            )
        wanted = "(rows, cols)" if self.mosaic is not None else "(rows, cols, 3)"
        if len(shape) != (2 if self.mosaic is not None else 3) or shape[2:] not in ((), (3,)):
            raise FittingError(f"photograph {self.name}: radiance is {shape}, not {wanted}")
        if min(shape[:2]) < 4:
            raise FittingError(
                f"photograph {self.name}: {shape[1]} × {shape[0]} pixels are too few"
            )
        if self.flat_field is not None and self.flat_field.shape != shape[:2]:
            raise FittingError(
                f"photograph {self.name}: flat field is {self.flat_field.shape}, not {shape[:2]}"
            )
        if self.flat_field is not None and not (
            np.min(self.flat_field) > 0.0 and np.isfinite(np.max(self.flat_field))
        ):
            usable = np.isfinite(self.flat_field) & (self.flat_field > 0.0)
            raise FittingError(
                f"photograph {self.name}: the flat field is zero, negative or no number in "
                f"{int(np.sum(~usable))} of {usable.size} pixels: it is divided by"
            )
        pose = np.asarray(self.rt_cam_canvas, dtype=np.float64)
        if pose.shape != (6,) or not np.isfinite(pose).all():
            raise FittingError(f"photograph {self.name}: a pose is six finite numbers, not {pose}")
        object.__setattr__(self, "rt_cam_canvas", pose)
        if not (np.isfinite(self.exposure) and self.exposure > 0.0):
            raise FittingError(f"photograph {self.name}: exposure is {self.exposure}")

    @property
    def eye(self) -> NDArray[np.float64]:
        """The camera's centre in the canvas frame, (3,) mm."""
        return invert(self.rt_cam_canvas)[3:]

    @property
    def viewpoint(self) -> tuple[bytes, ...]:
        """What photographs from one place have in common."""
        lens = self.lens
        return (
            lens.model.encode(),
            lens.intrinsics.tobytes(),
            np.asarray(self.rt_cam_canvas).tobytes(),
            repr((self.radiance.shape[:2], self.first_pixel)).encode(),
        )

    @property
    def channels(self) -> NDArray[np.int64]:
        """Channel of each pixel by parity of row and column, (2, 2); -1 where all three are."""
        if self.mosaic is None:
            return np.full((2, 2), -1, np.int64)
        return np.array([_CHANNEL[letter] for letter in self.mosaic.value], np.int64).reshape(2, 2)

    def colour_planes(self) -> tuple[Singles, Singles]:
        """Radiance over exposure and flat field, and its variance, in colour.

        Returns
        -------
        radiance, variance : (rows, cols, 3) float32 arrays
            Of a mosaic, of half the size: one pixel for each square of two by two.
        """
        scale = np.float32(1.0 / self.exposure)
        gain = np.full(self.radiance.shape[:2], scale, np.float32)
        if self.flat_field is not None:
            gain /= self.flat_field
        if self.mosaic is None:
            own = gain[..., np.newaxis]
            return np.asarray(self.radiance * own), np.asarray(self.variance * own**2)
        radiance = halved(np.asarray(self.radiance * gain), self.channels)
        counts = np.bincount(self.channels.ravel(), minlength=3)
        return radiance, halved(np.asarray(self.variance * gain**2), self.channels) / counts.astype(
            np.float32
        )


def halved(image: Singles, channels: NDArray[np.int64]) -> Singles:
    """Means of each colour over the two by two pixels of a mosaic, (rows / 2, cols / 2, 3).

    Parameters
    ----------
    image : (rows, cols) array, or (rows, cols, 3)
        Of the latter, each pixel counts with the channel that the mosaic has there.
    channels : (2, 2) array
        As of :attr:`Photograph.channels`.
    """
    rows, cols = image.shape[0] // 2, image.shape[1] // 2
    total = np.zeros((rows, cols, 3), np.float32)
    for row in (0, 1):
        for col in (0, 1):
            channel = channels[row, col]
            own = image[row : 2 * rows : 2, col : 2 * cols : 2]
            total[..., channel] += own if own.ndim == 2 else own[..., channel]
    counts = np.bincount(channels.ravel(), minlength=3)
    return np.asarray(total / np.maximum(counts, 1), np.float32)
