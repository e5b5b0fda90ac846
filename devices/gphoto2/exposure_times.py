"""Exposure times as cameras name them: ``1/60``, ``0.0166s``, ``2.5``, ``bulb``.

A camera can expose for the times on its list and no others. The names are nominal: makers round
powers of two (1/60 s is 1/64 s in most cameras), so exposure ratios are better estimated from the
pictures than computed from the names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

from devices.errors import DeviceError

_NUMBER = r"\d+(?:\.\d+)?"
_FRACTION = re.compile(rf"({_NUMBER})/({_NUMBER})\s*s?")
# As displays have it: 0"3 is 0.3 s, and 2" is 2 s.
_SECONDS = re.compile(rf'({_NUMBER})\s*s?|(\d+)"(\d*)')
_LONGEST_S = 3600.0


@dataclass(frozen=True)
class ExposureTime:
    """One of a camera's exposure times.

    Attributes
    ----------
    choice : str
        As the camera names it.
    seconds : float
    """

    choice: str
    seconds: float


def parse_exposure_time(choice: str) -> float | None:
    """Seconds of a choice; None if it is no time, such as ``bulb`` or ``auto``."""
    text = choice.strip().casefold()
    if match := _FRACTION.fullmatch(text):
        numerator, denominator = map(float, match.groups())
        seconds = numerator / denominator if denominator else 0.0
    elif match := _SECONDS.fullmatch(text):
        plain, whole, tenths = match.groups()
        seconds = float(plain if plain is not None else f"{whole}.{tenths or 0}")
    else:
        return None
    return seconds if 0 < seconds <= _LONGEST_S else None


class ExposureTimes:
    """The times that a camera offers.

    Parameters
    ----------
    choices : iterable of str

    Raises
    ------
    DeviceError
        None of them is a time.
    """

    def __init__(self, choices: Iterable[str]) -> None:
        listed = list(choices)
        times = ((choice, parse_exposure_time(choice)) for choice in listed)
        self._times = tuple(
            sorted(
                (ExposureTime(choice, seconds) for choice, seconds in times if seconds),
                key=lambda time: time.seconds,
            )
        )
        if not self._times:
            raise DeviceError(
                f"none of the camera's exposure times is in seconds ({', '.join(listed) or 'none'})"
                "; turn its mode dial to M"
            )

    @property
    def range_s(self) -> tuple[float, float]:
        """Shortest and longest."""
        return self._times[0].seconds, self._times[-1].seconds

    def nearest(self, seconds: float) -> ExposureTime:
        """The time in the smallest ratio to another."""
        return min(self._times, key=lambda time: abs(math.log(time.seconds / seconds)))
