"""``impasto replay``: a session recorded again from its own frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from workstation.json_output import JsonOption, write_json

if TYPE_CHECKING:
    from acquisition.session import Session


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("replay")(replay)


def replay(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="A recorded session.")],
    out: Annotated[Path, typer.Option(metavar="NEW", help="Session folder to make.")],
    json: JsonOption = None,
) -> None:
    """Run a session's recording again, with devices that answer from its frames.

    The new session must come out as the old one; what the old one does not hold is refused by name.

    Example:

        impasto replay session/ --out again/
    """
    from acquisition.atomic_files import folder_in_progress
    from acquisition.errors import SessionError
    from acquisition.recorded_frames import open_for_replay, recording_of, rig_toml
    from acquisition.recording import record_plan
    from acquisition.session import Session
    from acquisition.session_writer import SessionWriter
    from devices.replay import replay_rig
    from workstation.destinations import check_destinations
    from workstation.interruption import too_late_to_stop
    from workstation.progress import progress

    check_destinations(session, makes={"--out": out}, writes={"--json": json})
    if out.exists():
        raise SessionError(f"{out} exists already; choose another place, or remove it first")
    source = open_for_replay(session)
    recording = recording_of(source)
    calibration = source.calibration_folder
    with (
        progress(f"replaying {session}", total=len(source.plan.frames)) as steps,
        folder_in_progress(out) as folder,
        replay_rig(recording) as rig,
    ):
        with SessionWriter.create(
            folder, source.plan, rig_toml=rig_toml(source), calibration=calibration
        ) as writer:
            record_plan(
                writer,
                rig,
                advance=lambda _: steps.advance(),
                confirm=lambda request: True,
                wait=lambda seconds: None,
            )
        changed = _changed_files(source, Session.open(folder))
        if changed:
            raise SessionError(
                f"{session} does not replay as it was recorded: {', '.join(changed)} came out "
                "otherwise; frames with the same samples would be the same"
            )
        too_late_to_stop()
    digest = Session.open(out).digest
    identical = digest == source.digest
    write_json(
        json,
        {"frames": len(source.recorded), "digest": digest, "identical": identical},
    )
    typer.echo(
        f"{out}: {len(source.recorded)} frames, "
        + ("identical to the recording" if identical else "the same samples in other files")
    )


def _changed_files(old: Session, new: Session) -> list[str]:
    """Files of two sessions that say something else, in whatever bytes they say it."""
    import numpy as np

    if old.digest == new.digest:
        return []
    changed = [
        entry.file
        for frame_id, entry in old.recorded.items()
        if frame_id not in new.recorded
        or (
            entry.sha256 != new.recorded[frame_id].sha256
            and not np.array_equal(old.read_frame(frame_id), new.read_frame(frame_id))
        )
    ]
    if old.plan != new.plan:
        changed.append("plan.json")
    return changed
