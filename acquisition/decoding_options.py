"""What decoding accepts, and what it compensates."""

from __future__ import annotations

import math
from dataclasses import dataclass

from acquisition.errors import DecodingError
from acquisition.sample_noise import SampleNoise


@dataclass(frozen=True, kw_only=True)
class DecodingOptions:
    """What decoding accepts.

    Attributes
    ----------
    noise : SampleNoise or None
        Calibrated noise of a sample; None estimates it from the fringes.
    minimum_modulation : float or None
        Smallest fringe amplitude in sensor numbers; None takes ``minimum_contrast`` times the
        noise of a sample.
    minimum_contrast : float
        Modulation over noise below which a phase is not trusted.
    order_sigmas : float
        Standard deviations by which phase and fringe order may disagree.
    wrong_order_probability : float
        Probability that noise gives a wrong fringe order, beyond which a pixel's order is not
        accepted by itself: the rate of wrong orders that a step from fringe to fringe accepts is
        no more.
    borne_out_probability : float
        The same, up to which an order is accepted where neighbours bear it out.
    false_alarm : float
        Share of the pixels of a scan of nothing but single reflections and noise that may be
        flagged as mixed light, all fringes together.
    check_neighbours : bool
        Whether fringe orders are held against those of neighbouring pixels, and repaired or
        rejected.
    compensate_harmonics : bool
        Whether phase errors by the projector's response are estimated from the fringes and
        subtracted. It takes several periods over a surface that is smooth for the most part.

    Raises
    ------
    DecodingError
        A value that is no number, a negative one, or a probability outside (0, 1).
    """

    noise: SampleNoise | None = None
    minimum_modulation: float | None = None
    minimum_contrast: float = 3.0
    order_sigmas: float = 6.0
    wrong_order_probability: float = 1e-5
    borne_out_probability: float = 0.05
    false_alarm: float = 1e-4
    check_neighbours: bool = True
    compensate_harmonics: bool = False

    def __post_init__(self) -> None:
        for name in ("minimum_modulation", "minimum_contrast", "order_sigmas"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise DecodingError(f"{name} = {value}; it is a number of zero or more")
        for name in ("wrong_order_probability", "borne_out_probability", "false_alarm"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise DecodingError(f"{name} = {value}; a probability lies between 0 and 1")
