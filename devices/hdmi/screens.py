"""Screens of an X display: where they are, what they show, and whether they show it unscaled."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from typing import Any

from devices.deadline import Deadline
from devices.errors import DeviceError
from devices.optional_packages import import_optional

_LIST_S = 15.0


@dataclass(frozen=True)
class Screen:
    """One output of the graphics card that is switched on.

    Attributes
    ----------
    name : str
        Of the output, as ``xrandr`` lists it.
    x, y, width, height : int
        Its part of the desktop, in pixels.
    mode_width, mode_height : int
        Pixels that go over the cable.
    refresh_hz : float
        0 where the system does not tell.
    dpi_scale : float
        Factor by which the desktop enlarges its windows.
    primary : bool
        Whether it is the operator's own screen.
    """

    name: str
    x: int
    y: int
    width: int
    height: int
    mode_width: int
    mode_height: int
    refresh_hz: float
    dpi_scale: float
    primary: bool

    @property
    def description(self) -> str:
        """Resolution and refresh, for lists."""
        refresh = f" at {self.refresh_hz:.2f} Hz" if self.refresh_hz else ""
        return f"{self.mode_width}×{self.mode_height}{refresh}{', primary' * self.primary}"

    def scaling_problem(self) -> str | None:
        """What changes the size of pictures on the way to this screen; None if nothing does."""
        if (self.width, self.height) != (self.mode_width, self.mode_height):
            return (
                f"the desktop scales or turns {self.width}×{self.height} to "
                f"{self.mode_width}×{self.mode_height}; run xrandr --output {self.name} "
                "--scale 1x1 --rotate normal"
            )
        if self.dpi_scale != 1:
            return (
                f"the desktop enlarges windows {self.dpi_scale:g} times; set its scale to 100 % "
                "(Xft.dpi: 96)"
            )
        return None

    def check_native(self, width: int, height: int) -> None:
        """Refuse the screen if its pixels are not those of a panel of this size.

        Raises
        ------
        DeviceError
            The mode is another one, or something scales; with what to set.
        """
        if (self.mode_width, self.mode_height) != (width, height):
            raise DeviceError(
                f"screen {self.name} runs at {self.mode_width}×{self.mode_height} and the "
                f"projector's panel has {width}×{height}, so that pictures would be scaled; run "
                f"xrandr --output {self.name} --mode {width}x{height} --scale 1x1, or correct "
                "width and height in rig.toml"
            )
        problem = self.scaling_problem()
        if problem is not None:
            raise DeviceError(f"screen {self.name}: {problem}")


def list_screens(*, display: str | None = None) -> list[Screen]:
    """Screens of a display, asked for by a process of its own.

    pyglet serves either a display or rendering without one in a process, and this one renders.

    Parameters
    ----------
    display : str, optional
        X display; by default that of the session.

    Raises
    ------
    DeviceError
        No display, or pyglet cannot be loaded.
    """
    from devices.hdmi.window_link import WindowLink

    link = WindowLink({"list": True}, display=display)
    try:
        answer = link.receive(Deadline.after(_LIST_S))
    finally:
        link.kill()
    return [Screen(**fields) for fields in answer["screens"]]


def read_screens(pyglet: Any) -> list[tuple[Screen, Any]]:
    """Screens that pyglet sees, each with pyglet's own object; for the window's process only.

    Raises
    ------
    DeviceError
        No display.
    """
    name = os.environ.get("DISPLAY")
    if not name:
        raise DeviceError(
            "no DISPLAY is set: run this in the graphical session of the computer that drives the "
            "projector, or set DISPLAY (for instance to :0)"
        )
    try:
        display = pyglet.display.get_display()
    except pyglet.display.xlib.NoSuchDisplayException:
        raise DeviceError(
            f"the X display {name!r} does not answer; set DISPLAY, and xhost or XAUTHORITY if the "
            "session is another user's"
        ) from None
    _refuse_wayland(display)
    found = []
    for screen in display.get_screens():
        size = mode_size(screen)
        if not screen.width or size is None:
            continue
        found.append(
            (
                Screen(
                    name=screen.get_monitor_name(),
                    x=screen.x,
                    y=screen.y,
                    width=screen.width,
                    height=screen.height,
                    mode_width=size[0],
                    mode_height=size[1],
                    refresh_hz=float(screen.get_mode().rate or 0),
                    dpi_scale=screen.get_scale(),
                    primary=bool(getattr(screen, "is_primary", False)),
                ),
                screen,
            )
        )
    return found


def mode_size(pyglet_screen: Any) -> tuple[int, int] | None:
    """Pixels that go over a screen's cable now; None if it is off. For the window's process."""
    try:
        mode = pyglet_screen.get_mode()
    except ValueError:
        # An output without a controller has no description.
        return None
    return None if mode is None else (mode.width, mode.height)


def load_pyglet() -> Any:
    """Pyglet with a window system, for the window's process only.

    Raises
    ------
    MissingPackageError
        It, or the system's OpenGL, cannot be loaded.
    """
    pyglet = import_optional(
        "pyglet", needed_by="a projector on a screen", install=".venv/bin/pip install 'pyglet>=2'"
    )
    pyglet.options["headless"] = False
    pyglet.options["shadow_window"] = False
    install = "apt install libgl1 libglx-mesa0 libx11-6 libxrandr2"
    for module in ("pyglet.display", "pyglet.gl", "pyglet.window", "pyglet.graphics.shader"):
        import_optional(module, needed_by="a projector on a screen", install=install)
    return pyglet


def as_fields(screen: Screen) -> dict[str, Any]:
    """A screen as it goes through the pipe."""
    return asdict(screen)


def _refuse_wayland(display: Any) -> None:
    """X programs under Wayland are not told how their windows are scaled."""
    from ctypes import byref, c_int

    from pyglet.libs.x11 import xlib

    numbers = [c_int(), c_int(), c_int()]
    if xlib.XQueryExtension(display._display, b"XWAYLAND", *(byref(number) for number in numbers)):
        raise DeviceError(
            "this is a Wayland session, which may scale pictures without telling; choose an Xorg "
            "session when you log in"
        )
