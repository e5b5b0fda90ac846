"""Deadlines on the monotonic clock: made once where work begins, and passed down to every wait."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from devices.errors import DeviceTimeoutError


@dataclass(frozen=True, order=True)
class Deadline:
    """A moment on the monotonic clock by which something must have happened.

    Attributes
    ----------
    at_s : float
        ``time.monotonic()`` at that moment.
    """

    at_s: float

    @classmethod
    def after(cls, seconds: float) -> Deadline:
        """The deadline ``seconds`` from now.

        Raises
        ------
        ValueError
            Not a finite time.
        """
        if not math.isfinite(seconds):
            raise ValueError(f"a deadline after {seconds} s would never come")
        return cls(time.monotonic() + seconds)

    @property
    def remaining_s(self) -> float:
        """Seconds left; zero once it has passed."""
        return max(0.0, self.at_s - time.monotonic())

    @property
    def passed(self) -> bool:
        """Whether the moment has come."""
        return time.monotonic() >= self.at_s

    def earlier(self, seconds: float) -> Deadline:
        """The earlier of this deadline and the one ``seconds`` from now."""
        return min(self, Deadline.after(seconds))

    def require(self, what: str) -> None:
        """Raise if the deadline has passed.

        Parameters
        ----------
        what : str
            What is being waited for, as the subject of "did not … in time".

        Raises
        ------
        DeviceTimeoutError
            It has passed.
        """
        if self.passed:
            raise DeviceTimeoutError(f"{what} in time")
