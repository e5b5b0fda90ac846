"""The light arm of a simulated scene, without a controller between.

Where the arm mechanically is and where it believes to be are two things, as with a real one: only
homing joins them.
"""

from __future__ import annotations

import threading
import time

from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceTimeoutError
from devices.interfaces import ArmCapabilities, ArmLimits, ArmPose

_TICK_S = 0.01


class ArmMechanism:
    """Where the axes truly stand, and whether the lamp is lit.

    Attributes
    ----------
    pose : ArmPose
    lamp_on : bool
    """

    def __init__(self, pose: ArmPose) -> None:
        self.pose: ArmPose | None = pose
        self.lamp_on = False


class SimulatedLightArm:
    """A light arm that moves a mechanism at constant speed.

    Parameters
    ----------
    mechanism : ArmMechanism
        What it moves.
    limits : ArmLimits
        Its end switches are at the lower ends.
    speed : float
        Of either axis, rad/s.
    real_time : bool
        Whether moves take the time they would; if not, they are over at once.
    """

    def __init__(
        self,
        mechanism: ArmMechanism,
        *,
        limits: ArmLimits,
        speed: float = 0.5,
        real_time: bool = False,
    ) -> None:
        self._mechanism = mechanism
        self._limits = limits
        self._speed = speed
        self._real_time = real_time
        self._trusted = False
        self._moving = False
        self._closed = False
        self._stop = threading.Event()

    @property
    def capabilities(self) -> ArmCapabilities:
        """What the arm is."""
        return ArmCapabilities("simulated light arm", self._limits, self._speed)

    @property
    def pose(self) -> ArmPose | None:
        """Where it stands; None before homing, and after a stop in the middle of it."""
        return self._mechanism.pose if self._trusted else None

    @property
    def lamp_on(self) -> bool:
        """Whether the lamp is lit."""
        return self._mechanism.lamp_on

    def home(self, *, deadline: Deadline | None = None) -> None:
        """Drive both axes to their end switches, with the lamp out.

        Raises
        ------
        DeviceError
            The arm is closed, was stopped, or was not there by the deadline.
        """
        self._check_open()
        self._trusted = False
        self._drive(ArmPose(self._limits.azimuth[0], self._limits.elevation[0]), deadline)
        self._trusted = True

    def move_to(self, pose: ArmPose, *, deadline: Deadline | None = None) -> None:
        """Put the lamp out and move.

        Raises
        ------
        DeviceError
            The arm is closed, its position not trusted, the pose outside its limits, or it was
            stopped or not there by the deadline; then it stands where it came to.
        """
        self._check_open()
        if not self._trusted:
            raise DeviceError("the simulated light arm does not know where it is; home it first")
        self._limits.check(pose)
        self._drive(pose, deadline)

    def switch_lamp(self, on: bool) -> float:
        """Switch the lamp.

        Raises
        ------
        DeviceError
            The arm is closed, or moving.
        """
        self._check_open()
        if self._moving and on:
            raise DeviceError("the lamp stays out while the simulated light arm moves")
        self._mechanism.lamp_on = on
        return time.monotonic()

    def stop(self) -> None:
        """Stop motion and put the lamp out."""
        self._stop.set()
        self._mechanism.lamp_on = False

    def close(self) -> None:
        """Stop, and take no more orders."""
        self.stop()
        self._closed = True

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceError("the simulated light arm is closed")

    def _drive(self, target: ArmPose, deadline: Deadline | None) -> None:
        start = self._mechanism.pose
        assert start is not None  # an in-process mechanism always stands somewhere
        self._mechanism.lamp_on = False
        self._stop.clear()
        way = target.azimuth - start.azimuth, target.elevation - start.elevation
        needed_s = max(abs(part) for part in way) / self._speed
        allowed_s = needed_s if deadline is None else min(needed_s, deadline.remaining_s)
        self._moving = True
        try:
            driven_s = self._wait(allowed_s) if self._real_time else allowed_s
            share = 1.0 if driven_s >= needed_s else driven_s / needed_s
            self._mechanism.pose = (
                target
                if share == 1.0
                else ArmPose(start.azimuth + share * way[0], start.elevation + share * way[1])
            )
        finally:
            self._moving = False
        if share < 1.0:
            where = f"{self._mechanism.pose} on its way to {target}"
            if self._stop.is_set():
                raise DeviceError(f"the simulated light arm was stopped at {where}")
            raise DeviceTimeoutError(f"the simulated light arm came only to {where} in time")

    def _wait(self, seconds: float) -> float:
        """Wait for the motion, unless it is stopped; returns how long it went on."""
        began = time.monotonic()
        while (gone := time.monotonic() - began) < seconds:
            if self._stop.wait(min(_TICK_S, seconds - gone)):
                return time.monotonic() - began
        return seconds
