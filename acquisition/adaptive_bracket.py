"""Which exposures of a bracket are needed: a shorter one tells whether a longer one is.

Every pixel of a linear sensor is served by the exposures that give it enough signal and do not
saturate it: an interval of the bracket. The fewest exposures that serve all pixels are found by
going from short to long and taking one only where it is the last that can serve some pixel not
served yet (the classical greedy stabbing of intervals; J. Kleinberg, É. Tardos, *Algorithm Design*,
2006, section 4.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acquisition.frame_files import Samples
from acquisition.journal import SkipReason
from acquisition.plan import Bracketing


@dataclass(frozen=True)
class Need:
    """Whether an exposure is needed.

    Attributes
    ----------
    needed : bool
    pixels : int
        Number that gain by it, and by no later one.
    lacking : int
        Number that have not got enough signal so far.
    saturating : int
        Number that it is predicted to saturate.
    """

    needed: bool
    pixels: int
    lacking: int
    saturating: int

    @property
    def reason(self) -> SkipReason:
        """Why it is not needed, if it is not."""
        stuck = self.lacking > self.pixels and self.saturating >= self.lacking - self.pixels
        return SkipReason.SATURATED if stuck and self.lacking else SkipReason.SERVED


class AdaptiveBracket:
    """What the frames of one bracket have told so far; they are added from short to long.

    Parameters
    ----------
    rule : Bracketing
    black_level : float
        Sensor number without light.
    saturation_level : int
        Sensor number at and above which a sample is saturated.
    """

    def __init__(self, rule: Bracketing, *, black_level: float, saturation_level: int) -> None:
        self._rule = rule
        self._black_level = black_level
        self._saturation_level = saturation_level
        self._range = saturation_level - black_level
        self._per_second: np.ndarray | None = None
        self._served: np.ndarray | None = None

    def add(self, image: Samples, exposure_s: float) -> None:
        """Take in a recorded frame.

        Parameters
        ----------
        image : (rows, cols) uint8 or uint16 array
        exposure_s : float
            As the camera applied it.
        """
        signal = np.maximum(image.astype(np.float32) - np.float32(self._black_level), 0)
        valid = image < self._saturation_level
        rate = signal / np.float32(exposure_s)
        served = valid & (signal >= self._rule.least_signal * self._range)
        if self._per_second is None or self._served is None:
            # A pixel saturated already in the shortest exposure is so in all others.
            self._per_second = np.where(valid, rate, np.float32(np.inf))
            self._served = served
        else:
            np.copyto(self._per_second, rate, where=valid)
            self._served |= served

    def need_of(self, exposure_s: float, *, next_s: float | None) -> Need:
        """Whether another exposure is needed, by what the frames so far predict.

        Parameters
        ----------
        exposure_s : float
            Longer than those of the frames so far.
        next_s : float or None
            The exposure after it in the bracket; None if it is the last.
        """
        if self._per_second is None or self._served is None:
            return Need(True, 0, 0, 0)
        most = self._rule.headroom * self._range
        saturating = self._per_second * np.float32(exposure_s) > most
        lacking = ~self._served & np.isfinite(self._per_second)
        gaining = lacking & ~saturating
        if next_s is not None:
            gaining &= self._per_second * np.float32(next_s) > most
        pixels = int(np.count_nonzero(gaining))
        return Need(
            pixels > self._rule.least_share * gaining.size,
            pixels,
            int(np.count_nonzero(lacking)),
            int(np.count_nonzero(saturating)),
        )
