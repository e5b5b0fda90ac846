"""Where the light arm stops: poses spread evenly over its part of the hemisphere, in a short order.

Evenly means equal solid angle for each pose: equal steps in the sine of the elevation, and turns by
the golden angle. The order is a path from where the arm stands, found by the nearest neighbour and
then uncrossed by exchanges of two edges (2-opt; G. A. Croes, *A method for solving
traveling-salesman problems*, Operations Research 6, 1958).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import SessionError
from devices.interfaces import ArmLimits, ArmPose

_GOLDEN = (math.sqrt(5) - 1) / 2
_MOST_POSES = 2000


def spread_poses(limits: ArmLimits, count: int, *, least_elevation: float = 0.0) -> list[ArmPose]:
    """Poses that share the reachable part of the upper hemisphere evenly.

    Parameters
    ----------
    limits : ArmLimits
        What the arm can reach.
    count : int
        Number of poses.
    least_elevation : float
        Lower lamps, whose light grazes, are left out even if the arm reaches them; radians.

    Returns
    -------
    list of ArmPose

    Raises
    ------
    SessionError
        No pose, too many, or no elevation left between the limits.
    """
    if not 1 <= count <= _MOST_POSES:
        raise SessionError(f"{count} light poses cannot be planned; ask for 1 to {_MOST_POSES}")
    low = max(limits.elevation[0], least_elevation, 0.0)
    high = min(limits.elevation[1], math.pi / 2)
    if not low <= high:
        raise SessionError(
            f"no light pose is left: the arm reaches {math.degrees(high):.1f}° of elevation, and "
            f"{math.degrees(low):.1f}° is the least that was asked for"
        )
    first, last = limits.azimuth
    turn = min(last - first, 2 * math.pi)
    middle = (np.arange(count) + 0.5) / count
    elevation = np.arcsin(math.sin(low) + (math.sin(high) - math.sin(low)) * middle)
    azimuth = first + turn * ((np.arange(count) + 0.5) * _GOLDEN % 1.0)
    return [
        ArmPose(azimuth=float(a), elevation=float(np.clip(e, *limits.elevation)))
        for a, e in zip(azimuth, elevation, strict=True)
    ]


def order_by_travel(poses: list[ArmPose], *, start: ArmPose) -> list[ArmPose]:
    """The poses in an order that keeps the arm's travel short.

    Both axes move at once, so a move takes as long as the larger of the two angles.

    Parameters
    ----------
    poses : list of ArmPose
    start : ArmPose
        Where the arm stands before the first.

    Returns
    -------
    list of ArmPose
        The same poses.
    """
    if len(poses) < 2:
        return list(poses)
    angles = np.array([(p.azimuth, p.elevation) for p in (start, *poses)])
    distance = np.abs(angles[:, np.newaxis] - angles).max(axis=2)
    path = _exchange_edges(_nearest_first(distance), distance)
    return [poses[i - 1] for i in path[1:]]


def travel(poses: list[ArmPose], *, start: ArmPose) -> float:
    """Angle that the arm turns through along the poses, the larger of both axes per move, rad."""
    angles = np.array([(p.azimuth, p.elevation) for p in (start, *poses)])
    return float(np.abs(np.diff(angles, axis=0)).max(axis=1).sum())


def _nearest_first(distance: NDArray[np.float64]) -> NDArray[np.int64]:
    """Path from element 0 that goes to the nearest one left."""
    left = np.ones(len(distance), bool)
    path = [0]
    left[0] = False
    while left.any():
        from_here = np.where(left, distance[path[-1]], np.inf)
        path.append(int(from_here.argmin()))
        left[path[-1]] = False
    return np.array(path)


def _exchange_edges(path: NDArray[np.int64], distance: NDArray[np.float64]) -> NDArray[np.int64]:
    """Reverse stretches of a path while that makes it shorter; the first element stays."""
    count = len(path)
    for _ in range(20 * count):
        here = distance[path[:, np.newaxis], path]
        steps = np.diagonal(here, offset=1)
        # Reversing i..j replaces the edges before i and after j; at the end there is none after.
        after = np.append(steps[1:], 0.0)
        across = np.zeros((count - 1, count - 1))
        across[:, :-1] = here[1:, 2:]
        gain = steps[:, np.newaxis] + after - here[:-1, 1:] - across
        gain = np.triu(gain, k=1)
        i, j = np.unravel_index(gain.argmax(), gain.shape)
        if gain[i, j] <= 1e-12:
            break
        path = path.copy()
        path[i + 1 : j + 2] = path[i + 1 : j + 2][::-1]
    return path
