"""Errors of the acquisition layer: sessions, captures and decoding."""

from __future__ import annotations

from devices.errors import ImpastoError


class SessionError(ImpastoError):
    """A session on disk is damaged, incomplete, or is not what was asked for."""


class CaptureError(ImpastoError):
    """A foreign capture or its description cannot be read."""


class DecodingError(ImpastoError):
    """The recorded frames do not determine projector coordinates."""
