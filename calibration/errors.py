"""Errors of the calibration layer."""

from __future__ import annotations

from devices.errors import ImpastoError


class CalibrationError(ImpastoError):
    """A calibration is missing, malformed, or does not fit the frames."""


class CalibrationRefusedError(CalibrationError):
    """A calibration failed a quality gate; the message says what to record instead."""

    exit_code = 5


class RegistrationError(CalibrationError):
    """A photograph cannot be registered to the scan; the message says why."""
