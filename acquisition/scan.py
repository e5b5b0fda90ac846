"""The structured-light scan: showing each pattern of a plan, and recording what the camera sees."""

from __future__ import annotations

from collections.abc import Callable

from acquisition.frame_files import Samples
from acquisition.patterns import BLACK, WHITE, Axis, describe, pattern_image
from acquisition.plan import Plan, PlannedFrame
from acquisition.scan_plan import plan_structured_light
from acquisition.session_writer import SessionWriter
from devices.errors import DeviceError, FrameOrderError
from devices.frame_order import differ_beyond_noise
from devices.interfaces import Projection
from devices.rig import Rig


def plan_scan(
    rig: Rig,
    *,
    period_px: float = 24.0,
    coarser_periods_px: tuple[float, ...] = (),
    steps: int = 8,
    axes: tuple[Axis, ...] = (Axis.COLUMN, Axis.ROW),
    exposure_s: float,
) -> Plan:
    """Plan a scan for a rig; see :func:`~acquisition.scan_plan.plan_structured_light`.

    Parameters
    ----------
    rig : Rig
        For the sizes of its camera and projector.
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

    Returns
    -------
    Plan

    Raises
    ------
    SessionError
        What is asked for cannot be shown or decoded.
    """
    return plan_structured_light(
        camera_size=rig.camera.capabilities.size,
        projector_size=rig.projector.capabilities.size,
        saturation_level=rig.camera.capabilities.saturation_level,
        exposure_s=exposure_s,
        axes=axes,
        periods_px=(*coarser_periods_px, period_px),
        steps=steps,
        source=rig.source,
    )


def scan(
    writer: SessionWriter,
    rig: Rig,
    *,
    advance: Callable[[str], None] = lambda frame_id: None,
) -> None:
    """Capture what a session still misses of its plan, and finish it.

    The projector is blanked on every way out. Also goes on with a resumed session.

    Parameters
    ----------
    writer : SessionWriter
        The session being recorded.
    rig : Rig
        Camera and projector.
    advance : callable, optional
        Called with each frame id once it is recorded.

    Raises
    ------
    DeviceError
        The devices are not those of the plan, one of them failed, or a frame came twice, out of
        turn, or from before its pattern was shown; or white is darker than black.
    """
    missing = set(writer.missing)
    panel = rig.projector.capabilities
    flats = _Flats(writer.plan)
    rig.begin_recording()
    try:
        _check_devices(writer.plan, rig)
        for planned in writer.plan.frames:
            if planned.id not in missing:
                continue
            if planned.exposure_s is None:
                raise DeviceError(f"frame {planned.id}: the plan names no exposure")
            image = pattern_image(planned.pattern, width=panel.width, height=panel.height)
            rig.show(Projection(f"{planned.id} {describe(planned.pattern)}", image))
            frame = rig.capture(planned.exposure_s)
            flats.check(planned, frame.image)
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
        rig.blank()


class _Flats:
    """The white and black frames of a scan, of which white must be the brighter one.

    A projector that shows each picture one late would otherwise shift a whole scan.
    """

    def __init__(self, plan: Plan) -> None:
        self._saturation_level = plan.saturation_level
        self._seen: dict[tuple[bool, float | None], tuple[str, Samples]] = {}

    def check(self, planned: PlannedFrame, image: Samples) -> None:
        """Hold a white frame against the last black one of its exposure, and a black against white.

        Raises
        ------
        FrameOrderError
            White is darker than black, by more than noise.
        """
        if planned.pattern not in (WHITE, BLACK):
            return
        is_white = planned.pattern == WHITE
        self._seen[is_white, planned.exposure_s] = planned.id, image
        if (not is_white, planned.exposure_s) not in self._seen:
            return
        white_id, white = self._seen[True, planned.exposure_s]
        black_id, black = self._seen[False, planned.exposure_s]
        if white.mean() < black.mean() and differ_beyond_noise(
            white, black, saturation_level=self._saturation_level
        ):
            raise FrameOrderError(
                f"frame {white_id} (white) is darker than frame {black_id} (black): the projector "
                "shows each picture later than it says; raise its latency in rig.toml, and scan "
                "anew"
            )


def _check_devices(plan: Plan, rig: Rig) -> None:
    """Refuse devices that the plan was not made for: its patterns would mean something else."""
    for name, device, planned in (
        ("camera", rig.camera.capabilities, plan.camera),
        ("projector", rig.projector.capabilities, plan.projector),
    ):
        if device.size != (planned.width, planned.height):
            raise DeviceError(
                f"the plan is for a {name} of {planned.width}×{planned.height} pixels, this one "
                f"has {device.size[0]}×{device.size[1]}; connect the right one, or make a new plan"
            )
    saturation = rig.camera.capabilities.saturation_level
    if saturation != plan.saturation_level:
        raise DeviceError(
            f"the plan is for a camera that saturates at {plan.saturation_level}, this one does at "
            f"{saturation}; set the pixel format back, or make a new plan"
        )
