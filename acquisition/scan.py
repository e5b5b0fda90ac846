"""The structured-light scan of a rig: its plan, and its recording."""

from __future__ import annotations

from collections.abc import Callable

from acquisition.patterns import Axis
from acquisition.plan import Metering, Plan
from acquisition.projector_response import ProjectorResponse
from acquisition.recording import record_plan
from acquisition.scan_plan import plan_greys, plan_structured_light
from acquisition.session_writer import SessionWriter
from devices.rig import Rig


def plan_scan(
    rig: Rig,
    *,
    period_px: float = 24.0,
    coarser_periods_px: tuple[float, ...] = (),
    steps: int = 8,
    axes: tuple[Axis, ...] = (Axis.COLUMN, Axis.ROW),
    inverse: bool = False,
    metering: Metering | None = None,
    response: ProjectorResponse | None = None,
    exposure_s: float | tuple[float, ...],
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
    inverse : bool
        Whether bits of a Gray code are followed by their inverse.
    metering : Metering, optional
        By what frames that no pixel needs are left out; by default, all are taken.
    response : ProjectorResponse, optional
        Of the projector, by which fringes are compensated.
    exposure_s : float or tuple of float
        Exposure of every frame, or those at which each pattern is taken.

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
        mosaic=rig.camera.capabilities.bayer,
        projector_size=rig.projector.capabilities.size,
        saturation_level=rig.camera.capabilities.saturation_level,
        exposure_s=exposure_s,
        axes=axes,
        periods_px=(*coarser_periods_px, period_px),
        steps=steps,
        inverse=inverse,
        metering=metering,
        response=response,
        source=rig.source,
    )


def plan_response_scan(rig: Rig, *, greys: int = 17, exposure_s: tuple[float, ...]) -> Plan:
    """Plan greys for a rig, which tell its projector's response.

    Parameters
    ----------
    rig : Rig
    greys : int
        Levels in even steps from black to white.
    exposure_s : tuple of float

    Returns
    -------
    Plan

    Raises
    ------
    SessionError
        As of :func:`~acquisition.scan_plan.plan_greys`.
    """
    return plan_greys(
        camera_size=rig.camera.capabilities.size,
        mosaic=rig.camera.capabilities.bayer,
        projector_size=rig.projector.capabilities.size,
        saturation_level=rig.camera.capabilities.saturation_level,
        exposure_s=exposure_s,
        greys=greys,
        source=rig.source,
    )


def scan(
    writer: SessionWriter,
    rig: Rig,
    *,
    advance: Callable[[str], None] = lambda frame_id: None,
) -> None:
    """Record a scan, for which nobody need be at the desk.

    Parameters
    ----------
    writer, rig, advance
        As for :func:`~acquisition.recording.record_plan`.

    Raises
    ------
    DeviceError, SessionError
        As there.
    """
    record_plan(writer, rig, advance=advance)
