"""Faults on purpose: devices that fail as a script says, around any camera, projector or arm.

What goes wrong, and when, is in :mod:`devices.simulated.fault_script`. Everything that no fault
touches is passed on unchanged.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections import deque

import numpy as np

from devices.deadline import Deadline
from devices.errors import DeviceLostError, DeviceTimeoutError
from devices.interfaces import (
    ArmCapabilities,
    ArmPose,
    Camera,
    CameraCapabilities,
    Frame,
    LightArm,
    Projection,
    Projector,
    ProjectorCapabilities,
)
from devices.simulated.fault_script import (
    CameraFault,
    CameraUnplugged,
    ClockJump,
    DroppedFrame,
    LampFailure,
    LateFrame,
    Latency,
    OneLate,
    PreviousPicture,
    ProjectorDark,
    ProjectorFault,
    ProjectorUnplugged,
    RepeatedFrame,
    StaleFrame,
    Stamp,
    SwappedFrames,
    TruncatedFrame,
)

# Exposure of a frame that was buffered before the first was asked for.
_EARLY_EXPOSURE_S = 0.01


class FaultyCamera:
    """A camera that fails as scripted.

    Parameters
    ----------
    camera : Camera
        That works.
    faults : CameraFault
        Where they strike is counted in captures of this camera.
    """

    def __init__(self, camera: Camera, *faults: CameraFault) -> None:
        self._camera = camera
        self._faults = faults
        self._count = 0
        self._renumbering = 0
        self._last: Frame | None = None
        # Frames exposed already, to be delivered before any fresh one; and how they are stamped.
        self._held: deque[tuple[Frame, Stamp]] = deque()
        for fault in faults:
            if isinstance(fault, StaleFrame) and fault.at == 0:
                low, high = camera.capabilities.exposure_range_s
                frame = self._fresh(min(max(low, _EARLY_EXPOSURE_S), high), None)
                self._held.append((frame, fault.stamp))

    @property
    def capabilities(self) -> CameraCapabilities:
        """Those of the camera."""
        return self._camera.capabilities

    def capture(self, exposure_s: float, *, deadline: Deadline | None = None) -> Frame:
        """Take one frame, or do what a fault says instead.

        Raises
        ------
        DeviceError
            As the camera, or as scripted.
        """
        at, self._count = self._count, self._count + 1
        faults = [fault for fault in self._faults if fault.at == at]
        if any(isinstance(f, CameraUnplugged) and f.at <= at for f in self._faults):
            raise DeviceLostError("the camera was unplugged")
        if any(isinstance(fault, LateFrame) for fault in faults):
            self._held.append((self._fresh(exposure_s, deadline), Stamp.HONEST))
            raise DeviceTimeoutError("the camera did not deliver in time")
        frame = self._delivered(faults, exposure_s, deadline)
        for fault in faults:
            if isinstance(fault, TruncatedFrame):
                frame = dataclasses.replace(frame, image=frame.image[: -fault.rows])
        self._last = frame
        # A camera that buffers exposes the next frame as soon as this one is out.
        for fault in self._faults:
            if isinstance(fault, StaleFrame) and fault.at == at + 1:
                self._held.append((self._fresh(exposure_s, deadline), fault.stamp))
        return self._with_jumped_clocks(frame, at)

    def close(self) -> None:
        """Release the camera."""
        self._camera.close()

    def _delivered(
        self, faults: list[CameraFault], exposure_s: float, deadline: Deadline | None
    ) -> Frame:
        for fault in faults:
            if isinstance(fault, RepeatedFrame) and self._last is not None:
                if fault.stamp is Stamp.HONEST:
                    return self._last
                # One number more than frames were exposed.
                self._renumbering += 1
                return self._stamped(self._last, fault.stamp, exposure_s)
            if isinstance(fault, DroppedFrame):
                self._fresh(exposure_s, deadline)
            if isinstance(fault, SwappedFrames):
                first = self._fresh(exposure_s, deadline)
                second = self._fresh(exposure_s, deadline)
                self._held.append((first, fault.stamp))
                if fault.stamp is Stamp.HONEST:
                    return second
                return dataclasses.replace(second, sequence=first.sequence)
        if self._held:
            return self._stamped(*self._held.popleft(), exposure_s)
        return self._fresh(exposure_s, deadline)

    def _fresh(self, exposure_s: float, deadline: Deadline | None) -> Frame:
        frame = self._camera.capture(exposure_s, deadline=deadline)
        return dataclasses.replace(frame, sequence=frame.sequence + self._renumbering)

    def _stamped(self, frame: Frame, stamp: Stamp, exposure_s: float) -> Frame:
        """A frame under the number, or the number and times, that are expected next."""
        if stamp is Stamp.HONEST:
            return frame
        last = self._last
        renumbered = (
            frame if last is None else dataclasses.replace(frame, sequence=last.sequence + 1)
        )
        if stamp is Stamp.RENUMBERED:
            return renumbered
        now = time.monotonic()
        begun = now if last is None else max(now, last.monotonic_s)
        ended = max(begun, frame.monotonic_s) + exposure_s
        return dataclasses.replace(
            renumbered,
            exposure_asked_s=exposure_s,
            exposure_applied_s=exposure_s,
            monotonic_s=ended,
            wall_time=time.time() + ended - now,
        )

    def _with_jumped_clocks(self, frame: Frame, at: int) -> Frame:
        jumps = [f for f in self._faults if isinstance(f, ClockJump) and f.at <= at]
        return dataclasses.replace(
            frame,
            wall_time=frame.wall_time + sum(jump.wall_s for jump in jumps),
            monotonic_s=frame.monotonic_s + sum(jump.device_s for jump in jumps),
        )


class FaultyProjector:
    """A projector that fails as scripted.

    Parameters
    ----------
    projector : Projector
        That works.
    faults : ProjectorFault
        Where they strike is counted in calls of ``show``.
    """

    def __init__(self, projector: Projector, *faults: ProjectorFault) -> None:
        self._projector = projector
        self._faults = faults
        self._count = 0
        self._given = self._darkness()
        self._pending: list[threading.Timer] = []

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """Those of the projector."""
        return self._projector.capabilities

    def show(self, projection: Projection, *, deadline: Deadline | None = None) -> float:
        """Show a picture, or do what a fault says instead.

        Raises
        ------
        DeviceError
            As the projector, or as scripted.
        """
        self.capabilities.check_projection(projection)
        at, self._count = self._count, self._count + 1
        before, self._given = self._given, projection
        latency = 0.0
        for fault in self._faults:
            if isinstance(fault, Latency):
                latency = fault.seconds
                if not fault.declared:
                    return self._show_later(projection, latency)
            elif isinstance(fault, PreviousPicture) and fault.at == at:
                return time.monotonic()
            elif isinstance(fault, OneLate) and fault.at <= at:
                projection = before
            elif isinstance(fault, ProjectorDark) and fault.at <= at:
                projection = self._darkness()
            elif isinstance(fault, ProjectorUnplugged) and fault.at <= at:
                raise DeviceLostError("the projector was unplugged")
        since_s = self._projector.show(projection, deadline=deadline)
        time.sleep(latency)
        return since_s + latency

    def blank(self) -> None:
        """Put the light out."""
        self._given = self._darkness()
        self._forget_pending()
        self._projector.blank()

    def close(self) -> None:
        """Release the projector."""
        self._forget_pending()
        self._projector.close()

    def _show_later(self, projection: Projection, seconds: float) -> float:
        timer = threading.Timer(seconds, self._projector.show, (projection,))
        timer.daemon = True
        self._pending.append(timer)
        timer.start()
        return time.monotonic()

    def _forget_pending(self) -> None:
        for timer in self._pending:
            timer.cancel()
            timer.join()
        self._pending.clear()

    def _darkness(self) -> Projection:
        width, height = self.capabilities.size
        return Projection("darkness", np.zeros((height, width), np.uint8))


class FaultyArm:
    """A light arm whose lamp fails as scripted.

    Parameters
    ----------
    arm : LightArm
        That works.
    faults : LampFailure
        Where they strike is counted in times that the lamp was switched on.
    """

    def __init__(self, arm: LightArm, *faults: LampFailure) -> None:
        self._arm = arm
        self._faults = faults
        self._count = 0
        self._claims_light = False

    @property
    def capabilities(self) -> ArmCapabilities:
        """Those of the arm."""
        return self._arm.capabilities

    @property
    def pose(self) -> ArmPose | None:
        """Where the arm stands."""
        return self._arm.pose

    @property
    def lamp_on(self) -> bool:
        """Whether the lamp was last switched on."""
        return self._claims_light or self._arm.lamp_on

    def home(self, *, deadline: Deadline | None = None) -> None:
        """Find the zero of both axes."""
        self._claims_light = False
        self._arm.home(deadline=deadline)

    def move_to(self, pose: ArmPose, *, deadline: Deadline | None = None) -> None:
        """Put the lamp out, and move."""
        self._arm.move_to(pose, deadline=deadline)
        self._claims_light = False

    def switch_lamp(self, on: bool) -> float:
        """Switch the lamp, or only say so."""
        if not on:
            self._claims_light = False
            return self._arm.switch_lamp(False)
        at, self._count = self._count, self._count + 1
        if any(fault.at <= at for fault in self._faults):
            self._claims_light = True
            return self._arm.switch_lamp(False)
        return self._arm.switch_lamp(True)

    def stop(self) -> None:
        """Stop motion and put the lamp out."""
        self._claims_light = False
        self._arm.stop()

    def close(self) -> None:
        """Stop, and release the arm."""
        self._claims_light = False
        self._arm.close()
