"""The choice between drawing into memory and into windows, which OpenGL's binding asks once."""

from __future__ import annotations

import os
import sys

from render.errors import RenderError

_PLATFORM = "PYOPENGL_PLATFORM"
_GLX = "posix"  # as PyOpenGL calls it


def draw_in_windows() -> None:
    """Draw into windows of the X display; call before anything else of :mod:`render` is imported.

    Raises
    ------
    RenderError
        Pictures were drawn into memory already, or there is no display that answers.
    """
    if "OpenGL" in sys.modules and not in_windows():
        raise RenderError("this process draws into memory already; a window needs one of its own")
    if not os.environ.get("DISPLAY"):
        raise no_display("DISPLAY is not set")
    os.environ[_PLATFORM] = _GLX
    os.environ.pop("PYGLET_HEADLESS", None)
    import pyglet

    # A hidden window that pyglet opens for itself otherwise; pyrender has no use for it either.
    pyglet.options.shadow_window = False
    try:
        pyglet.display.get_display()
    except Exception as error:  # the display's own exception is there only where its library is
        raise no_display(f"{type(error).__name__}: {error}") from error


def in_windows() -> bool:
    """Whether this process draws into windows."""
    return os.environ.get(_PLATFORM) == _GLX


def no_display(reason: str) -> RenderError:
    """The error of a window that cannot be opened."""
    return RenderError(
        f"a window needs a display ({reason}); use impasto render where there is none"
    )
