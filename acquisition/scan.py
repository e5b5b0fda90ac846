"""The structured-light scan: showing each pattern of a plan, and recording what the camera sees."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from acquisition.patterns import Axis, pattern_image
from acquisition.plan import Plan, PlannedFrame
from acquisition.scan_plan import plan_structured_light
from acquisition.session_writer import SessionWriter
from devices.errors import DeviceError
from devices.interfaces import Camera, Frame, Projector

# What a camera may take beyond the exposure itself before it counts as dead.
_FRAME_TIMEOUT_S = 20.0
# Rounding of times on the monotonic clock.
_CLOCK_S = 1e-6


def plan_scan(
    camera: Camera,
    projector: Projector,
    *,
    period_px: float = 24.0,
    coarser_periods_px: tuple[float, ...] = (),
    steps: int = 8,
    axes: tuple[Axis, ...] = (Axis.COLUMN, Axis.ROW),
    exposure_s: float,
    source: str = "rig",
) -> Plan:
    """Plan a scan for these devices; see :func:`~acquisition.scan_plan.plan_structured_light`.

    Parameters
    ----------
    camera, projector : Camera, Projector
        For their sizes.
    period_px : float
        Finest fringe period on the panel.
    coarser_periods_px : tuple of float
        Further fringes; where one covers the panel there is no Gray code.
    steps : int
        Phase steps, three or more.
    axes : tuple of Axis
        Coordinates to encode.
    exposure_s : float
        Exposure of every frame.
    source : str
        Kept in the plan.

    Returns
    -------
    Plan

    Raises
    ------
    SessionError
        What is asked for cannot be shown or decoded.
    """
    return plan_structured_light(
        camera_size=camera.size,
        projector_size=projector.size,
        saturation_level=camera.saturation_level,
        exposure_s=exposure_s,
        axes=axes,
        periods_px=(*coarser_periods_px, period_px),
        steps=steps,
        source=source,
    )


def scan(
    writer: SessionWriter,
    camera: Camera,
    projector: Projector,
    *,
    advance: Callable[[str], None] = lambda frame_id: None,
) -> None:
    """Capture what a session still misses of its plan, and finish it.

    The projector is blanked on every way out. Also goes on with a resumed session.

    Parameters
    ----------
    writer : SessionWriter
        The session being recorded.
    camera, projector : Camera, Projector
        The rig.
    advance : callable, optional
        Called with each frame id once it is recorded.

    Raises
    ------
    DeviceError
        The devices are not those of the plan, one of them failed, or a frame came twice, out of
        turn, or from before its pattern was shown.
    """
    missing = set(writer.missing)
    order = _FrameOrder()
    width, height = projector.size
    try:
        _check_devices(writer.plan, camera, projector)
        for planned in writer.plan.frames:
            if planned.id not in missing:
                continue
            if planned.exposure_s is None:
                raise DeviceError(f"frame {planned.id}: the plan names no exposure")
            projector.show(pattern_image(planned.pattern, width=width, height=height))
            shown_at = time.monotonic()
            deadline = shown_at + planned.exposure_s + _FRAME_TIMEOUT_S
            frame = camera.capture(planned.exposure_s, deadline=deadline)
            order.check(planned, frame, shown_at)
            writer.record(
                planned.id,
                frame.image,
                sequence=frame.sequence,
                exposure_applied_s=frame.exposure_applied_s,
                monotonic_s=frame.monotonic_s,
                wall_time=frame.wall_time,
            )
            advance(planned.id)
        writer.finish()
    finally:
        projector.blank()


def _check_devices(plan: Plan, camera: Camera, projector: Projector) -> None:
    """Refuse devices that the plan was not made for: its patterns would mean something else."""
    for name, device, planned in (
        ("camera", camera, plan.camera),
        ("projector", projector, plan.projector),
    ):
        if device.size != (planned.width, planned.height):
            raise DeviceError(
                f"the plan is for a {name} of {planned.width}×{planned.height} pixels, this one "
                f"has {device.size[0]}×{device.size[1]}; connect the right one, or make a new plan"
            )
    if camera.saturation_level != plan.saturation_level:
        raise DeviceError(
            f"the plan is for a camera that saturates at {plan.saturation_level}, this one does at "
            f"{camera.saturation_level}; set the pixel format back, or make a new plan"
        )


@dataclass
class _FrameOrder:
    """Holds every frame against the one before it."""

    _previous: tuple[PlannedFrame, Frame] | None = field(default=None, init=False)

    def check(self, planned: PlannedFrame, frame: Frame, shown_at: float) -> None:
        """Refuse a frame that cannot be the picture of its pattern.

        A count alone does not catch a driver that hands out what it has buffered: its frames
        follow one another properly, each one pattern late. Their times give them away.
        """
        if self._previous is not None:
            before, last = self._previous
            if frame.sequence != last.sequence + 1:
                raise DeviceError(
                    f"frame {planned.id}: the camera delivered its number {frame.sequence} after "
                    f"{last.sequence}; a frame was lost, repeated or swapped, so take the scan "
                    "again"
                )
            if before.pattern != planned.pattern and _same_noise(frame, last):
                raise DeviceError(
                    f"frame {planned.id} is frame {before.id} over again, to the last sample; the "
                    "camera repeats itself under a new number, so restart it and resume"
                )
        early = shown_at - (frame.monotonic_s - frame.exposure_applied_s)
        if early > _CLOCK_S:
            raise DeviceError(
                f"frame {planned.id} is stale: its exposure began {early * 1000:.0f} ms before its "
                "pattern was shown; empty the camera's buffer and resume"
            )
        self._previous = planned, frame


def _same_noise(frame: Frame, last: Frame) -> bool:
    """Whether two frames agree in every sample, and not because all are dark or saturated."""
    return bool(np.array_equal(frame.image, last.image) and np.ptp(frame.image) > 0)
