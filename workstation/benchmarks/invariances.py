"""Changes that must not matter, in every stage: what each is held to, and what it takes.

Order of inputs, number of threads, units of length and time, level of light, the frame in which
the rig is described, numbers in single precision; and inputs that hardly determine anything, which
a stage has to refuse, or to answer with errors that large.

A tolerance is what the arithmetic leaves, and says so where it is given: sums in another order
differ in their last digits, single precision has 24 of them, an iteration ends within a share of
the standard error that its criterion names. Where a result has a stated error, deviations are in
units of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numba

# Of single precision: the largest relative error of rounding a number.
SINGLE = 2.0**-24
# Deviations of rounding errors, which are even and independent, that are no chance: in units of
# their own standard deviation, for a hundred thousand numbers.
SIGMAS_OF_MANY = 6.0


@dataclass(frozen=True)
class Invariance:
    """A change that must not matter.

    Attributes
    ----------
    name : str
        Stage and change.
    deviation : float
        Largest change of the result; infinite where the result is not there.
    tolerance : float
    unit : str
    """

    name: str
    deviation: float
    tolerance: float
    unit: str

    @property
    def holds(self) -> bool:
        """Whether the change did not matter."""
        return self.deviation <= self.tolerance

    @property
    def stage(self) -> str:
        """What the change was made to."""
        return self.name.partition(", ")[0]

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.name}: {self.deviation:.2g} of {self.tolerance:.2g}{unit}"


def rounding_sigma(largest: float) -> float:
    """Standard deviation of what rounding to single precision changes, next to the largest number.

    The numbers below it are spaced as evenly, or more closely.
    """
    spacing = 2.0 ** (int(largest).bit_length() - 24)
    return float(spacing / 12**0.5)


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Compiled loops on so many threads."""
    before = numba.get_num_threads()
    numba.set_num_threads(count)
    try:
        yield
    finally:
        numba.set_num_threads(before)
