"""The machine under a simulated GRBL controller: axes, end switches, outputs, door.

What truly happens is kept apart from what the controller counts: they agree after homing, and part
again when steps are lost. A timeline holds the truth for tests to judge.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from devices.simulated.grbl_memory import Settings
from devices.simulated.grbl_motion import Planner, Vector, seek, seek_time

_SAMPLE_S = 0.05
# What an axis can do beyond its switch before it stands at the frame.
_OVERTRAVEL = 2.0
# Way that the arm runs on when the steppers are cut: this long at the speed of that moment.
_SLIP_S = 0.01
# Motion already handed to the steppers, which a hold cannot take back.
_PREPARED_S = 0.05


@dataclass(frozen=True)
class Moment:
    """What was so from a time on.

    Attributes
    ----------
    time_s : float
        Of the controller's clock.
    place : (float, float, float)
        True place of the axes: coordinates of a machine that was homed properly.
    moving, lamp_on, homing : bool
    """

    time_s: float
    place: Vector
    moving: bool
    lamp_on: bool
    homing: bool


@dataclass(frozen=True)
class _HomingPhase:
    """Axes that run until their switch closes, or by a distance; independent of one another."""

    start_s: float
    origin: Vector
    directions: Mapping[int, float]
    distances: Mapping[int, float]
    speed: float
    acceleration: float
    seeks: bool

    @property
    def end_s(self) -> float:
        times = (self._time(distance) for distance in self.distances.values())
        return self.start_s + max(times, default=0.0)

    def place(self, now_s: float) -> Vector:
        x, y, z = (
            start + self.directions.get(axis, 0.0) * self._way(now_s, self.distances.get(axis, 0.0))
            for axis, start in enumerate(self.origin)
        )
        return x, y, z

    def _time(self, distance: float) -> float:
        if self.seeks:
            return seek_time(distance, speed=self.speed, acceleration=self.acceleration)
        return 2 * seek_time(distance / 2, speed=self.speed, acceleration=self.acceleration)

    def _way(self, now_s: float, distance: float) -> float:
        elapsed, whole = now_s - self.start_s, self._time(distance)
        stop = distance if self.seeks else distance / 2
        late = not self.seeks and elapsed > whole / 2
        way = seek(
            max(whole - elapsed, 0.0) if late else elapsed,
            distance=stop,
            speed=self.speed,
            acceleration=self.acceleration,
        )
        return distance - way if late else way


class Machine:
    """Axes, outputs and inputs.

    Parameters
    ----------
    settings : Settings
    active_inputs : str
        Letters of inputs that read active whatever happens.
    origin_by_homing : bool
        Whether homing makes its end the origin.
    lamp_outputs : str
        Letters of the outputs that light the lamp.
    """

    def __init__(
        self, settings: Settings, *, active_inputs: str, origin_by_homing: bool, lamp_outputs: str
    ) -> None:
        self._settings = settings
        self._active_inputs = active_inputs
        self._origin_by_homing = origin_by_homing
        self._lamp_outputs = set(lamp_outputs)
        self._offset: Vector = (0.0, 0.0, 0.0)
        self._homing: _HomingPhase | None = None
        self._spindle, self._coolant = "", frozenset[str]()
        self.planner = Planner()
        self.now_s = 0.0
        self.stepping = False
        self._hold_s = math.inf
        self.lamp_stuck = False
        self.door_open = False
        self.timeline: list[Moment] = []

    @property
    def place(self) -> Vector:
        """Where the axes truly stand."""
        if self._homing is not None:
            return self._homing.place(self.now_s)
        x, y, z = (a + b for a, b in zip(self.planner.position, self._offset, strict=True))
        return x, y, z

    @property
    def moving(self) -> bool:
        """Whether anything moves."""
        return self.stepping or self._homing is not None

    @property
    def holding(self) -> bool:
        """Whether a hold was asked for; it begins to work a moment later."""
        return self._hold_s < math.inf

    @property
    def outputs(self) -> str:
        """Letters of the outputs that are on."""
        return self._spindle + "".join(sorted(self._coolant))

    @property
    def lamp_on(self) -> bool:
        """Whether the lamp is lit."""
        return bool(self._lamp_outputs & set(self.outputs))

    @property
    def inputs(self) -> str:
        """Letters of the inputs that are active, in the order of reports."""
        closed = {"XYZ"[axis] for axis in self.closed_switches()}
        door = {"D"} if self.door_open else set()
        return "".join(k for k in "PXYZDRHS" if k in closed | door | set(self._active_inputs))

    def switch(self, axis: int) -> float:
        """True place of an axis's end switch."""
        low, high = self.travel(axis)
        at_low_end = self._homes_down(axis)
        if self._origin_by_homing:
            return (low if at_low_end else high) + (-1 if at_low_end else 1) * self._settings[27]
        return low if at_low_end else high

    def travel(self, axis: int) -> tuple[float, float]:
        """Least and largest coordinate that soft limits allow."""
        span = self._settings[130 + axis]
        if self._origin_by_homing and self._homes_down(axis):
            return 0.0, span
        return -span, 0.0

    def closed_switches(self) -> set[int]:
        """Axes whose end switch is closed."""
        closed = {"XYZ".index(letter) for letter in self._active_inputs if letter in "XYZ"}
        for axis in range(2):
            beyond = self.place[axis] - self.switch(axis)
            if (-beyond if self._homes_down(axis) else beyond) >= 0:
                closed.add(axis)
        return closed

    def set_spindle(self, letter: str) -> None:
        """Spindle output: ``S``, ``C`` or off."""
        if not self.lamp_stuck and letter != self._spindle:
            self._spindle = letter
            self._record()

    def set_coolant(self, letters: frozenset[str]) -> None:
        """Coolant outputs: ``F``, ``M``."""
        if not self.lamp_stuck and letters != self._coolant:
            self._coolant = letters
            self._record()

    def put(self, place: Vector) -> None:
        """Have the axes stand at a true place, counted as zero."""
        self.planner.place((0.0, 0.0, 0.0))
        self._offset = place
        self._record()

    def hits_switch(self) -> bool:
        """Whether a motion that is not homing has just run into an end switch that guards it."""
        return bool(self._settings[21] and self.stepping and self.closed_switches())

    def start(self) -> None:
        """Start the steppers."""
        self.stepping, self._hold_s = True, math.inf
        self._record()

    def hold(self) -> None:
        """Slow down to a stand."""
        self._hold_s = min(self._hold_s, self.now_s + _PREPARED_S)

    def end_hold(self) -> None:
        """Forget a hold, once everything stands."""
        self._hold_s = math.inf

    def next_change_s(self) -> float:
        """Time until the motion changes, or is next sampled; infinite at rest."""
        wait = math.inf
        if self._homing is not None:
            wait = min(max(self._homing.end_s - self.now_s, 0.0), _SAMPLE_S)
        if self.stepping:
            wait = min(wait, self.planner.stretch(holding=self._slows), _SAMPLE_S)
            if self.holding and not self._slows:
                wait = min(wait, self._hold_s - self.now_s)
        return wait

    def move(self, seconds: float) -> bool:
        """Let time pass; whether queued motion, or a hold, came to its end."""
        slows = self._slows
        self.now_s += seconds
        ended = self.stepping and self.planner.advance(seconds, holding=slows)
        if ended:
            self.stepping = False
            self._record()
        elif self.moving:
            self._record()
        return ended

    def cut(self) -> None:
        """Cut the steppers: what moved runs on a little, uncounted."""
        if self._homing is not None:
            self.end_homing_phase()
        elif self.stepping:
            slip = [_SLIP_S * speed for speed in self.planner.velocity]
            self.planner.place(self.planner.position)
            self._shift(slip)
        self.stepping, self._hold_s = False, math.inf
        self._record()

    def forget_position(self) -> None:
        """Power fails: the controller counts from zero where the arm stands."""
        self.put(self.place)

    def start_homing_phase(self, axes: tuple[int, ...], *, approach: bool, first: bool) -> bool:
        """Start a phase of a homing cycle.

        Returns
        -------
        bool
            Whether it will end where it should: at the switches, or clear of them.
        """
        settings = self._settings
        pull_off = settings[27]
        reach = 5 * pull_off
        if first:
            reach = 1.5 * max(settings[130 + axis] for axis in axes)
        stuck = {"XYZ".index(letter) for letter in self._active_inputs if letter in "XYZ"}
        down = {axis: -1.0 if self._homes_down(axis) else 1.0 for axis in axes}
        place, fine = self.place, True
        distances = dict.fromkeys(axes, pull_off)
        if approach:
            for axis in axes:
                way = 0.0 if axis in stuck else (self.switch(axis) - place[axis]) * down[axis]
                if axis == 2 and axis not in stuck:
                    way = math.inf  # there is no third axis, nor its switch
                fine &= way <= reach
                distances[axis] = min(max(way, 0.0), reach)
        else:
            fine = not stuck & set(axes)
        counts = list(self.planner.position)
        for axis in axes:
            counts[axis] = 0.0
        self._count(counts)
        self._homing = _HomingPhase(
            start_s=self.now_s,
            origin=place,
            directions={axis: down[axis] * (1 if approach else -1) for axis in axes},
            distances=distances,
            speed=settings[24 if approach and not first else 25] / 60,
            acceleration=min(settings[120 + axis] for axis in axes),
            seeks=approach,
        )
        self._record()
        return fine

    @property
    def homing_phase_ends_s(self) -> float:
        """When the phase that runs ends."""
        return self._homing.end_s if self._homing is not None else self.now_s

    def end_homing_phase(self) -> None:
        """Stop the axes that home where they are; they are counted from where they began."""
        if self._homing is None:
            return
        place, origin = self._homing.place(self.now_s), self._homing.origin
        self._homing = None
        counts = [
            count + there - here
            for count, there, here in zip(self.planner.position, place, origin, strict=True)
        ]
        x, y, z = counts
        self.planner.place((x, y, z))
        self._record()

    def found_home(self, axes: tuple[int, ...]) -> None:
        """Set the counts of axes that have just been homed."""
        counts = list(self.planner.position)
        for axis in axes:
            if self._origin_by_homing:
                counts[axis] = 0.0
            else:
                way = self._settings[27] * (1 if self._homes_down(axis) else -1)
                low, high = self.travel(axis)
                counts[axis] = (low if self._homes_down(axis) else high) + way
        self._count(counts)

    def _count(self, counts: list[float]) -> None:
        """Change what the controller counts, without moving anything."""
        place = self.place
        x, y, z = counts
        self.planner.place((x, y, z))
        a, b, c = (true - count for true, count in zip(place, counts, strict=True))
        self._offset = (a, b, c)

    def _shift(self, way: list[float]) -> None:
        """Move truly without being counted, up to the frame."""
        shifted = []
        for axis, (offset, step) in enumerate(zip(self._offset, way, strict=True)):
            count = self.planner.position[axis]
            low, high = self.travel(axis)
            here = offset + count
            low, high = min(low - _OVERTRAVEL, here), max(high + _OVERTRAVEL, here)
            shifted.append(min(max(here + step, low), high) - count)
        x, y, z = shifted
        self._offset = (x, y, z)

    @property
    def _slows(self) -> bool:
        return self.now_s >= self._hold_s - 1e-9

    def _homes_down(self, axis: int) -> bool:
        return bool(int(self._settings[23]) >> axis & 1)

    def _record(self) -> None:
        moment = Moment(self.now_s, self.place, self.moving, self.lamp_on, self._homing is not None)
        self.timeline.append(moment)
