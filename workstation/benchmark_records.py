"""Records of benchmarks: a figure, its bound, and whether the bound holds."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from rich.cells import cell_len, set_cell_size
from rich.console import Console
from rich.padding import Padding
from rich.text import Text


class Sense(StrEnum):
    """What a bound means."""

    AT_MOST = "at most"
    AT_LEAST = "at least"
    WITHIN = "within"


@dataclass(frozen=True, kw_only=True)
class Record:
    """One figure of a benchmark.

    Attributes
    ----------
    name : str
    value : float
    unit : str
    bound : float or (float, float)
        The pair is for :attr:`Sense.WITHIN`.
    sense : Sense
    runs : int
        Measurements behind the value.
    note : str
    """

    name: str
    value: float
    unit: str
    bound: float | tuple[float, float]
    sense: Sense
    runs: int = 1
    note: str = ""

    @property
    def holds(self) -> bool:
        """Whether the value keeps its bound."""
        if isinstance(self.bound, tuple):
            return self.bound[0] <= self.value <= self.bound[1]
        if self.sense is Sense.AT_MOST:
            return self.value <= self.bound
        return self.value >= self.bound

    def as_json(self) -> dict[str, Any]:
        """Plain JSON values, with ``holds``."""
        return asdict(self) | {"sense": str(self.sense), "holds": self.holds}


def limits_text(record: Record) -> str:
    """A record's bound, in words."""
    bound = record.bound
    limits = f"{bound[0]:g} to {bound[1]:g}" if isinstance(bound, tuple) else f"{bound:g}"
    return f"{record.sense} {limits}"


def record_row(record: Record) -> tuple[str, ...]:
    """A record as a row of a table: name, value, bound, whether it holds, note."""
    return (
        record.name,
        f"{record.value:.4g} {record.unit}",
        limits_text(record),
        "yes" if record.holds else "NO",
        record.note,
    )


def print_records(records: list[Record]) -> None:
    """Print records as a table on standard output, each with its note below it.

    Names are never cut, so that they can be searched for: where the window is too narrow for the
    table, what was measured stands below the name.
    """
    console = Console()
    rows = [("figure", "value", "bound", "holds", ""), *map(record_row, records)]
    *columns, _ = zip(*rows, strict=True)
    widths = [max(map(cell_len, column)) for column in columns]
    beside = sum(widths) + 2 * (len(widths) - 1) <= console.width
    for *cells, note in rows:
        name, *measured = map(set_cell_size, cells, widths)
        lines = ["  ".join((name, *measured))] if beside else [name, "  " + "  ".join(measured)]
        for line in lines:
            console.print(Text(line.rstrip()), soft_wrap=True)
        if note:
            console.print(Padding(Text(note, style="dim", overflow="fold"), (0, 0, 0, 4)))
