"""pyrender's EGL platform; importing it turns OpenGL's binding to EGL for good."""

from __future__ import annotations

from typing import Any

from OpenGL import EGL
from pyrender.platforms import egl


class _HeadlessPlatform(egl.EGLPlatform):
    """pyrender's EGL platform, whose end leaves the display to the other contexts on it."""

    _egl_context: Any
    _egl_display: Any

    def delete_context(self) -> None:
        if self._egl_context is None:
            return
        EGL.eglMakeCurrent(
            self._egl_display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT
        )
        EGL.eglDestroyContext(self._egl_display, self._egl_context)
        self._egl_context = None


def headless_platform(device: int) -> egl.EGLPlatform:
    """The platform on one of the graphics devices, by its number."""
    return _HeadlessPlatform(1, 1, device=egl.get_device_by_index(device))
