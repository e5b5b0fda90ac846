"""Recording at the desk: what scans and photographs have in common on the command line."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path
from typing import Any

import typer

from acquisition.contact_sheet import write_contact_sheet
from acquisition.disk_space import bytes_needed, free_bytes, require_space
from acquisition.duration import estimate_duration
from acquisition.lamp_drift import measure_lamp_drift
from acquisition.plan import Plan
from acquisition.recording import record_plan
from acquisition.session import CONTACT_SHEET_FILE, Session
from acquisition.session_writer import SessionWriter
from devices.drivers import DeviceKind
from devices.errors import DeviceError
from devices.manual_mount import ManualMountSettings
from devices.rig import Rig
from devices.rig_file import RigFile
from workstation.confirmation import confirm_at_desk
from workstation.interruption import stop_if_requested
from workstation.progress import progress


def describe_plan(plan: Plan, rig: Rig, out: Path) -> dict[str, Any]:
    """Print what a plan costs, for ``--dry-run``; nothing moves and nothing is written.

    Returns
    -------
    dict
        The figures, for ``--json``.
    """
    patterned = any(frame.pattern is not None for frame in plan.frames)
    duration = estimate_duration(
        plan,
        frame_period_s=rig.projector.capabilities.frame_period_s if patterned else 0.0,
        arm=rig.arm.capabilities if rig.has_arm else None,
    )
    needed, free = bytes_needed(plan), free_bytes(out)
    counts: dict[str, int] = {}
    for frame in plan.frames:
        counts[str(frame.purpose)] = counts.get(str(frame.purpose), 0) + 1
    optional = len(plan.optional_frames)
    typer.echo(
        f"{len(plan.frames)} frames ("
        + ", ".join(f"{count} {purpose}" for purpose, count in counts.items())
        + ")"
        + (f", of which up to {optional} may turn out not to be needed" if optional else "")
    )
    if plan.metering is not None:
        rule = plan.metering
        typer.echo(
            f"metered for {rule.column_sigma_px:.3g} px of the panel's columns, "
            f"{rule.row_sigma_px:.3g} px of its rows"
        )
    typer.echo(
        f"about {_clock(duration.total_s)}: frames {_clock(duration.frames_s)}, light arm "
        f"{_clock(duration.light_s)}, by hand {_clock(duration.by_hand_s)}"
    )
    typer.echo(f"up to {needed / 1e6:,.0f} MB of disk; {free / 1e6:,.0f} MB are free")
    return {
        "frames": len(plan.frames),
        "frames_by_purpose": counts,
        "optional_frames": optional,
        "seconds": duration.total_s,
        "seconds_frames": duration.frames_s,
        "seconds_light": duration.light_s,
        "seconds_by_hand": duration.by_hand_s,
        "bytes_needed": needed,
        "bytes_free": free,
    }


def record_session(
    plan: Plan, rig: Rig, out: Path, *, calibration: Path | None = None
) -> dict[str, Any]:
    """Record a new session with progress, and draw its contact sheet.

    Returns
    -------
    dict
        Figures, as of :func:`finish_session`.

    Raises
    ------
    SessionError
        The folder exists, or the disk is too small or fails.
    DeviceError
        A device failed; what was recorded can be resumed.
    """
    require_space(out, bytes_needed(plan), what=f"{len(plan.frames)} frames")
    with SessionWriter.create(
        out, plan, rig_toml=rig.toml or None, calibration=calibration
    ) as writer:
        return finish_session(writer, rig)


def finish_session(writer: SessionWriter, rig: Rig) -> dict[str, Any]:
    """Record what a session still misses, with progress; then draw its contact sheet.

    Returns
    -------
    dict
        Figures: frames, skipped ones with their reasons, digest, saturation, the lamp's drift.
    """
    left = len(writer.missing)
    with progress(f"recording {writer.path}", total=left) as steps:

        def advance(frame_id: str) -> None:
            stop_if_requested()
            steps.advance()

        record_plan(writer, rig, advance=advance, confirm=confirm_at_desk)
    return report_session(writer.path)


def report_session(path: Path) -> dict[str, Any]:
    """Draw a finished session's contact sheet, print what was recorded, and return its figures."""
    session = Session.open(path)
    frames = write_contact_sheet(session)
    drift = measure_lamp_drift(session)
    worst = max((abs(sample.ratio - 1) for sample in drift), default=None)
    saturated = max((frame.saturated for frame in frames), default=0.0)
    skipped = f", {len(session.skipped)} not needed" if session.skipped else ""
    typer.echo(f"{path}: {len(session.recorded)} frames{skipped}")
    for reason, count in Counter(str(e.reason) for e in session.skipped.values()).items():
        typer.echo(f"  {count}: {reason}")
    if worst is not None:
        typer.echo(f"the lamp drifted by {100 * worst:.2f} % at most")
    typer.echo(f"look at {path / CONTACT_SHEET_FILE}")
    return {
        "frames": len(session.recorded),
        "skipped": [
            {"id": e.id, "reason": str(e.reason), "pixels": e.pixels, "saturating": e.saturating}
            for e in session.skipped.values()
        ],
        "digest": session.digest,
        "largest_saturated_share": saturated,
        "largest_lamp_drift": worst,
        "contact_sheet": [
            {
                "id": frame.id,
                "exposure_s": frame.exposure_s,
                "saturated": frame.saturated,
                "modulation": frame.modulation,
            }
            for frame in frames
        ],
    }


def keeping_its_place(rig_file: RigFile, session: Session) -> RigFile:
    """A rig whose camera, if it is moved by hand, is taken to stand where it last did.

    Raises
    ------
    DeviceError
        Nobody confirms that it stands there.
    """
    mount = rig_file.devices.get(DeviceKind.MOUNT)
    places = [f.camera_position for f in session.frames if f.camera_position is not None]
    if not places or not isinstance(mount, ManualMountSettings):
        return rig_file
    place = places[-1]
    if place not in mount.positions:
        raise DeviceError(
            f"the session goes on with the camera at {place!r}, which {rig_file.path} has no place "
            f"for; it names {', '.join(mount.positions)}"
        )
    if not confirm_at_desk(f"See that the camera stands at {place}, unmoved since the last frame."):
        raise DeviceError(
            f"nobody confirmed that the camera stands at {place} as it did: what was recorded from "
            "there could not be registered with the rest; record it anew if the camera was moved"
        )
    kept = mount.model_copy(update={"start": place})
    return dataclasses.replace(rig_file, devices=rig_file.devices | {DeviceKind.MOUNT: kept})


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
