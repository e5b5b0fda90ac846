"""Errors of the calibration layer."""

from __future__ import annotations

from devices.errors import ImpastoError


class CalibrationError(ImpastoError):
    """A calibration is missing, malformed, or does not fit the frames."""
