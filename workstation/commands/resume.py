"""``impasto resume``: going on with a recording that was cut off."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from workstation.json_output import JsonOption, write_json


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("resume")(resume)


def resume(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="A session cut off.")],
    rig: Annotated[
        Path | None,
        typer.Option(metavar="RIG.toml", help="Rig to go on with; by default, the session's own."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what is missing; record nothing.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Go on with a scan or photographs, after whatever cut them off.

    The session ends as if it had never been interrupted. A camera that is moved by hand must stand
    where it stood at the last frame: photographs are registered by the code seen from there.

    Example:

        impasto resume session/
    """
    from acquisition.errors import SessionError
    from acquisition.recorded_frames import open_for_replay
    from acquisition.session import RIG_FILE
    from acquisition.session_writer import SessionWriter
    from devices.rig_file import read_rig_file
    from workstation.confirmation import confirm_at_desk
    from workstation.destinations import check_destinations
    from workstation.recording import finish_session, keeping_its_place, report_session

    check_destinations(session, rig, writes={"--json": json})
    so_far = open_for_replay(session)
    if so_far.digest:
        typer.echo(f"{session} is complete: there is nothing to resume")
        write_json(json, report_session(session))
        return
    left = len(so_far.plan.frames) - len(so_far.recorded) - len(so_far.skipped)
    if dry_run:
        write_json(json, {"frames": len(so_far.plan.frames), "missing": left})
        typer.echo(f"{left} of {len(so_far.plan.frames)} frames are missing")
        return
    described = rig or session / RIG_FILE
    if not described.is_file():
        raise SessionError(
            f"{session} does not say which rig recorded it; name one with --rig RIG.toml"
            if rig is None
            else f"{rig}: no such file"
        )
    file = keeping_its_place(read_rig_file(described), so_far)
    # The session first: one that is being recorded has its devices in use.
    with (
        SessionWriter.resume(session) as writer,
        file.open(confirm=confirm_at_desk) as opened,
    ):
        figures = finish_session(writer, opened)
    write_json(json, figures)
