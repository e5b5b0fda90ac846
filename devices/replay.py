"""Devices that answer from a recording, and refuse by name what it does not hold.

A recording is frames with what each of them is a picture of. The replayed projector, arm and mount
take only what occurs in it, and the camera looks up the frame that was taken under the state they
are in. Their count and their monotonic times are made anew, so that a replay goes through the same
checks as a live rig; the wall times are those of the recording.
"""

from __future__ import annotations

import difflib
import math
import time
from collections import Counter
from collections.abc import Iterable

from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceTimeoutError, NotRecordedError
from devices.interfaces import (
    ArmCapabilities,
    ArmPose,
    CameraCapabilities,
    Frame,
    Projection,
    ProjectorCapabilities,
)
from devices.recording import RecordedFrame, Recording
from devices.rig import Rig

# Angles that differ by less are the same pose, rad.
_SAME_ANGLE = 1e-6
# How many recorded alternatives a refusal names.
_ALTERNATIVES = 3


def replay_rig(recording: Recording) -> Rig:
    """A rig whose devices answer from a recording.

    Frames went through the proof of their light when they were taken, and the pictures of that
    proof are not in the recording: they are not asked for again.
    """
    projector = ReplayProjector(recording) if recording.projector is not None else None
    arm = ReplayLightArm(recording) if recording.arm is not None else None
    mount = ReplayMount(recording) if recording.positions else None
    camera = ReplayCamera(recording, projector=projector, arm=arm, mount=mount)
    return Rig(
        camera,
        projector,
        arm,
        mount,
        toml=recording.toml,
        source=recording.source,
        prove_light=False,
    )


class ReplayProjector:
    """A projector that takes the pictures of a recording."""

    def __init__(self, recording: Recording) -> None:
        if recording.projector is None:
            raise NotRecordedError("the recording was made without a projector")
        self._capabilities = recording.projector
        self._names = {
            f.projection: f.projection_name for f in recording.frames if f.projection is not None
        }
        self._closed = False
        self.showing: Projection | None = None

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """Those of the projector in the recording."""
        return self._capabilities

    def show(self, projection: Projection, *, deadline: Deadline | None = None) -> float:
        """Take a picture that was shown in the recording.

        Raises
        ------
        DeviceError
            The projector is closed or the deadline has passed; a
            :class:`~devices.errors.NotRecordedError` if the picture was never shown.
        """
        if self._closed:
            raise DeviceError("the replayed projector is closed")
        self._capabilities.check_projection(projection)
        if deadline is not None:
            deadline.require("the replayed projector did not show its picture")
        if projection.digest not in self._names:
            near = difflib.get_close_matches(
                projection.name, self._names.values(), n=_ALTERNATIVES, cutoff=0.0
            )
            raise NotRecordedError(
                f"pattern {projection.name!r} was not recorded; the nearest are {_list(near)}"
            )
        self.showing = projection
        return time.monotonic()

    def blank(self) -> None:
        """Put the light out."""
        self.showing = None

    def close(self) -> None:
        """Put the light out and release the projector."""
        self.blank()
        self._closed = True


class ReplayLightArm:
    """A light arm that takes the poses of a recording."""

    def __init__(self, recording: Recording) -> None:
        if recording.arm is None:
            raise NotRecordedError("the recording was made without a light arm")
        self._capabilities = recording.arm
        self._poses = tuple(
            dict.fromkeys(f.arm_pose for f in recording.frames if f.arm_pose is not None)
        )
        self._pose: ArmPose | None = None
        self._lamp_on = False
        self._closed = False

    @property
    def capabilities(self) -> ArmCapabilities:
        """Those of the arm in the recording."""
        return self._capabilities

    @property
    def pose(self) -> ArmPose | None:
        """Where it stands; None before homing."""
        return self._pose

    @property
    def lamp_on(self) -> bool:
        """Whether the lamp is lit."""
        return self._lamp_on

    def home(self, *, deadline: Deadline | None = None) -> None:
        """Trust the position from now on."""
        self._require_open()
        self._lamp_on = False
        if deadline is not None:
            deadline.require("the replayed arm did not home")
        limits = self._capabilities.limits
        self._pose = ArmPose(limits.azimuth[0], limits.elevation[0])

    def move_to(self, pose: ArmPose, *, deadline: Deadline | None = None) -> None:
        """Take a pose that occurs in the recording.

        Raises
        ------
        DeviceError
            Closed, not homed, outside the limits or too late; a
            :class:`~devices.errors.NotRecordedError` if no frame was taken from there.
        """
        self._require_open()
        self._capabilities.limits.check(pose)
        if self._pose is None:
            raise DeviceError("the arm's position is not trusted; home it first")
        near = sorted(self._poses, key=lambda recorded: _angle_between(recorded, pose))
        if not near or _angle_between(near[0], pose) > _SAME_ANGLE:
            raise NotRecordedError(
                f"pose {pose} was not recorded; the nearest are {_list(near[:_ALTERNATIVES])}"
            )
        self._lamp_on = False
        if deadline is not None:
            deadline.require("the replayed arm did not reach its pose")
        self._pose = near[0]

    def switch_lamp(self, on: bool) -> float:
        """Switch the lamp.

        Raises
        ------
        DeviceError
            The arm is closed.
        """
        self._require_open()
        self._lamp_on = on
        return time.monotonic()

    def stop(self) -> None:
        """Put the lamp out."""
        self._lamp_on = False

    def close(self) -> None:
        """Put the lamp out, and release the arm."""
        self.stop()
        self._closed = True

    def _require_open(self) -> None:
        if self._closed:
            raise DeviceError("the replayed light arm is closed")


