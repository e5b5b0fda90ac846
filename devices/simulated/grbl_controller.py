"""A GRBL 1.1h controller as a state machine, with the light arm that hangs on it.

Time is the caller's: any clock that rises can drive it, in steps of any size, since motion between
events is exact. What really happens to the arm (its true angles, whether it moves, whether its lamp
is lit) is kept apart from what the controller believes, on a timeline for tests to judge.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass

from devices.interfaces import ArmPose
from devices.simulated.grbl_firmware import Firmware
from devices.simulated.grbl_machine import Machine, Moment
from devices.simulated.grbl_memory import ARM_SETTINGS, Settings
from devices.simulated.grbl_motion import Vector
from devices.simulated.grbl_state import Build, State

# Shortest step of time; what is left of a stretch of motion after rounding is shorter.
_TICK_S = 1e-6


@dataclass(frozen=True, kw_only=True)
class Mounting:
    """How the arm's angles follow from its axes X and Y.

    Attributes
    ----------
    degrees_at_switch, degrees_per_unit : (float, float)
        Of azimuth and elevation.
    """

    degrees_at_switch: tuple[float, float] = (0.0, 0.0)
    degrees_per_unit: tuple[float, float] = (1.0, 1.0)


class SimulatedGrblController:
    """The controller and its arm; safe to ask from any thread.

    Parameters
    ----------
    settings : mapping of int to float, optional
        ``$n`` to value; by default, those of a light arm.
    build : Build, optional
    mounting : Mounting, optional
    lamp_outputs : str
        Letters of the outputs that light the lamp: S and C spindle, F flood, M mist.
    place : (float, float, float), optional
        Where the axes truly stand when power comes; by default, in the middle of their travel.
    """

    def __init__(
        self,
        settings: Mapping[int, float] = ARM_SETTINGS,
        *,
        build: Build | None = None,
        mounting: Mounting | None = None,
        lamp_outputs: str = "SCFM",
        place: Vector | None = None,
    ) -> None:
        self._lock = threading.RLock()
        self._mounting = mounting or Mounting()
        build = build or Build()
        stored = Settings(settings)
        self._machine = Machine(
            stored,
            active_inputs=build.active_inputs,
            origin_by_homing="Z" in build.options,
            lamp_outputs=lamp_outputs,
        )
        if place is None:
            middles = [sum(self._machine.travel(axis)) / 2 for axis in range(2)]
            place = (middles[0], middles[1], 0.0)
        self._machine.put(place)
        self._firmware = Firmware(self._machine, stored, build)

    @property
    def pose(self) -> ArmPose:
        """Where the arm truly stands."""
        with self._lock:
            return self.pose_at(self._machine.place)

    @property
    def lamp_on(self) -> bool:
        """Whether the lamp is lit."""
        with self._lock:
            return self._machine.lamp_on

    @property
    def moving(self) -> bool:
        """Whether the arm truly moves."""
        with self._lock:
            return self._machine.moving

    @property
    def state(self) -> State:
        """Of the firmware."""
        with self._lock:
            return self._firmware.state

    @property
    def now_s(self) -> float:
        """The controller's time."""
        with self._lock:
            return self._machine.now_s

    @property
    def timeline(self) -> list[Moment]:
        """Every change so far, and samples of every motion."""
        with self._lock:
            return list(self._machine.timeline)

    def pose_at(self, place: Vector) -> ArmPose:
        """Angles of the arm at a true place of its axes."""
        azimuth, elevation = (
            math.radians(
                self._mounting.degrees_at_switch[axis]
                + self._mounting.degrees_per_unit[axis] * (place[axis] - self._machine.switch(axis))
            )
            for axis in range(2)
        )
        return ArmPose(azimuth, elevation)

    def advance(self, now_s: float) -> None:
        """Let time pass until ``now_s``; harmless if that is past."""
        machine, firmware = self._machine, self._firmware
        with self._lock:
            firmware.turn()
            while machine.now_s < now_s:
                step = min(now_s - machine.now_s, max(self._next_change(), _TICK_S))
                if machine.move(step):
                    firmware.motion_ended()
                if machine.hits_switch():
                    firmware.kill(1)
                firmware.turn()

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""
        with self._lock:
            for byte in data:
                self._firmware.receive(byte)

    def replies(self) -> list[str]:
        """Lines that it has said since last asked, without line ends."""
        with self._lock:
            said = list(self._firmware.replies)
            self._firmware.replies.clear()
            return said

    def next_change_s(self) -> float:
        """Time at which something may happen without a byte from the host; infinite if nothing."""
        with self._lock:
            return self._machine.now_s + self._next_change()

    def power_cycle(self) -> None:
        """Power fails and comes back, or the board's reset line is pulled."""
        with self._lock:
            self._machine.cut()
            self._firmware.power_up()

    def trip_alarm(self, code: int) -> None:
        """Something stops the machine dead, as an end switch (1) does."""
        with self._lock:
            self._firmware.kill(code)
            self._firmware.turn()

    def open_door(self) -> None:
        """Open the safety door."""
        with self._lock:
            self._machine.door_open = True
            self._firmware.open_door()

    def close_door(self) -> None:
        """Close the safety door."""
        with self._lock:
            self._machine.door_open = False
            self._firmware.turn()

    def stick_lamp(self) -> None:
        """From now on the outputs stay as they are, whatever they are told."""
        with self._lock:
            self._machine.lamp_stuck = True

    def _next_change(self) -> float:
        waking = max(self._firmware.wake_s - self._machine.now_s, 0.0)
        return min(waking, self._machine.next_change_s())
