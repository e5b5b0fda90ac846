"""Planner of a simulated GRBL controller: queued straight moves with ramps, corners and holds.

Kinematics as GRBL 1.1 plans them: along each move one acceleration and one top speed, the largest
that no axis forbids; from move to move the speed that its junction deviation allows; a hold slows
down along the path and keeps the rest of the queue. Every stretch of constant acceleration is
advanced in closed form, so the position is exact at any time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

Vector = tuple[float, float, float]

CAPACITY = 15
"""Moves that the queue holds."""

_TINY = 1e-9


@dataclass
class _Move:
    """A queued move; lengths in units, times in seconds."""

    target: Vector
    direction: Vector
    length: float
    feed: float | None  # None: as fast as the axes can
    fastest: float
    acceleration: float
    corner: float = 0.0
    entry: float = 0.0

    def top_speed(self, feed_share: float, rapid_share: float) -> float:
        """Speed that it aims for under overrides."""
        if self.feed is None:
            return self.fastest * rapid_share
        return min(self.feed * feed_share, self.fastest)


class Planner:
    """Moves along queued straight lines.

    Parameters
    ----------
    position : (float, float, float)
        Where it starts.
    """

    def __init__(self, position: Vector = (0.0, 0.0, 0.0)) -> None:
        self._queue: deque[_Move] = deque()
        self._end = position
        self._travelled = 0.0
        self._start = position
        self.speed = 0.0
        self.feed_share = 1.0
        self.rapid_share = 1.0

    @property
    def free(self) -> int:
        """Moves that can still be queued."""
        return CAPACITY - len(self._queue)

    @property
    def busy(self) -> bool:
        """Whether anything is queued or runs."""
        return bool(self._queue)

    @property
    def end(self) -> Vector:
        """Where the last queued move ends."""
        return self._end

    @property
    def position(self) -> Vector:
        """Where it is."""
        if not self._queue:
            return self._start
        direction, s = self._queue[0].direction, self._travelled
        x, y, z = (a + s * u for a, u in zip(self._start, direction, strict=True))
        return x, y, z

    @property
    def velocity(self) -> Vector:
        """Speed of each axis."""
        if not self._queue:
            return (0.0, 0.0, 0.0)
        x, y, z = (self.speed * u for u in self._queue[0].direction)
        return x, y, z

    def place(self, position: Vector) -> None:
        """Drop the queue and stand at a position."""
        self._queue.clear()
        self._start = self._end = position
        self._travelled = self.speed = 0.0

    def add(
        self,
        target: Vector,
        feed: float | None,
        *,
        max_rates: Sequence[float],
        accelerations: Sequence[float],
        junction_deviation: float,
    ) -> bool:
        """Queue a move.

        Parameters
        ----------
        target : (float, float, float)
        feed : float or None
            Units per second; None for a rapid move.
        max_rates, accelerations : sequence of float
            Of each axis, units per second (squared).
        junction_deviation : float

        Returns
        -------
        bool
            False for a move of no length, which is not queued.
        """
        offset = [b - a for a, b in zip(self._end, target, strict=True)]
        length = math.hypot(*offset)
        if length < _TINY:
            return False
        x, y, z = (step / length for step in offset)
        shares = [abs(x), abs(y), abs(z)]
        move = _Move(
            target,
            (x, y, z),
            length,
            feed,
            min(r / u for r, u in zip(max_rates, shares, strict=True) if u > 0),
            min(a / u for a, u in zip(accelerations, shares, strict=True) if u > 0),
        )
        if self._queue:
            move.corner = _corner_speed(self._queue[-1], move, junction_deviation)
        self._queue.append(move)
        self._end = target
        self.plan()
        return True

    def plan(self) -> None:
        """Speeds at the corners: what can still be braked from, what can be reached."""
        entry = 0.0
        moves = list(self._queue)
        for k in range(len(moves) - 1, 0, -1):
            move = moves[k]
            top = min(self._top(move), self._top(moves[k - 1]))
            entry = min(move.corner, top, math.sqrt(entry**2 + 2 * move.acceleration * move.length))
            move.entry = entry
        speed, length = self.speed, -self._travelled
        for before, move in pairwise(moves):
            length += before.length
            speed = math.sqrt(speed**2 + 2 * before.acceleration * max(length, 0.0))
            speed = move.entry = min(move.entry, speed)
            length = 0.0

    def stretch(self, *, holding: bool) -> float:
        """Time until the acceleration next changes, or the motion ends; 0 if it has ended."""
        return self._stretch(holding)[1]

    def advance(self, seconds: float, *, holding: bool) -> bool:
        """Move on by a time of at most :meth:`stretch`.

        Returns
        -------
        bool
            Whether the motion has ended: nothing is queued, or the hold is complete.
        """
        acceleration, whole = self._stretch(holding)
        step = min(seconds, whole)
        if self._queue:
            move = self._queue[0]
            self._travelled += step * (self.speed + acceleration * step / 2)
            self.speed = max(0.0, self.speed + acceleration * step)
            if self._travelled >= move.length - _TINY:
                self._queue.popleft()
                self._start, self._travelled = move.target, 0.0
                if self._queue and not holding:
                    self.speed = min(self.speed, self._queue[0].entry)
        if not self._queue:
            self.speed = 0.0
            return True
        if holding and self.speed < _TINY:
            self.speed = 0.0
            self.plan()
            return True
        return False

    def _stretch(self, holding: bool) -> tuple[float, float]:
        """Acceleration of this moment, and how long it stays so."""
        if not self._queue:
            return 0.0, 0.0
        move, v = self._queue[0], self.speed
        a, rest = move.acceleration, max(move.length - self._travelled, _TINY / 2)
        leave = 0.0 if len(self._queue) == 1 else self._queue[1].entry
        top = self._top(move)
        if holding:
            if v**2 <= 2 * a * rest:
                return -a, v / a
            return -a, (v - math.sqrt(v**2 - 2 * a * rest)) / a
        braking = (v**2 - leave**2) / (2 * a)
        if v > leave and rest <= braking + _TINY:
            return -a, (v - math.sqrt(max(v**2 - 2 * a * rest, 0.0))) / a
        if v > top + _TINY:
            return -a, min((v - top) / a, (v - math.sqrt(max(v**2 - 2 * a * rest, 0.0))) / a)
        if v < top - _TINY:
            way = min((top**2 - v**2) / (2 * a), (2 * a * rest + leave**2 - v**2) / (4 * a))
            way = max(min(way, rest), _TINY)
            return a, (math.sqrt(v**2 + 2 * a * way) - v) / a
        return 0.0, max(rest - braking, _TINY) / max(v, _TINY)

    def _top(self, move: _Move) -> float:
        return move.top_speed(self.feed_share, self.rapid_share)


def _corner_speed(before: _Move, after: _Move, deviation: float) -> float:
    """Speed through a corner such that a circle touching both moves strays by the deviation."""
    cosine = -sum(a * b for a, b in zip(before.direction, after.direction, strict=True))
    if cosine > 1 - 1e-6:
        return 0.0
    if cosine < -1 + 1e-6:
        return math.inf
    half = math.sqrt((1 - cosine) / 2)
    acceleration = min(before.acceleration, after.acceleration)
    return math.sqrt(acceleration * deviation * half / (1 - half))


def seek(seconds: float, *, distance: float, speed: float, acceleration: float) -> float:
    """Way covered from rest by an axis that runs at a speed until something stops it dead.

    Parameters
    ----------
    seconds : float
    distance : float
        Where it is stopped.
    speed, acceleration : float

    Returns
    -------
    float
        At most ``distance``.
    """
    ramp = speed / acceleration
    way = acceleration * seconds**2 / 2 if seconds < ramp else speed * (seconds - ramp / 2)
    return min(way, distance)


def seek_time(distance: float, *, speed: float, acceleration: float) -> float:
    """Time after which :func:`seek` has covered its distance."""
    ramp = speed / acceleration
    if distance < speed * ramp / 2:
        return math.sqrt(2 * distance / acceleration)
    return distance / speed + ramp / 2
