"""Packages that only some drivers need: imported when such a driver is opened, never before."""

from __future__ import annotations

import importlib
from types import ModuleType

from devices.errors import MissingPackageError


def import_optional(module: str, *, needed_by: str, install: str) -> ModuleType:
    """Import a module that a driver needs.

    Parameters
    ----------
    module : str
        Name to import.
    needed_by : str
        What needs it, as the subject of "needs".
    install : str
        Command that installs it.

    Raises
    ------
    MissingPackageError
        It is not there, or something that it needs is not.
    """
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:
        raise MissingPackageError(
            f"{needed_by} needs the package {module!r}, which cannot be loaded ({error}); "
            f"install it: {install}"
        ) from None
