"""The Pareto front: what nothing else beats in every figure at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

T = TypeVar("T")


def beats(
    one: Sequence[float], other: Sequence[float], alike: Sequence[float] | None = None
) -> bool:
    """Whether one point is better than another in some figure and in none worse: smaller is better.

    A figure that is not a number beats nothing, and nothing that has one is beaten by it. Better is
    what differs by more than ``alike`` tells of the figure; worse is any difference.
    """
    pairs = list(zip(one, other, alike or (0.0,) * len(one), strict=True))
    return all(a <= b for a, b, _ in pairs) and any(b - a > same for a, b, same in pairs)


def pareto_front(
    points: Iterable[T],
    costs: Callable[[T], Sequence[float]],
    *,
    alike: Sequence[float] | None = None,
) -> list[T]:
    """Points that no other beats, by their first figure.

    Parameters
    ----------
    points : iterable
    costs : callable
        Figures of a point, of which smaller ones are better; two or more, as many of each.
    alike : sequence of float, optional
        Differences of each figure that do not count, as measuring again gives others.

    Returns
    -------
    list
        Of points that are alike, all.
    """
    rated = [(tuple(costs(point)), point) for point in points]
    front = [pair for pair in rated if not any(beats(other, pair[0], alike) for other, _ in rated)]
    return [point for _, point in sorted(front, key=lambda pair: pair[0])]
