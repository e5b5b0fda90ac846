"""Parts of a fringe's steps that are spread evenly by themselves, each part of the next.

Harmonics of the projector's response up to one less than the steps stay out of the phase, as long
as the steps are even.
"""

from __future__ import annotations

import numpy as np

from acquisition.fringes import Fringe
from acquisition.plan import Metering


def metering_steps(fringe: Fringe, rule: Metering) -> tuple[str, ...]:
    """Frames of a fringe that are enough for its modulation: fewest steps, spread evenly."""
    return even_steps(fringe, fewest_steps(fringe, rule))


def fewest_steps(fringe: Fringe, rule: Metering) -> int:
    """Least number of evenly spread steps of a fringe that the rule allows."""
    return min(n for n in range(1, fringe.steps + 1) if _divides(fringe, n, rule))


def step_counts(fringe: Fringe, rule: Metering) -> tuple[int, ...]:
    """Numbers of evenly spread steps that a fringe can be taken with, each part of the next.

    Those of metering are part of all of them.
    """
    counts = [fewest_steps(fringe, rule)]
    for count in range(counts[0] + 1, fringe.steps + 1):
        if _divides(fringe, count, rule) and count % counts[-1] == 0:
            counts.append(count)
    return tuple(counts)


def even_steps(fringe: Fringe, count: int) -> tuple[str, ...]:
    """Frames of ``count`` evenly spread steps of a fringe."""
    order = np.argsort(np.mod(fringe.shifts_rad, 2 * np.pi), kind="stable")
    return tuple(fringe.frame_ids[i] for i in order[:: fringe.steps // count])


def _divides(fringe: Fringe, count: int, rule: Metering) -> bool:
    if count == fringe.steps:
        return True
    turns = np.sort(np.mod(fringe.shifts_rad, 2 * np.pi))
    even = np.allclose(np.diff(turns), 2 * np.pi / fringe.steps, atol=1e-6)
    return even and count >= rule.least_steps and fringe.steps % count == 0
