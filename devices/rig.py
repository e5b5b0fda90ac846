"""The rig: camera, projector, light arm and camera mount as one, safe on every way out.

What the rig shows and where its light stands is remembered here, so that each frame carries what it
is a picture of, and every frame is held against that (:mod:`devices.frame_order`).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType

import numpy as np

from devices.deadline import Deadline
from devices.errors import DeviceError, FrameOrderError
from devices.frame_order import FrameOrder, differ_beyond_noise
from devices.interfaces import (
    ArmPose,
    Camera,
    CameraMount,
    Frame,
    LightArm,
    Projection,
    Projector,
    Subject,
)


class Rig:
    """A camera, and what lights its scene; a context manager that leaves everything dark and still.

    Parameters
    ----------
    camera : Camera
    projector : Projector, optional
    arm : LightArm, optional
    mount : CameraMount, optional
    toml : str
        Description of the rig in force, for sessions; empty if there is none.
    source : str
        Kept in plans: ``"rig"`` or ``"simulation"``.
    """

    def __init__(
        self,
        camera: Camera,
        projector: Projector | None = None,
        arm: LightArm | None = None,
        mount: CameraMount | None = None,
        *,
        toml: str = "",
        source: str = "rig",
    ) -> None:
        self.camera = camera
        self._projector = projector
        self._arm = arm
        self._mount = mount
        self.toml = toml
        self.source = source
        self._showing: Projection | None = None
        self._since_s = time.monotonic()
        self._order = FrameOrder()

    @property
    def projector(self) -> Projector:
        """The projector.

        Raises
        ------
        DeviceError
            The rig has none.
        """
        if self._projector is None:
            raise DeviceError("this rig has no projector; add a [projector] table to rig.toml")
        return self._projector

    @property
    def arm(self) -> LightArm:
        """The light arm.

        Raises
        ------
        DeviceError
            The rig has none.
        """
        if self._arm is None:
            raise DeviceError("this rig has no light arm; add an [arm] table to rig.toml")
        return self._arm

    @property
    def has_arm(self) -> bool:
        """Whether there is a light arm."""
        return self._arm is not None

    @property
    def camera_positions(self) -> tuple[str, ...]:
        """Names of the places where the camera can stand; empty if it has just one."""
        return self._mount.positions if self._mount is not None else ()

    @property
    def subject(self) -> Subject:
        """What a frame taken now would be a picture of."""
        arm = self._arm
        return Subject(
            projection=self._showing.name if self._showing is not None else None,
            arm_pose=arm.pose if arm is not None else None,
            lamp_on=arm.lamp_on if arm is not None else False,
            camera_position=self._mount.position if self._mount is not None else None,
        )

    def begin_recording(self) -> None:
        """Forget earlier frames: the camera may have been used, or started anew, since then."""
        self._order = FrameOrder()

    def show(self, projection: Projection) -> None:
        """Show a picture; from then on frames are of it."""
        self._showing = None
        self._since_s = max(self._since_s, self.projector.show(projection))
        self._showing = projection

    def blank(self) -> None:
        """Put the projector's light out, if there is a projector."""
        if self._projector is not None:
            self._projector.blank()
        self._showing = None
        self._since_s = time.monotonic()

    def move_light(self, pose: ArmPose) -> None:
        """Move the light arm, with its lamp out."""
        self.arm.move_to(pose)
        self._since_s = time.monotonic()

    def switch_lamp(self, on: bool) -> None:
        """Switch the arm's lamp."""
        self._since_s = max(self._since_s, self.arm.switch_lamp(on))

    def place_camera(self, position: str) -> None:
        """Have the camera stand at one of :attr:`camera_positions`; everything is dark meanwhile.

        Raises
        ------
        DeviceError
            The rig has no such place.
        """
        if self._mount is None:
            raise DeviceError(
                f"this rig has no camera position {position!r}; name its positions in rig.toml"
            )
        self._mount.place(position)
        self._since_s = time.monotonic()

    def capture(self, exposure_s: float, *, deadline: Deadline | None = None) -> Frame:
        """Take a frame of what is lit now, and make sure that it is.

        Where the picture shows no change though the projector was told to make one, the inverse is
        shown and taken too: patterns can be alike on the part of the panel that the camera sees.

        Raises
        ------
        DeviceError
            As :meth:`~devices.interfaces.Camera.capture`; a
            :class:`~devices.errors.FrameOrderError` if the frame is not of its subject.
        """
        frame, changed = self._capture(exposure_s, deadline)
        if changed:
            return frame
        if self._showing is None:
            raise FrameOrderError(
                f"frame of {frame.subject} differs from the one before it by nothing but noise; "
                "the light did not change, so look at projector and lamp, and resume"
            )
        return self._verify(frame, self._showing, exposure_s)

    def make_safe(self) -> None:
        """Stop motion and put every light out; goes on to the next device if one fails.

        Raises
        ------
        DeviceError
            Of the last device that failed; every device was told all the same.
        """
        with ExitStack() as every:
            for action in self._safe_actions():
                every.callback(action)
        self._showing = None

    def close(self) -> None:
        """Make everything safe and release every device, whatever fails on the way."""
        with ExitStack() as every:
            every.callback(self.camera.close)
            if self._projector is not None:
                every.callback(self._projector.close)
            if self._arm is not None:
                every.callback(self._arm.close)
            for action in self._safe_actions():
                every.callback(action)

    def __enter__(self) -> Rig:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _safe_actions(self) -> list[Callable[[], None]]:
        """What makes the rig safe; called last to first."""
        actions: list[Callable[[], None]] = []
        if self._projector is not None:
            actions.append(self._projector.blank)
        if self._arm is not None:
            actions.append(self._arm.stop)
        return actions

    def _capture(self, exposure_s: float, deadline: Deadline | None) -> tuple[Frame, bool]:
        frame = self.camera.capture(exposure_s, deadline=deadline)
        frame = dataclasses.replace(frame, subject=self.subject)
        return frame, self._order.check(frame, subject_since_s=self._since_s)

    def _verify(self, frame: Frame, projection: Projection, exposure_s: float) -> Frame:
        """Take a frame again after its inverse, which must show the light changing twice."""
        inverse = Projection(f"inverse of {projection.name}", np.uint8(255) - projection.image)
        self.show(inverse)
        _, away = self._capture(exposure_s, None)
        self.show(projection)
        again, back = self._capture(exposure_s, None)
        if not (away and back):
            raise FrameOrderError(
                f"frame of {frame.subject} does not differ from its inverse: the projector does "
                "not light the scene, or shows something else"
            )
        if differ_beyond_noise(again.image, frame.image):
            raise FrameOrderError(
                f"frame of {frame.subject} showed the picture before it: the projector is slower "
                "than it says; raise its latency in rig.toml and resume"
            )
        return again