class ReplayMount:
    """The places at which the camera stood in a recording."""

    def __init__(self, recording: Recording) -> None:
        if not recording.positions:
            raise NotRecordedError("the recording names no camera positions")
        self._positions = recording.positions
        self._position = self._positions[0]

    @property
    def positions(self) -> tuple[str, ...]:
        """Names of the places."""
        return self._positions

    @property
    def position(self) -> str:
        """Where the camera stands."""
        return self._position

    def place(self, position: str) -> None:
        """Have the camera stand at a place of the recording.

        Raises
        ------
        NotRecordedError
            No frame was taken from there.
        """
        if position not in self._positions:
            raise NotRecordedError(
                f"camera position {position!r} was not recorded; there are {_list(self._positions)}"
            )
        self._position = position


class ReplayCamera:
    """A camera that delivers the frames of a recording.

    Parameters
    ----------
    recording : Recording
    projector : ReplayProjector, optional
    arm : ReplayLightArm, optional
    mount : ReplayMount, optional
        What the scene is lit by and seen from.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        projector: ReplayProjector | None = None,
        arm: ReplayLightArm | None = None,
        mount: ReplayMount | None = None,
    ) -> None:
        self._recording = recording
        self._projector = projector
        self._arm = arm
        self._mount = mount
        self._delivered: Counter[str] = Counter()
        self._sequence = 0
        self._ended = 0.0
        self._closed = False

    @property
    def capabilities(self) -> CameraCapabilities:
        """Those of the camera in the recording."""
        return self._recording.camera

    def capture(self, exposure_s: float, *, deadline: Deadline | None = None) -> Frame:
        """Deliver the frame that was taken under the present state with this exposure.

        Frames recorded several times come in the order in which they were taken.

        Raises
        ------
        DeviceError
            Closed, out of range or too late; a :class:`~devices.errors.NotRecordedError` if there
            is no such frame, or all of them were delivered.
        """
        if self._closed:
            raise DeviceError("the replayed camera is closed")
        self.capabilities.check_exposure(exposure_s)
        recorded = self._next_frame(exposure_s)
        began = max(time.monotonic(), self._ended)
        image = self._recording.load(recorded)
        if deadline is not None and deadline.passed:
            raise DeviceTimeoutError("the replayed camera did not deliver in time")
        self._delivered[recorded.id] += 1
        self._sequence += 1
        self._ended = began + recorded.exposure_applied_s
        return Frame(
            image=image,
            sequence=self._sequence,
            exposure_asked_s=exposure_s,
            exposure_applied_s=recorded.exposure_applied_s,
            monotonic_s=self._ended,
            wall_time=recorded.wall_time,
        )

    def close(self) -> None:
        """Release the camera."""
        self._closed = True

    def _next_frame(self, exposure_s: float) -> RecordedFrame:
        of_state = [frame for frame in self._recording.frames if self._is_of_state(frame)]
        if not of_state:
            raise NotRecordedError(
                f"no frame of {self._state()} was recorded; the nearest are "
                f"{_list(self._nearest())}"
            )
        matching = [f for f in of_state if math.isclose(f.exposure_asked_s, exposure_s)]
        if not matching:
            exposures = sorted(
                {f.exposure_asked_s for f in of_state},
                key=lambda recorded: abs(math.log(recorded / exposure_s)),
            )
            raise NotRecordedError(
                f"{self._state()} was not recorded with an exposure of {exposure_s:g} s; the "
                f"nearest are {_list(f'{e:g} s' for e in exposures[:_ALTERNATIVES])}"
            )
        for frame in matching:
            if not self._delivered[frame.id]:
                return frame
        raise NotRecordedError(
            f"{self._state()} with an exposure of {exposure_s:g} s was recorded "
            f"{len(matching)} times (frame {matching[-1].id} last), and all were replayed"
        )

    def _is_of_state(self, frame: RecordedFrame) -> bool:
        return not self._differences(frame)

    def _differences(self, frame: RecordedFrame) -> int:
        """In how many respects a recorded frame was taken under another state."""
        showing = self._projector.showing if self._projector is not None else None
        digest = showing.digest if showing is not None else None
        lamp_on = self._arm is not None and self._arm.lamp_on
        pose = self._arm.pose if self._arm is not None else None
        place = self._mount.position if self._mount is not None else None
        differs = (
            frame.projection != digest,
            frame.lamp_on != lamp_on,
            frame.arm_pose is not None
            and (pose is None or _angle_between(frame.arm_pose, pose) > _SAME_ANGLE),
            frame.camera_position is not None and frame.camera_position != place,
        )
        return sum(differs)

    def _state(self) -> str:
        """The present state, for people."""
        showing = self._projector.showing if self._projector is not None else None
        parts = [showing.name if showing is not None else "projector dark"]
        if self._arm is not None:
            parts.append(f"lamp {'on' if self._arm.lamp_on else 'off'} at {self._arm.pose}")
        if self._mount is not None:
            parts.append(f"camera at {self._mount.position}")
        return ", ".join(parts)

    def _nearest(self) -> list[str]:
        near = sorted(self._recording.frames, key=self._differences)[:_ALTERNATIVES]
        return [_described(frame) for frame in near]


def _described(frame: RecordedFrame) -> str:
    parts = [f"{frame.id}: {frame.projection_name}"]
    if frame.arm_pose is not None:
        parts.append(f"lamp {'on' if frame.lamp_on else 'off'} at {frame.arm_pose}")
    if frame.camera_position is not None:
        parts.append(f"camera at {frame.camera_position}")
    return ", ".join(parts)


def _angle_between(one: ArmPose, other: ArmPose) -> float:
    """Larger of the two angles that a move between two poses turns by, rad."""
    return max(abs(one.azimuth - other.azimuth), abs(one.elevation - other.elevation))


def _list(names: Iterable[object]) -> str:
    return "; ".join(map(str, names)) or "none"
