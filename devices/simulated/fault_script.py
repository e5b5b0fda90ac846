"""Scripts of faults, as plain data: what goes wrong, and at which call.

Calls are counted from zero. The devices that play a script are in :mod:`devices.simulated.faults`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Stamp(StrEnum):
    """What a camera says of a frame that it should not have delivered.

    ``HONEST``: its true number, times and exposure. ``RENUMBERED``: the number that is expected,
    with its true times. ``RESTAMPED``: number, times and exposure of a fresh frame.
    """

    HONEST = "honest"
    RENUMBERED = "renumbered"
    RESTAMPED = "restamped"


@dataclass(frozen=True)
class StaleFrame:
    """Capture ``at`` delivers a frame that the camera had exposed and buffered before it."""

    at: int
    stamp: Stamp = Stamp.HONEST


@dataclass(frozen=True)
class RepeatedFrame:
    """Capture ``at`` delivers the frame of the capture before it again."""

    at: int
    stamp: Stamp = Stamp.HONEST


@dataclass(frozen=True)
class SwappedFrames:
    """Captures ``at`` and ``at + 1`` deliver two frames in exchanged order.

    The camera exposes two frames at ``at``, hands out the second, and the first one next.
    """

    at: int
    stamp: Stamp = Stamp.HONEST


@dataclass(frozen=True)
class DroppedFrame:
    """A frame is lost before capture ``at``, which delivers the one after it."""

    at: int


@dataclass(frozen=True)
class TruncatedFrame:
    """The last ``rows`` rows of capture ``at`` are missing."""

    at: int
    rows: int = 1


@dataclass(frozen=True)
class LateFrame:
    """Capture ``at`` is not there in time; its frame is what the next capture delivers."""

    at: int


@dataclass(frozen=True)
class CameraUnplugged:
    """From capture ``at`` on the camera is gone."""

    at: int


@dataclass(frozen=True)
class ClockJump:
    """From capture ``at`` on, frames' times are off.

    Attributes
    ----------
    at : int
    wall_s : float
        Jump of the wall clock.
    device_s : float
        Jump of the camera's own clock, from which the monotonic time of its frames is taken.
    """

    at: int
    wall_s: float = 0.0
    device_s: float = 0.0


CameraFault = (
    StaleFrame
    | RepeatedFrame
    | SwappedFrames
    | DroppedFrame
    | TruncatedFrame
    | LateFrame
    | CameraUnplugged
    | ClockJump
)


@dataclass(frozen=True)
class PreviousPicture:
    """Call ``at`` of ``show`` leaves the previous picture standing."""

    at: int


@dataclass(frozen=True)
class OneLate:
    """From call ``at`` on, each call of ``show`` puts up the picture of the call before it."""

    at: int = 0


@dataclass(frozen=True)
class ProjectorDark:
    """From call ``at`` of ``show`` on the projector's lamp is out, and it does not say so."""

    at: int


@dataclass(frozen=True)
class Latency:
    """Each picture appears some time after it was given.

    Attributes
    ----------
    seconds : float
    declared : bool
        Whether ``show`` waits for it, as it should, or claims that the picture is there at once.
    """

    seconds: float
    declared: bool = True


@dataclass(frozen=True)
class ProjectorUnplugged:
    """From call ``at`` of ``show`` on the projector is gone."""

    at: int


ProjectorFault = PreviousPicture | OneLate | ProjectorDark | Latency | ProjectorUnplugged


@dataclass(frozen=True)
class LampFailure:
    """From the ``at``-th time on that it is switched on, the lamp stays dark and says it is lit."""

    at: int = 0
