"""What every camera, projector and light arm can do, whether real, simulated or replayed.

Each interface is a small protocol. A driver checks what it is asked for in its public methods and
touches hardware in private ones; every wait has a :class:`~devices.deadline.Deadline`; motion is
never retried by itself. Nothing above ``devices`` can tell which driver fills an interface.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from devices.bayer import BayerPattern
from devices.deadline import Deadline
from devices.errors import DeviceError


@dataclass(frozen=True)
class ArmPose:
    """Where the light arm stands.

    Attributes
    ----------
    azimuth : float
        Angle of the ring about the canvas normal, radians.
    elevation : float
        Angle of the lamp above the canvas plane along the arc, radians.
    """

    azimuth: float
    elevation: float

    def __str__(self) -> str:
        return (
            f"azimuth {math.degrees(self.azimuth):.2f}°, "
            f"elevation {math.degrees(self.elevation):.2f}°"
        )


@dataclass(frozen=True)
class ArmLimits:
    """The poses that an arm may take.

    Attributes
    ----------
    azimuth, elevation : (float, float)
        Least and largest angle, radians.
    """

    azimuth: tuple[float, float]
    elevation: tuple[float, float]

    def __post_init__(self) -> None:
        for axis in ("azimuth", "elevation"):
            low, high = getattr(self, axis)
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise DeviceError(f"limits of the {axis}: {low} to {high} is no range")

    def check(self, pose: ArmPose) -> None:
        """Refuse a pose outside the limits.

        Raises
        ------
        DeviceError
            An angle is not finite or lies outside its range; the axis is named.
        """
        for axis in ("azimuth", "elevation"):
            angle, (low, high) = getattr(pose, axis), getattr(self, axis)
            if not low <= angle <= high:
                raise DeviceError(
                    f"{axis} {math.degrees(angle):.2f}° is outside the arm's limits "
                    f"{math.degrees(low):.1f}° to {math.degrees(high):.1f}°"
                )


@dataclass(frozen=True)
class Projection:
    """A picture for the projector, under the name by which messages and replays know it.

    Attributes
    ----------
    name : str
        For people.
    image : (rows, cols) uint8 array
        Projector levels.
    """

    name: str
    image: NDArray[np.uint8] = field(repr=False)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of size and levels: the identity of what is shown, whatever it is called."""
        size = f"{self.image.shape}{self.image.dtype}".encode()
        return hashlib.sha256(size + np.ascontiguousarray(self.image).tobytes()).hexdigest()


@dataclass(frozen=True)
class Subject:
    """What a frame is a picture of, as the rig knew when it was taken.

    Attributes
    ----------
    projection : str or None
        Name of what the projector showed; None when it was dark.
    arm_pose : ArmPose or None
        Where the light arm stood; None without an arm, or while its position is not trusted.
    lamp_on : bool
        Whether the arm's lamp was lit.
    camera_position : str or None
        Name of the camera's place, if the rig has several.
    """

    projection: str | None = None
    arm_pose: ArmPose | None = None
    lamp_on: bool = False
    camera_position: str | None = None

    def __str__(self) -> str:
        parts = [self.projection or "projector dark"]
        if self.lamp_on:
            parts.append(f"lamp on at {self.arm_pose}")
        if self.camera_position is not None:
            parts.append(f"camera at {self.camera_position}")
        return ", ".join(parts)


@dataclass(frozen=True)
class Frame:
    """One picture from a camera, with what is needed to tell it from any other.

    Attributes
    ----------
    image : (rows, cols) uint8 or uint16 array
        Sensor numbers as they came; a Bayer sensor's mosaic is not interpolated.
    sequence : int
        The camera's own count of frames, rising by one.
    exposure_asked_s, exposure_applied_s : float
        What was asked for, and what the camera reports.
    monotonic_s, wall_time : float
        When the exposure ended, on the monotonic clock of this process and on the wall clock. A
        frame whose exposure began before its subject was there is refused, so a driver gives the
        time of the exposure, not the time at which it was asked for the frame.
    subject : Subject
        What it is a picture of; filled by :class:`~devices.rig.Rig`.
    """

    image: NDArray[Any] = field(repr=False)
    sequence: int
    exposure_asked_s: float
    exposure_applied_s: float
    monotonic_s: float
    wall_time: float
    subject: Subject = Subject()


@dataclass(frozen=True)
class CameraCapabilities:
    """What a camera is.

    Attributes
    ----------
    model : str
    width, height : int
        Size of a frame in pixels.
    saturation_level : int
        Sensor number at and above which a sample is saturated.
    exposure_range_s : (float, float)
        Shortest and longest exposure.
    bayer : BayerPattern or None
        Mosaic of a colour sensor; None if monochrome.
    """

    model: str
    width: int
    height: int
    saturation_level: int
    exposure_range_s: tuple[float, float]
    bayer: BayerPattern | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.width, self.height

    def check_exposure(self, exposure_s: float) -> None:
        """Refuse an exposure that the camera cannot make.

        Raises
        ------
        DeviceError
            Outside the range, or not finite.
        """
        low, high = self.exposure_range_s
        if not low <= exposure_s <= high:
            raise DeviceError(
                f"an exposure of {exposure_s:g} s is outside what {self.model} can do "
                f"({low:g} to {high:g} s)"
            )


