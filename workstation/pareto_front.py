"""The Pareto front: what nothing else beats in every figure at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

T = TypeVar("T")


def beats(one: Sequence[float], other: Sequence[float]) -> bool:
    """Whether one point is better than another in some figure and in none worse: smaller is better.

    A figure that is not a number beats nothing, and nothing that has one is beaten by it.
    """
    pairs = list(zip(one, other, strict=True))
    return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


def pareto_front(points: Iterable[T], costs: Callable[[T], Sequence[float]]) -> list[T]:
    """Points that no other beats, by their first figure.

    Parameters
    ----------
    points : iterable
    costs : callable
        Figures of a point, of which smaller ones are better; two or more, as many of each.

    Returns
    -------
    list
        Of points that are alike, all.
    """
    rated = [(tuple(costs(point)), point) for point in points]
    front = [pair for pair in rated if not any(beats(other, pair[0]) for other, _ in rated)]
    return [point for _, point in sorted(front, key=lambda pair: pair[0])]
