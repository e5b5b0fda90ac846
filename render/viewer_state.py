"""What a viewer shows beside its view, and how its keys change that."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from render.bounded import BUDGET_PX
from render.errors import RenderError
from render.painter import Light
from render.painting_node import Mode

_LOWEST, _HIGHEST = np.deg2rad(1.0), np.deg2rad(90.0)
_BUDGETS = (1 / 64, 16.0)


@dataclass(frozen=True, kw_only=True)
class ViewerState:
    """What the window shows beside its view.

    Attributes
    ----------
    mode : Mode
    light : Light
        Its distance is a number.
    budget_px : float
        For :attr:`Mode.BOUNDED`.
    shadows : bool
        Whether the relief casts shadows on itself.
    exposure : float
    caption : bool
        Whether all this is written on the picture.

    Raises
    ------
    RenderError
        An exposure that is not positive, or a budget that is not.
    """

    mode: Mode = Mode.BOUNDED
    light: Light
    budget_px: float = BUDGET_PX
    shadows: bool = False
    exposure: float = 1.0
    caption: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.exposure < np.inf:
            raise RenderError(f"an exposure is a positive factor, not {self.exposure}")
        if not 0 < self.budget_px < np.inf:
            raise RenderError(f"the error budget must be positive, not {self.budget_px} px")

    def describe(self) -> str:
        """In one line."""
        light = self.light
        mode = str(self.mode)
        if self.mode is Mode.BOUNDED:
            mode += f" within {self.budget_px:.3g} px"
        azimuth, elevation = np.rad2deg([light.azimuth, light.elevation])
        place = f"azimuth {azimuth:.0f}°, elevation {elevation:.0f}°"
        shadows = "with shadows" if self.shadows else "without shadows"
        return (
            f"{mode}   light: {place}, {light.distance_mm:.0f} mm, {shadows}   "
            f"exposure {self.exposure:.3g}"
        )

    def with_mode(self, step: int) -> ViewerState:
        """In the next mode, or the one before."""
        modes = list(Mode)
        return replace(self, mode=modes[(modes.index(self.mode) + step) % len(modes)])

    def with_light(self, *, turn: float = 0.0, rise: float = 0.0, away: float = 1.0) -> ViewerState:
        """With its light moved: by radians, and by a factor on its distance."""
        light = self.light
        azimuth = (light.azimuth + turn + np.pi) % (2 * np.pi) - np.pi
        elevation = float(np.clip(light.elevation + rise, _LOWEST, _HIGHEST))
        distance = (light.distance_mm or 0.0) * away
        moved = replace(light, azimuth=azimuth, elevation=elevation, distance_mm=distance)
        return replace(self, light=moved)

    def with_budget(self, factor: float) -> ViewerState:
        """With an error budget multiplied by a factor."""
        return replace(self, budget_px=float(np.clip(self.budget_px * factor, *_BUDGETS)))
