"""The structured-light scan: a plan of patterns, and the procedure that records it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from acquisition.patterns import BLACK, WHITE, Axis, Gray, PhaseShift, Uniform, pattern_image
from acquisition.plan import Crop, Imager, Plan, PlannedFrame
from acquisition.session_writer import SessionWriter
from devices.errors import DeviceError
from devices.interfaces import Camera, Projector


def plan_scan(
    camera: Camera,
    projector: Projector,
    *,
    period_px: float = 24.0,
    steps: int = 8,
    axes: tuple[Axis, ...] = (Axis.COLUMN, Axis.ROW),
    exposure_s: float,
    source: str = "rig",
) -> Plan:
    """Plan a scan by phase shift, with Gray code for the fringe order.

    The Gray cells are half a period wide, so that a bit read wrongly at its own edge does not
    change the order.

    Parameters
    ----------
    camera, projector : Camera, Projector
        For their sizes.
    period_px : float
        Fringe period on the panel.
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
    """
    patterns: list[PhaseShift | Gray | Uniform] = [WHITE, BLACK]
    for axis in axes:
        extent = projector.size[0 if axis is Axis.COLUMN else 1]
        for step in range(steps):
            shift = 2 * np.pi * step / steps
            patterns.append(PhaseShift(axis=axis, period_px=period_px, shift_rad=shift))
        # Cells start half a pixel before the first pixel's centre.
        cells = int(np.ceil(extent / (period_px / 2))) + 1
        bits = max(1, int(np.ceil(np.log2(cells))))
        patterns.extend(
            Gray(axis=axis, bit=bit, bits=bits, step_px=period_px / 2) for bit in range(bits)
        )
    width, height = camera.size
    return Plan(
        camera=Imager(width=width, height=height),
        projector=Imager(width=projector.size[0], height=projector.size[1]),
        crop=Crop(column=0, row=0, width=width, height=height),
        saturation_level=camera.saturation_level,
        frames=tuple(
            PlannedFrame(id=f"{number:04d}", pattern=pattern, exposure_s=exposure_s)
            for number, pattern in enumerate(patterns)
        ),
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
        A device failed, or a frame came twice or out of turn.
    """
    missing = set(writer.missing)
    previous: int | None = None
    try:
        for planned in writer.plan.frames:
            if planned.id not in missing:
                continue
            width, height = projector.size
            projector.show(pattern_image(planned.pattern, width=width, height=height))
            if planned.exposure_s is None:
                raise DeviceError(f"frame {planned.id}: the plan names no exposure")
            frame = camera.capture(planned.exposure_s)
            if previous is not None and frame.sequence != previous + 1:
                raise DeviceError(
                    f"frame {planned.id}: the camera delivered its number {frame.sequence} after "
                    f"{previous}; a frame was lost, repeated or swapped, so take the scan again"
                )
            previous = frame.sequence
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
