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
