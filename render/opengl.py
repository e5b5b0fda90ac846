"""OpenGL for rendering without a display, through EGL.

Importing this module sets pyrender up for EGL; every other module of :mod:`render` gets pyrender
from here, so that the platform is chosen before pyrender looks for one.
"""

from __future__ import annotations

import os

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
os.environ.setdefault("PYGLET_HEADLESS", "true")

import pyrender
from OpenGL import GL

from render.errors import RenderError

__all__ = ["GL", "HeadlessContext", "pyrender"]

_INSTALL = "install Debian's libegl1, libgl1 and libgl1-mesa-dri"
_LEAST = (4, 1)


class HeadlessContext:
    """An OpenGL context without a window; also a context manager.

    Raises
    ------
    RenderError
        No EGL driver, or an OpenGL older than 4.1.
    """

    def __init__(self) -> None:
        try:
            from pyrender.platforms import egl

            device = egl.get_device_by_index(int(os.environ.get("EGL_DEVICE_ID", "0")))
            self._platform = egl.EGLPlatform(1, 1, device=device)
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
        """Free the context."""
        self._platform.delete_context()

    def __enter__(self) -> HeadlessContext:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
