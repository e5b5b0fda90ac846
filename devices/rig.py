"""The rig: camera, projector, light arm and camera mount as one, safe on every way out.

What the rig shows and where its light stands is remembered here, so that each frame carries what it
is a picture of, and every frame is held against that (:mod:`devices.frame_order`). Where a picture
does not tell whether the light followed, the light is changed and changed back, which must show.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from types import TracebackType

import numpy as np

from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceLostError, DeviceTimeoutError, FrameOrderError
from devices.frame_order import FrameOrder, Light, check_request, differ_beyond_noise
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
from devices.light_proof import counterpart, telling_exposures
from devices.way_out import afterwards, do_all


class Rig:
    """A camera, and what lights its scene; a context manager that leaves everything dark and still.

    Parameters
    ----------
    camera : Camera, optional
    projector : Projector, optional
    arm : LightArm, optional
    mount : CameraMount, optional
    toml : str
        Description of the rig in force, for sessions; empty if there is none.
    source : str
        Kept in plans: ``"rig"`` or ``"simulation"``.
    prove_light : bool
        Whether the light is proven where a frame does not tell if it changed. Recorded frames went
        through that when they were taken, and a recording holds nothing that it could be done with.
    """

    def __init__(
        self,
        camera: Camera | None = None,
        projector: Projector | None = None,
        arm: LightArm | None = None,
        mount: CameraMount | None = None,
        *,
        toml: str = "",
        source: str = "rig",
        prove_light: bool = True,
    ) -> None:
        self._camera = camera
        self._projector = projector
        self._arm = arm
        self._mount = mount
        self.toml = toml
        self.source = source
        self._prove_light = prove_light
        self._showing: Projection | None = None
        # The darkest and the brightest picture shown, for projectors that show only what they hold.
        self._shown: tuple[Projection, ...] = ()
        self._since_s = time.monotonic()
        self._order: FrameOrder | None = None

    @property
    def camera(self) -> Camera:
        """The camera.

        Raises
        ------
        DeviceError
            The rig has none.
        """
        if self._camera is None:
            raise DeviceError("this rig has no camera; add a [camera] table to rig.toml")
        return self._camera

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
    def has_projector(self) -> bool:
        """Whether there is a projector."""
        return self._projector is not None

    @property
    def has_arm(self) -> bool:
        """Whether there is a light arm."""
        return self._arm is not None

    @property
    def mount(self) -> CameraMount:
        """The camera's mount.

        Raises
        ------
        DeviceError
            The rig has none.
        """
        if self._mount is None:
            raise DeviceError("this rig has no camera mount; add a [mount] table to rig.toml")
        return self._mount

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
        self._order = None

    def show(self, projection: Projection) -> None:
        """Show a picture; from then on frames are of it."""
        self._showing = None
        self._since_s = max(self._since_s, self.projector.show(projection))
        self._showing = projection
        shown = sorted((*self._shown, projection), key=lambda picture: float(picture.image.mean()))
        self._shown = tuple({picture.digest: picture for picture in (shown[0], shown[-1])}.values())

    def blank(self) -> None:
        """Put the projector's light out, if there is a projector."""
        self._showing = None
        if self._projector is not None:
            self._projector.blank()
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
        self.blank()
        if self._arm is not None and self._arm.lamp_on:
            self._arm.switch_lamp(False)
        self._mount.place(position)
        self._since_s = time.monotonic()

    def capture(self, exposure_s: float, *, deadline: Deadline | None = None) -> Frame:
        """Take a frame of what is lit now, and make sure that it is.

        Where the picture does not show that the light followed what it was told, the light is
        changed and changed back, and the frame held against another one: patterns can be alike on
        the part of the panel that the camera sees. That is done for the first light of a recording
        too.

        Parameters
        ----------
        exposure_s : float
            Exposure asked for.
        deadline : Deadline, optional
            When every frame that this takes must be there; by default, what the camera allows each.

        Raises
        ------
        DeviceError
            As :meth:`~devices.interfaces.Camera.capture`, or the frame has not the camera's size;
            a :class:`~devices.errors.FrameOrderError` if it is not of its subject.
        """
        frame, told = self._capture(exposure_s, deadline)
        if self._prove_light and not told:
            self._prove(frame, exposure_s, deadline)
        return frame

    def make_safe(self) -> None:
        """Stop motion and put every light out; goes on to the next device if one fails.

        Raises
        ------
        DeviceError
            Of the first device that failed, with those of others as notes; every device was told
            all the same.
        """
        self._showing = None
        do_all(*self._safe_actions())

    def close(self) -> None:
        """Make everything safe and release every device, whatever fails on the way.

        Raises
        ------
        DeviceError
            As :meth:`make_safe`.
        """
        devices = (self._arm, self._projector, self._camera)
        do_all(*self._safe_actions(), *(device.close for device in devices if device is not None))

    def __enter__(self) -> Rig:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with afterwards(self.close):
            # What ended the block is told before what closing met.
            if error is not None:
                raise error

    def _safe_actions(self) -> list[Callable[[], None]]:
        """What makes the rig safe: motion and lamp first."""
        actions: list[Callable[[], None]] = []
        if self._arm is not None:
            actions.append(self._arm.stop)
        if self._projector is not None:
            actions.append(self._projector.blank)
        return actions

    @property
    def _light(self) -> Light:
        """The light that the scene is under, as far as the rig knows."""
        subject, showing = self.subject, self._showing
        return Light(
            projection=showing.digest if showing is not None and showing.image.any() else None,
            lamp_on=subject.lamp_on,
            lamp_pose=subject.arm_pose if subject.lamp_on else None,
            camera_position=subject.camera_position,
        )

    def _capture(self, exposure_s: float, deadline: Deadline | None) -> tuple[Frame, bool]:
        """Take a frame; also whether it tells that its light is there."""
        camera = self.camera
        asked_s = time.monotonic()
        frame = camera.capture(exposure_s, deadline=deadline)
        delivered_s = time.monotonic()
        frame = dataclasses.replace(frame, subject=self.subject)
        check_request(frame, exposure_s, camera.capabilities)
        if self._order is None:
            self._order = FrameOrder(saturation_level=camera.capabilities.saturation_level)
        told = self._order.check(
            frame,
            light=self._light,
            subject_since_s=max(self._since_s, asked_s),
            delivered_s=delivered_s,
        )
        return frame, told

    def _prove(self, frame: Frame, exposure_s: float, deadline: Deadline | None) -> None:
        """Have the light seen to go and to come back as it was when a frame was taken.

        The frame itself stays the one that counts, so that a recording is the same wherever it was
        cut off and resumed.
        """
        order = self._order
        assert order is not None
        lamp_before = order.light_before is not None and order.light_before.lamp_on
        if self._showing is not None and not order.knows_darkness(self._light.camera_position):
            self._take_darkness(self._showing, exposure_s, deadline)
        for exposure in telling_exposures(frame, exposure_s, self.camera.capabilities):
            changes = self._changes_of_light(exposure, lamp_before=lamp_before, deadline=deadline)
            again = next((back for away, back in changes if self._differ(away, back)), None)
            if again is not None:
                break
        else:
            raise FrameOrderError(
                f"frame of {frame.subject} stays as it is when the light changes: it does not "
                "reach the scene, or the device shows something else than it was told; look at "
                "projector and lamp, and resume"
            )
        if again.exposure_asked_s != exposure_s:
            again, _ = self._capture(exposure_s, deadline)
        if self._differ(again, frame):
            raise FrameOrderError(
                f"frame of {frame.subject} showed the light before it: the device is slower than "
                "it says; raise its latency in rig.toml and resume"
            )
        order.accept_light()

    def _take_darkness(
        self, showing: Projection, exposure_s: float, deadline: Deadline | None
    ) -> None:
        """A frame without light, which later ones are held against; then all is as it was."""
        lamp_on = self.subject.lamp_on
        self.blank()
        if lamp_on:
            self.switch_lamp(False)
        self._capture(exposure_s, deadline)
        if lamp_on:
            self.switch_lamp(True)
        self.show(showing)

    def _changes_of_light(
        self, exposure_s: float, *, lamp_before: bool, deadline: Deadline | None
    ) -> Iterator[tuple[Frame, Frame]]:
        """Pairs of a frame under other light than now, and one under the light as it is now."""
        showing, lamp_on = self._showing, self.subject.lamp_on
        if showing is None and (lamp_on or lamp_before or self._projector is None):
            self.switch_lamp(not lamp_on)
            away, _ = self._capture(exposure_s, deadline)
            self.switch_lamp(lamp_on)
            yield away, self._capture(exposure_s, deadline)[0]
            return
        for _ in self._show_others(showing):
            away, _ = self._capture(exposure_s, deadline)
            if showing is None:
                self.blank()
            else:
                self.show(showing)
            yield away, self._capture(exposure_s, deadline)[0]

    def _show_others(self, showing: Projection | None) -> Iterator[None]:
        """Show what cannot be taken for ``showing``, nor for what may have been shown before it."""
        width, height = self.projector.capabilities.size
        dark = Projection("darkness", np.zeros((height, width), np.uint8))
        try:
            self.show(counterpart(showing or dark))
        except (DeviceTimeoutError, DeviceLostError):
            raise
        except DeviceError:
            # A projector that shows only what it holds.
            for picture in self._shown:
                if showing is None or picture.digest != showing.digest:
                    self.show(picture)
                    yield
            if showing is not None:
                self.blank()
                yield
        else:
            yield

    def _differ(self, frame: Frame, other: Frame) -> bool:
        level = self.camera.capabilities.saturation_level
        return differ_beyond_noise(frame.image, other.image, saturation_level=level)
