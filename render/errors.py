"""Errors of the renderer."""

from __future__ import annotations

from devices.errors import ImpastoError


class RenderError(ImpastoError):
    """A picture cannot be drawn: no usable OpenGL, or a copy or view that cannot be shown."""
