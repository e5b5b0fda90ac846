"""Root of the error tree, and the errors of the device layer.

Every error that Impasto raises on purpose derives from :class:`ImpastoError`. Its message says
what is wrong, where, and what to do; its ``exit_code`` is what the command line ends with.
"""

from __future__ import annotations


class ImpastoError(Exception):
    """Anything Impasto refuses to do, with a message for the person at the desk."""

    exit_code = 3


class DeviceError(ImpastoError):
    """A device did not answer, answered wrongly, or was asked for what it cannot do."""

    exit_code = 4


class DeviceTimeoutError(DeviceError):
    """A device did not do in time what it was asked for."""


class DeviceLostError(DeviceError):
    """A device that answered before is gone: unplugged, switched off, or its program ended."""


class FrameOrderError(DeviceError):
    """A frame cannot be the picture of what it was asked for: stale, repeated, lost or swapped."""


class NotRecordedError(DeviceError):
    """A replayed device was asked for what its session does not hold."""


class MissingPackageError(DeviceError):
    """A driver needs a package that is not installed; the message names it."""


class RigFileError(ImpastoError):
    """A ``rig.toml`` cannot be read; the message names the key."""
