"""The table of a projector on a screen in ``rig.toml``, and the search for screens."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from devices.discovery import Found
from devices.errors import DeviceError, MissingPackageError
from devices.interfaces import Projector
from devices.settings import DriverSettings


class HdmiSettings(DriverSettings):
    """Settings of a projector on a screen.

    Attributes
    ----------
    screen : str
        Name of the output that it is connected to, as ``impasto devices`` and ``xrandr`` list it.
    width, height : int
        Native resolution of the projector's panel.
    model : str
        What to call it.
    display : str or None
        X display; by default that of the session (``DISPLAY``).
    latency_s : float
        From the flip of the screen until the light has changed. Measure it
        (:func:`devices.hdmi.latency.measure_latency`); the default suits most projectors in their
        mode for games or computers.
    require_vsync : bool
        Whether flips must be held to the screen's refresh. Without it a frame may be torn.
    stall_s : float
        After so long without a sign of life from this program the screen goes black.
    timeout_s : float
        How long opening and showing may take.
    """

    driver: Literal["hdmi"] = "hdmi"
    screen: str
    width: Annotated[int, Field(gt=0)]
    height: Annotated[int, Field(gt=0)]
    model: str = "HDMI projector"
    display: str | None = None
    latency_s: Annotated[float, Field(ge=0, le=5)] = 0.15
    require_vsync: bool = True
    stall_s: Annotated[float, Field(ge=1)] = 20.0
    timeout_s: Annotated[float, Field(gt=0)] = 15.0

    def open(self) -> Projector:
        """Open a window that fills the screen, black.

        Raises
        ------
        DeviceError
            There is no such screen, or pictures on it would be scaled; or pyglet is missing.
        """
        from devices.hdmi.projector import HdmiProjector

        return HdmiProjector(self)


def find(*, display: str | None = None) -> list[Found]:
    """Screens of this computer with their resolution.

    Raises
    ------
    MissingPackageError
        pyglet is not installed.
    """
    from devices.hdmi.screens import list_screens

    try:
        screens = list_screens(display=display)
    except MissingPackageError:
        raise
    except DeviceError as error:
        return [Found("hdmi", "screen", "", str(error))]
    return [
        Found("hdmi", screen.name, screen.description, screen.scaling_problem())
        for screen in screens
    ]
