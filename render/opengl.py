"""OpenGL for rendering without a display, through EGL.

Importing this module sets pyrender up for EGL, unless :mod:`render.windows` chose windows before;
every other module of :mod:`render` gets pyrender from here, so that the platform is chosen before
pyrender looks for one.
"""

from __future__ import annotations

import os

from render.errors import RenderError

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
os.environ.setdefault("PYGLET_HEADLESS", "true")

_INSTALL = "install Debian's libegl1, libgl1 and libgl1-mesa-dri"
_LEAST = (4, 1)

# Without its libraries OpenGL's binding fails while it is imported, in several ways.
try:
    import pyrender
    from OpenGL import GL
    from OpenGL.error import Error as OpenGLError
except (ImportError, AttributeError, OSError) as error:
    raise RenderError(
        f"OpenGL's libraries cannot be loaded ({type(error).__name__}: {error}); {_INSTALL}"
    ) from error

__all__ = ["GL", "HeadlessContext", "OpenGLError", "pyrender"]


class HeadlessContext:
    """An OpenGL context without a window; also a context manager.

    Raises
    ------
    RenderError
        No EGL driver, or an OpenGL older than 4.1.
    """

    def __init__(self) -> None:
        try:
            from render.egl_platform import headless_platform

            self._platform = headless_platform(int(os.environ.get("EGL_DEVICE_ID", "0")))
            self._platform.init_context()
            version = (GL.glGetIntegerv(GL.GL_MAJOR_VERSION), GL.glGetIntegerv(GL.GL_MINOR_VERSION))
        except Exception as error:  # EGL's binding raises a dozen types of its own
            raise RenderError(
                f"no OpenGL without a display ({type(error).__name__}: {error}); {_INSTALL}"
            ) from error
        if version < _LEAST:
            self.close()
            raise RenderError(
                f"OpenGL {version[0]}.{version[1]} is older than the 4.1 needed; {_INSTALL}"
            )

    def make_current(self) -> None:
        """Direct OpenGL calls of this thread to this context."""
        self._platform.make_current()

    def close(self) -> None:
        """Free the context; a second time does nothing."""
        self._platform.delete_context()

    def __enter__(self) -> HeadlessContext:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
