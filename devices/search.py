"""Searching for devices with every driver at once, each in its own time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from devices.child_process import call_all
from devices.discovery import Found
from devices.drivers import DRIVERS, Driver
from devices.errors import MissingPackageError

SEARCHED = tuple(driver for driver in DRIVERS if driver.searched)


@dataclass(frozen=True)
class Search:
    """What one driver found.

    Attributes
    ----------
    driver : Driver
    found : tuple of Found
    missing : str or None
        What has to be installed before the driver can search; None if nothing.
    problem : str or None
        Why the search failed; None if it did not.
    """

    driver: Driver
    found: tuple[Found, ...] = ()
    missing: str | None = None
    problem: str | None = None


def search(drivers: Sequence[Driver] = SEARCHED, *, limit_s: float = 20.0) -> Iterator[Search]:
    """Search with every driver, and yield each one's result as it comes.

    Parameters
    ----------
    drivers : sequence of Driver
    limit_s : float
        How long each may take; one that hangs keeps none of the others.

    Yields
    ------
    Search
        One per driver.
    """
    by_name = {driver.name: driver for driver in drivers}
    calls = {name: (Driver.find, (driver,)) for name, driver in by_name.items()}
    for answer in call_all(calls, limit_s=limit_s):
        driver = by_name[answer.name]
        if answer.error is None:
            yield Search(driver, found=tuple(answer.value))
        elif isinstance(answer.error, MissingPackageError):
            yield Search(driver, missing=str(answer.error))
        else:
            yield Search(driver, problem=str(answer.error))
