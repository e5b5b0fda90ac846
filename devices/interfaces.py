"""What every camera and projector can do, whether real, simulated or replayed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Frame:
    """One picture from a camera, with what is needed to tell it from any other.

    Attributes
    ----------
    image : (rows, cols) uint8 or uint16 array
        Sensor numbers as they came.
    sequence : int
        The camera's own count of frames, rising by one.
    exposure_asked_s, exposure_applied_s : float
        What was asked for, and what the camera reports.
    monotonic_s, wall_time : float
        When the exposure ended, on the monotonic clock of this process and on the wall clock. A
        frame whose exposure began before its pattern was shown is refused, so a driver gives the
        time of the exposure, not the time at which it was asked for the frame.
    """

    image: NDArray[Any]
    sequence: int
    exposure_asked_s: float
    exposure_applied_s: float
    monotonic_s: float
    wall_time: float


class Camera(Protocol):
    """A camera that takes one frame at a time."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a frame in pixels."""

    @property
    def saturation_level(self) -> int:
        """Sensor number at which samples saturate."""

    def capture(self, exposure_s: float, *, deadline: float | None = None) -> Frame:
        """Take one frame, exposed after this call.

        Parameters
        ----------
        exposure_s : float
            Exposure time asked for.
        deadline : float, optional
            Time on the monotonic clock by which the frame must be there.

        Raises
        ------
        DeviceError
            The camera did not deliver, or not in time.
        """

    def close(self) -> None:
        """Release the camera; harmless when closed already."""


class Projector(Protocol):
    """A projector that shows one picture at a time."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the panel in pixels."""

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show a (rows, cols) picture; returns once it is on the scene."""

    def blank(self) -> None:
        """Show nothing; harmless at any time."""

    def close(self) -> None:
        """Blank and release the projector; harmless when closed already."""
