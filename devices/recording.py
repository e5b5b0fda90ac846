"""A recording: frames with what each of them is a picture of, for devices that replay them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from devices.interfaces import (
    ArmCapabilities,
    ArmPose,
    CameraCapabilities,
    ProjectorCapabilities,
)


@dataclass(frozen=True)
class RecordedFrame:
    """A frame that can be replayed.

    Attributes
    ----------
    id : str
        Its name in the recording.
    exposure_asked_s, exposure_applied_s : float
    wall_time : float
        When its exposure ended, on the wall clock of the recording.
    projection : str or None
        Digest of what was projected; None when the projector was dark.
    projection_name : str
        For people.
    arm_pose : ArmPose or None
        Where the light arm stood; None where the recording does not say, which any pose matches.
    lamp_on : bool
    camera_position : str or None
        Where the camera stood; None where the recording does not say, which any place matches.
    """

    id: str
    exposure_asked_s: float
    exposure_applied_s: float
    wall_time: float
    projection: str | None = None
    projection_name: str = "projector dark"
    arm_pose: ArmPose | None = None
    lamp_on: bool = False
    camera_position: str | None = None


@dataclass(frozen=True)
class Recording:
    """What replayed devices answer from.

    Attributes
    ----------
    frames : tuple of RecordedFrame
        In the order in which they were taken.
    load : callable
        Sensor numbers of a recorded frame, (rows, cols).
    camera : CameraCapabilities
    projector : ProjectorCapabilities or None
        None if the rig had none.
    arm : ArmCapabilities or None
        None if the rig had none.
    toml : str
        The ``rig.toml`` in force; empty if there was none.
    source : str
        As in plans.
    """

    frames: tuple[RecordedFrame, ...]
    load: Callable[[RecordedFrame], NDArray[Any]]
    camera: CameraCapabilities
    projector: ProjectorCapabilities | None = None
    arm: ArmCapabilities | None = None
    toml: str = ""
    source: str = "rig"

    @property
    def positions(self) -> tuple[str, ...]:
        """Places where the camera stood, in the order of their first frame."""
        named = (f.camera_position for f in self.frames if f.camera_position is not None)
        return tuple(dict.fromkeys(named))
