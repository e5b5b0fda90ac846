"""What a search for devices finds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Found:
    """A device, or a place where one should be.

    Attributes
    ----------
    driver : str
        Name of the driver, as in ``rig.toml``.
    address : str
        Where it is: a port, a bus address, a screen.
    model : str
        What it says it is; empty if it does not answer.
    problem : str or None
        What is wrong with it and what to do; None if it answers as it should.
    """

    driver: str
    address: str
    model: str
    problem: str | None = None
