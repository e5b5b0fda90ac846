"""Holding every frame against those before it: stale, repeated, lost and swapped frames.

A count alone does not catch a driver that hands out what it has buffered: its frames follow one
another properly, each one too late. Their times give them away. A projector that still shows the
previous picture delivers a fresh frame of the wrong subject; that one differs from the frame before
it by nothing but noise and a flicker of the light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from devices.errors import FrameOrderError
from devices.interfaces import Frame, Subject

# Rounding of times on the monotonic clock.
_CLOCK_S = 1e-6
# Rows that the comparison of two frames looks at, about.
_ROWS = 200
# A lamp's flicker from one frame to the next stays below this share.
_FLICKER = 0.05
# Neighbours in a difference of two frames correlate by less if it is noise.
_LEAST_CORRELATION = 0.05
# Samples on either side of every edge that a comparison needs to say anything.
_LEAST_SIZE = 16


@dataclass(frozen=True)
class _Seen:
    """What is kept of a frame: its subject and every so manieth row."""

    subject: Subject
    rows: NDArray[Any]


class FrameOrder:
    """Refuses frames that cannot be the picture of their subject; one per recording."""

    def __init__(self) -> None:
        self._last: Frame | None = None
        self._seen: dict[float, _Seen] = {}

    def check(self, frame: Frame, *, subject_since_s: float) -> bool:
        """Hold a frame against its subject and against the frames before it.

        Parameters
        ----------
        frame : Frame
            With its subject.
        subject_since_s : float
            Monotonic time since when the subject has been there.

        Returns
        -------
        bool
            False if the picture differs from the last one of the same exposure, which had another
            subject, by noise only: then the light may not have changed as it was told to.

        Raises
        ------
        FrameOrderError
            The camera's count jumped or stood still, the exposure began before the subject was
            there, or the picture is that of the frame before to the last sample.
        """
        last = self._last
        if last is not None and frame.sequence != last.sequence + 1:
            raise FrameOrderError(
                f"frame of {frame.subject}: the camera delivered its number {frame.sequence} after "
                f"{last.sequence}; a frame was lost, repeated or swapped, so resume to take it "
                "again"
            )
        early = subject_since_s - (frame.monotonic_s - frame.exposure_applied_s)
        if early > _CLOCK_S:
            raise FrameOrderError(
                f"frame of {frame.subject} is stale: its exposure began {early * 1000:.0f} ms "
                "before that was there; empty the camera's buffer and resume"
            )
        rows = frame.image[:: max(1, len(frame.image) // _ROWS)]
        if last is not None and _repeats(frame, last):
            raise FrameOrderError(
                f"frame of {frame.subject} is that of {last.subject} over again, to the last "
                "sample; the camera repeats itself under a new number, so restart it and resume"
            )
        before = self._seen.get(frame.exposure_applied_s)
        self._last = frame
        self._seen[frame.exposure_applied_s] = _Seen(frame.subject, rows.copy())
        if before is None or before.subject == frame.subject:
            return True
        return differ_beyond_noise(rows, before.rows)


def differ_beyond_noise(image: NDArray[Any], other: NDArray[Any]) -> bool:
    """Whether two pictures of the same exposure show different light.

    What a lamp or a projector changes is alike in neighbouring pixels; noise is not, so the
    products of near pixels in their difference vanish on average. A flicker of the light and an
    offset, which change nothing but the scale, are taken out first. Pixels two and four columns
    apart are compared, which have the same colour in a mosaic.

    Parameters
    ----------
    image, other : (rows, cols) array
        Sensor numbers. Pictures too small to tell count as different.
    """
    if image.shape != other.shape or min(image.shape) < _LEAST_SIZE:
        return True
    a, b = (picture.astype(np.float64) - picture.mean() for picture in (image, other))
    power = float((b * b).mean())
    gain = float((a * b).mean()) / power if power > 0 else 0.0
    # Noise in the other picture pulls the gain below one, so this side is left to the residual.
    if gain > 1 + _FLICKER or abs(image.mean() - other.mean()) > _FLICKER * max(
        1.0, image.mean(), other.mean()
    ):
        return True
    difference = a - np.clip(gain, 1 - _FLICKER, 1 + _FLICKER) * b
    energy = float((difference**2).mean())
    if energy == 0:
        return False
    # The mean product of unrelated noise scatters by energy / √n.
    least = max(5 / np.sqrt(difference.size), _LEAST_CORRELATION) * energy
    # A fringe of 8 pixels is uncorrelated with itself 2 pixels on, but not 4 pixels on.
    return any(abs((difference[:, lag:] * difference[:, :-lag]).mean()) > least for lag in (2, 4))


def _repeats(frame: Frame, last: Frame) -> bool:
    """Whether two frames agree in every sample, and not because all are dark or saturated."""
    return bool(np.array_equal(frame.image, last.image) and np.ptp(frame.image) > 0)
