"""What a replay answers from: the frames of a session, each with what it is a picture of.

A session whose recording was cut off can be replayed as far as it goes; where it ends, the replay
refuses the first frame that is missing by its name.
"""

from __future__ import annotations

from pathlib import Path

from acquisition.errors import SessionError
from acquisition.journal import FrameRecorded, Stop, StopReason, read_journal, settled_frames
from acquisition.patterns import Pattern, describe, pattern_image
from acquisition.plan import Plan, PlannedFrame
from acquisition.session import JOURNAL_FILE, RIG_FILE, Session, check_beginning, read_plan
from devices.interfaces import (
    ArmCapabilities,
    ArmLimits,
    CameraCapabilities,
    Projection,
    ProjectorCapabilities,
)
from devices.recording import RecordedFrame, Recording

# A session does not say what its camera could have done.
_EXPOSURE_RANGE_S = (1e-7, 86_400.0)
# Nor how fast its projector was.
_FRAME_PERIOD_S = 1 / 60
# Nor what its arm could have reached, beyond the poses that it took, and how fast; rad, rad/s.
_BEYOND = 0.01
_ARM_SPEED = 0.5


def open_for_replay(path: Path) -> Session:
    """Open a session, whole or cut off.

    Parameters
    ----------
    path : Path
        Its folder.

    Returns
    -------
    Session
        If the recording did not finish, without a digest and with the frames that there are.

    Raises
    ------
    SessionError
        It is no session, or damaged.
    """
    path = Path(path)
    if not path.is_dir():
        raise SessionError(f"{path}: no such session folder")
    plan = read_plan(path)
    events = read_journal(path / JOURNAL_FILE)
    if any(isinstance(e, Stop) and e.reason is StopReason.SUCCESS for e in events):
        return Session.open(path)
    check_beginning(path, events)
    return Session(path, plan, "", *settled_frames(events))


def rig_toml(session: Session) -> str | None:
    """The ``rig.toml`` in force when a session was recorded; None if there was none.

    Raises
    ------
    SessionError
        It is not text.
    """
    file = session.path / RIG_FILE
    try:
        # Not read_text, which changes line ends.
        return file.read_bytes().decode()
    except FileNotFoundError:
        return None
    except UnicodeDecodeError:
        raise SessionError(f"{file}: not a text file") from None


def recording_of(session: Session) -> Recording:
    """What a session's frames are pictures of, for :func:`~devices.replay.replay_rig`.

    Parameters
    ----------
    session : Session
        From :func:`open_for_replay`.

    Returns
    -------
    Recording

    Raises
    ------
    SessionError
        The session was imported: nobody asked a camera for its frames, their exposures are not
        known, or they are a part of what the camera saw.
    """
    plan = session.plan
    crop = plan.crop
    if (crop.width, crop.height) != (plan.camera.width, plan.camera.height):
        raise SessionError(
            f"{session.path} holds {crop.width}×{crop.height} of a camera's "
            f"{plan.camera.width}×{plan.camera.height} pixels: it was imported, not recorded by a "
            "rig, and cannot be replayed; process it as it is"
        )
    return Recording(
        frames=tuple(
            _recorded_frame(session, planned, session.recorded[planned.id])
            for planned in plan.frames
            if planned.id in session.recorded
        ),
        load=lambda frame: session.read_frame(frame.id),
        camera=CameraCapabilities(
            model="replayed camera",
            width=plan.camera.width,
            height=plan.camera.height,
            saturation_level=plan.saturation_level,
            exposure_range_s=_EXPOSURE_RANGE_S,
            bayer=plan.camera.mosaic,
        ),
        projector=ProjectorCapabilities(
            model="replayed projector",
            width=plan.projector.width,
            height=plan.projector.height,
            frame_period_s=_FRAME_PERIOD_S,
        ),
        arm=_arm_of(plan),
        toml=rig_toml(session) or "",
        source=plan.source,
    )


def _recorded_frame(session: Session, planned: PlannedFrame, entry: FrameRecorded) -> RecordedFrame:
    if planned.exposure_s is None:
        raise SessionError(
            f"{session.path}: frame {planned.id} has no exposure: the session was imported from "
            f"{session.plan.source!r}, not recorded by a rig, and cannot be replayed; process it "
            "as it is"
        )
    projection = None
    if planned.pattern is not None:
        projection = _projection(session.plan, planned.id, planned.pattern)
    applied = entry.exposure_applied_s
    return RecordedFrame(
        id=planned.id,
        exposure_asked_s=planned.exposure_s,
        exposure_applied_s=planned.exposure_s if applied is None else applied,
        wall_time=entry.wall_time,
        projection=None if projection is None else projection.digest,
        projection_name=f"{planned.id} dark" if projection is None else projection.name,
        arm_pose=planned.arm_pose,
        lamp_on=planned.lamp_on,
        camera_position=planned.camera_position,
    )


def _arm_of(plan: Plan) -> ArmCapabilities | None:
    """An arm that reaches what the plan asked of the recorded one; None if it asked nothing."""
    poses = [frame.arm_pose for frame in plan.frames if frame.arm_pose is not None]
    if not poses:
        return None
    azimuths = [pose.azimuth for pose in poses]
    elevations = [pose.elevation for pose in poses]
    limits = ArmLimits(
        (min(azimuths) - _BEYOND, max(azimuths) + _BEYOND),
        (min(elevations) - _BEYOND, max(elevations) + _BEYOND),
    )
    return ArmCapabilities("replayed light arm", limits, _ARM_SPEED)


def _projection(plan: Plan, frame_id: str, pattern: Pattern) -> Projection:
    panel = plan.projector
    image = pattern_image(pattern, width=panel.width, height=panel.height, response=plan.response)
    return Projection(f"{frame_id} {describe(pattern)}", image)
