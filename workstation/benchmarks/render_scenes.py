"""What the renderer's benchmark draws: copies of known shape, each with its reference."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from fitting.digital_copy import DigitalCopy
from workstation.benchmarks.copies_of_known_shape import oil_copy, real_copies
from workstation.benchmarks.reference_rendering import Reference

SIZES = ((640, 480), (1024, 768))
OIL = "oil"


@dataclass(frozen=True)
class RenderedScene:
    """A copy and what pictures of it should be.

    Attributes
    ----------
    name : str
    copy : DigitalCopy
    """

    name: str
    copy: DigitalCopy

    @cached_property
    def reference(self) -> Reference:
        """Pictures by rays on the CPU."""
        return Reference(self.copy)


def oil_scene() -> RenderedScene:
    """The simulated oil painting, which times and tables are of."""
    return RenderedScene(OIL, oil_copy())


def real_scenes() -> list[RenderedScene]:
    """The dime and the plaster relief, where there are real captures."""
    return [RenderedScene(name, copy) for name, copy in real_copies().items()]
