"""A camera's clock against ours: when a frame was exposed, by the stamp that it carries.

Cameras stamp a frame at some moment of its exposure; which one is left to the maker, most take the
beginning. Their clocks have another zero than ours, and drift against it by some 50 ppm.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any

# Delays are kept for so long: clocks do not drift apart by more than some ms meanwhile.
_KEPT_S = 60.0
# Commands that note the camera's time, and where it is then: by the naming convention, and by
# the one before it, in which the clock has a frequency.
_LATCHES = (
    ("TimestampLatch", "TimestampLatchValue", None),
    ("GevTimestampControlLatch", "GevTimestampValue", "GevTimestampTickFrequency"),
)
_NANOSECOND_TICKS = 1e9


class DeviceClock:
    """What the camera's clock read at what time of ours.

    No frame can arrive before it was stamped, so the frame with the shortest way tells how far the
    clocks are apart; a reading of the camera's clock, where there is one, tells it better.
    """

    def __init__(self) -> None:
        self._offsets: deque[tuple[float, float]] = deque()
        self._read_offset: float | None = None

    def note(self, stamp_s: float, *, before_s: float, after_s: float) -> None:
        """Take note of a reading of the camera's clock between two moments of ours."""
        self._read_offset = (before_s + after_s) / 2 - stamp_s

    def forget(self) -> None:
        """The camera's clock may have been set back."""
        self._offsets.clear()
        self._read_offset = None

    def monotonic_s(self, stamp_s: float, *, arrived_s: float) -> float | None:
        """Our time at which a frame was stamped.

        Parameters
        ----------
        stamp_s : float
            The camera's stamp; zero or less if it gave none.
        arrived_s : float
            When the frame was here.

        Returns
        -------
        float or None
            None if the frame has no stamp. Late by the shortest delay of the last frames, where
            the camera's clock was not read.
        """
        if not (math.isfinite(stamp_s) and stamp_s > 0):
            return None
        self._offsets.append((arrived_s, arrived_s - stamp_s))
        while self._offsets[0][0] < arrived_s - _KEPT_S:
            self._offsets.popleft()
        shortest = min(offset for _, offset in self._offsets)
        offset = shortest if self._read_offset is None else self._read_offset
        return stamp_s + offset


def clock_reader(device: Any) -> Callable[[DeviceClock], None] | None:
    """What reads a camera's clock, at a cost of two or three messages.

    Parameters
    ----------
    device : Aravis.Device

    Returns
    -------
    callable or None
        Notes a reading; None if the camera has no clock that can be read.
    """
    for latch, value, frequency in _LATCHES:
        if device.is_feature_available(latch) and device.is_feature_available(value):
            ticks_per_s = _NANOSECOND_TICKS
            if frequency is not None and device.is_feature_available(frequency):
                ticks_per_s = device.get_integer_feature_value(frequency) or ticks_per_s
            return lambda clock: _read(device, clock, latch, value, ticks_per_s)
    return None


def _read(device: Any, clock: DeviceClock, latch: str, value: str, ticks_per_s: float) -> None:
    before_s = time.monotonic()
    device.execute_command(latch)
    after_s = time.monotonic()
    ticks = device.get_integer_feature_value(value)
    clock.note(ticks / ticks_per_s, before_s=before_s, after_s=after_s)


def exposure_end_s(
    stamped_s: float | None, *, exposure_s: float, asked_s: float, arrived_s: float
) -> float:
    """When an exposure ended.

    If the stamp is that of its beginning, the exposure later; not after the frame was here, and
    not before an exposure that began when it was asked for could have ended. A stamp taken at the
    end makes it late by no more than the frame's way to us.

    Parameters
    ----------
    stamped_s : float or None
        Our time of the camera's stamp.
    exposure_s : float
    asked_s, arrived_s : float
        When the exposure was asked for, and when the frame was here.
    """
    ended = arrived_s if stamped_s is None else min(stamped_s + exposure_s, arrived_s)
    return max(ended, asked_s + exposure_s)
