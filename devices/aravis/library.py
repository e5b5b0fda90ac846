"""Loading Aravis, and its errors as ours."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from devices.errors import DeviceError, DeviceLostError, MissingPackageError
from devices.optional_packages import import_optional

_NEEDED_BY = "a GenICam camera"
_INSTALL = "apt install gir1.2-aravis-0.8 python3-gi, then scripts/bootstrap"
# The port that GigE Vision cameras are controlled through.
FIREWALL_HINT = "look at its cable and power, and let UDP through the firewall (port 3956)"


def load_aravis() -> Any:
    """Aravis 0.8 through GObject introspection.

    Raises
    ------
    MissingPackageError
        It is not installed.
    """
    gi = import_optional("gi", needed_by=_NEEDED_BY, install=_INSTALL)
    try:
        gi.require_version("Aravis", "0.8")
    except ValueError as error:
        raise MissingPackageError(
            f"{_NEEDED_BY} needs Aravis 0.8, which cannot be loaded ({error}); install it: "
            f"{_INSTALL}"
        ) from None
    return import_optional("gi.repository.Aravis", needed_by=_NEEDED_BY, install=_INSTALL)


@contextmanager
def named_errors(what: str) -> Iterator[None]:
    """Turn an error of Aravis into one of ours.

    Parameters
    ----------
    what : str
        What could not be done, as the beginning of a sentence.

    Raises
    ------
    DeviceLostError
        The camera did not answer any more, or another program took it.
    DeviceError
        Anything else.
    """
    from gi.repository import Aravis, GLib

    try:
        yield
    except GLib.Error as error:
        kinds = Aravis.DeviceError
        domain = Aravis.device_error_quark()
        if error.matches(domain, kinds.TIMEOUT) or error.matches(domain, kinds.NOT_CONNECTED):
            raise DeviceLostError(
                f"{what}: the camera does not answer any more ({error.message}); {FIREWALL_HINT}"
            ) from None
        if error.matches(domain, kinds.NOT_CONTROLLER):
            raise DeviceLostError(
                f"{what}: another program controls the camera ({error.message}); close it"
            ) from None
        if error.matches(domain, kinds.NOT_FOUND):
            raise DeviceError(
                f"{what}: no camera answers there ({error.message}); {FIREWALL_HINT}"
            ) from None
        raise DeviceError(f"{what}: {error.message}") from None
