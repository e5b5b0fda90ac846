"""Errors of the fitting layer."""

from __future__ import annotations

from devices.errors import ImpastoError


class FittingError(ImpastoError):
    """The data do not determine the surface or its reflectance."""


class CopyError(ImpastoError):
    """A digital copy on disk is damaged or incomplete."""
