"""What a light is proven with: another picture, and exposures that show the difference."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from devices.interfaces import CameraCapabilities, Frame, Projection

# Edge of a square of the checkerboard, panel pixels.
_SQUARE_PX = 32
# A proof is not exposed for longer, unless the frame itself is.
_LONGEST_S = 4.0


def counterpart(projection: Projection) -> Projection:
    """A picture that can be taken neither for another one nor for a flat one.

    In every other square of a checkerboard, each pixel's level is exchanged for the extreme that is
    further from it.
    """
    image = projection.image
    rows, cols = (np.arange(size) // _SQUARE_PX for size in image.shape)
    changed = (rows[:, np.newaxis] + cols) % 2 == 0
    extreme = np.where(image < 128, np.uint8(255), np.uint8(0))
    return Projection(f"counterpart of {projection.name}", np.where(changed, extreme, image))


def telling_exposures(
    frame: Frame, exposure_s: float, camera: CameraCapabilities
) -> Iterator[float]:
    """Exposures at which a change of light should be seen, one after the other.

    That of the frame comes first; then shorter ones if it is saturated, and longer ones if not.

    Parameters
    ----------
    frame : Frame
        That did not tell.
    exposure_s : float
        Exposure that it was asked for with.
    camera : CameraCapabilities
    """
    saturated = np.median(frame.image) >= camera.saturation_level
    low, high = camera.exposure_range_s
    high = min(high, max(exposure_s, _LONGEST_S))
    yield exposure_s
    exposure = exposure_s * (0.25 if saturated else 4.0)
    while low <= exposure <= high:
        yield exposure
        exposure *= 0.25 if saturated else 4.0
