"""Options that a stage refuses, in one sentence, before it begins."""

from __future__ import annotations

import math

from fitting.errors import FittingError


def check_limits(options: object, **limits: tuple[float, float]) -> None:
    """Hold numbers among a stage's options against what makes sense.

    Parameters
    ----------
    options : object
        Holds them as attributes.
    limits : (float, float)
        Least and greatest value of the attributes named.

    Raises
    ------
    FittingError
        One is no finite number within its limits.
    """
    for name, (least, greatest) in limits.items():
        value = getattr(options, name)
        if not (math.isfinite(value) and least <= value <= greatest):
            upper = "" if math.isinf(greatest) else f" to {greatest:g}"
            raise FittingError(f"{name} = {value}; it is a number from {least:g}{upper}")
