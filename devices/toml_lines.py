"""The lines on which the keys of a TOML file stand, for messages about them."""

from __future__ import annotations

import re
from collections import Counter

Key = tuple[str | int, ...]

_HEADER = re.compile(r"^\s*(\[\[?)\s*([^\[\]]+?)\s*\]\]?\s*(?:#.*)?$")
_ASSIGNMENT = re.compile(r"""^\s*((?:"[^"]*"|'[^']*'|[\w-]+)(?:\s*\.\s*(?:"[^"]*"|[\w-]+))*)\s*=""")
_PART = re.compile(r""""([^"]*)"|'([^']*)'|([\w-]+)""")


def key_lines(text: str) -> dict[Key, int]:
    """Line of every table header and of every key that begins a line, counted from 1.

    Tables of an array of tables are counted from 0, as in ``("projector", "stored", 0)``. What
    stands inside multi-line strings is passed over.
    """
    lines: dict[Key, int] = {}
    arrays: Counter[Key] = Counter()
    table: Key = ()
    quote: str | None = None
    for number, line in enumerate(text.splitlines(), start=1):
        if quote is not None:
            if line.count(quote) % 2 == 1:
                quote = None
            continue
        if header := _HEADER.match(line):
            table = _indexed(_parts(header[2]), arrays, begins=header[1] == "[[")
            lines.setdefault(table, number)
            if isinstance(table[-1], int):
                # The array itself begins with its first table.
                lines.setdefault(table[:-1], number)
        elif assignment := _ASSIGNMENT.match(line):
            lines.setdefault(table + _parts(assignment[1]), number)
        quote = next((q for q in ('"""', "'" * 3) if line.count(q) % 2 == 1), None)
    return lines


def line_of(key: Key, lines: dict[Key, int]) -> int | None:
    """Line of a key, or of the nearest table around it; None if neither is known."""
    for length in range(len(key), 0, -1):
        if key[:length] in lines:
            return lines[key[:length]]
    return None


def _parts(dotted: str) -> Key:
    return tuple("".join(part) for part in _PART.findall(dotted))


def _indexed(key: Key, arrays: Counter[Key], *, begins: bool) -> Key:
    """A table's key with the numbers of the arrays that it lies in."""
    indexed: Key = ()
    for place, part in enumerate(key):
        indexed += (part,)
        if begins and place == len(key) - 1:
            arrays[indexed] += 1
        if arrays[indexed]:
            indexed += (arrays[indexed] - 1,)
    return indexed