@dataclass(frozen=True)
class ProjectorCapabilities:
    """What a projector is.

    Attributes
    ----------
    model : str
    width, height : int
        Size of the panel in pixels.
    frame_period_s : float
        Time of one projected frame; exposures of a colour-wheel or PWM projector should be
        multiples of it.
    """

    model: str
    width: int
    height: int
    frame_period_s: float

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.width, self.height

    def check_projection(self, projection: Projection) -> None:
        """Refuse a picture that the panel cannot show pixel by pixel.

        Raises
        ------
        DeviceError
            Not 8 bit, or of another size.
        """
        image = projection.image
        if image.shape != (self.height, self.width) or image.dtype != np.uint8:
            raise DeviceError(
                f"{self.model} shows 8-bit pictures of {self.width}×{self.height}, and "
                f"{projection.name!r} is {image.dtype} of {image.shape[::-1]}"
            )


@dataclass(frozen=True)
class ArmCapabilities:
    """What a light arm is.

    Attributes
    ----------
    model : str
    limits : ArmLimits
    speed : float
        Of the slower axis at full feed, rad/s; for estimates of time.
    """

    model: str
    limits: ArmLimits
    speed: float


class Camera(Protocol):
    """A camera that takes one frame at a time."""

    @property
    def capabilities(self) -> CameraCapabilities:
        """What the camera is."""

    def capture(self, exposure_s: float, *, deadline: Deadline | None = None) -> Frame:
        """Take one frame, exposed after this call.

        Parameters
        ----------
        exposure_s : float
            Exposure time asked for.
        deadline : Deadline, optional
            When the frame must be there; by default, the exposure and what the driver allows.

        Raises
        ------
        DeviceError
            The exposure is out of range, or the camera did not deliver; a
            :class:`~devices.errors.DeviceTimeoutError` if not in time, a
            :class:`~devices.errors.DeviceLostError` if it is gone.
        """

    def close(self) -> None:
        """Release the camera; harmless when closed already."""


class Projector(Protocol):
    """A projector that shows one picture at a time."""

    @property
    def capabilities(self) -> ProjectorCapabilities:
        """What the projector is."""

    def show(self, projection: Projection, *, deadline: Deadline | None = None) -> float:
        """Show a picture, and return once it is on the scene.

        Returns
        -------
        float
            Monotonic time since when it is there, the device's latency included.

        Raises
        ------
        DeviceError
            Not a picture for this panel, or the projector did not do it in time.
        """

    def blank(self) -> None:
        """Put the light out; harmless at any time."""

    def close(self) -> None:
        """Put the light out and release the projector; harmless when closed already."""


class LightArm(Protocol):
    """A lamp on a ring and an arc. The lamp is never lit while the arm moves."""

    @property
    def capabilities(self) -> ArmCapabilities:
        """What the arm is."""

    @property
    def pose(self) -> ArmPose | None:
        """Where it stands; None while that is not known (before homing, after a reset)."""

    @property
    def lamp_on(self) -> bool:
        """Whether the lamp was last switched on."""

    def home(self, *, deadline: Deadline | None = None) -> None:
        """Find the zero of both axes; from then on the position is trusted.

        Raises
        ------
        DeviceError
        """

    def move_to(self, pose: ArmPose, *, deadline: Deadline | None = None) -> None:
        """Put the lamp out, move, and return once the arm stands still at ``pose``.

        Raises
        ------
        DeviceError
            Outside the limits, position not trusted, an alarm, or not there by the deadline; then
            motion was stopped.
        """

    def switch_lamp(self, on: bool) -> float:
        """Switch the lamp; returns the monotonic time since when it is so.

        Raises
        ------
        DeviceError
            The lamp does not answer, or the arm is moving.
        """

    def stop(self) -> None:
        """Stop motion and put the lamp out, by every means there is; harmless at any time."""

    def close(self) -> None:
        """Stop, and release the arm; harmless when closed already."""


class CameraMount(Protocol):
    """The places that the camera can stand at: moved by hand, by simulation, or from a record."""

    @property
    def positions(self) -> tuple[str, ...]:
        """Names of the places."""

    @property
    def position(self) -> str:
        """Where the camera stands now."""

    def place(self, position: str) -> None:
        """Have the camera moved; returns once it stands there.

        Raises
        ------
        DeviceError
            There is no such place, or nobody confirmed the move.
        """
