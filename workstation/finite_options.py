"""Options that are numbers: infinity and NaN are none that a command could mean."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import typer


def finite_only(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command that refuses options which are not finite, or hold one that is not.

    Its signature stays, from which Typer makes the options.
    """

    @functools.wraps(command)
    def checked(**options: Any) -> Any:
        for name, value in options.items():
            numbers = value if isinstance(value, list | tuple) else (value,)
            for number in numbers:
                if isinstance(number, float) and not math.isfinite(number):
                    raise typer.BadParameter(
                        f"{number} is not a finite number",
                        param_hint=f"--{name.replace('_', '-')}",
                    )
        return command(**options)

    return checked
