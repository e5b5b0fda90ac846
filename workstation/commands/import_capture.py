"""``impasto import``: a foreign capture becomes a session."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from workstation.json_output import JsonOption, write_json


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("import")(import_capture)


def import_capture(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the captured files.")],
    capture: Annotated[
        Path, typer.Option(help="Description of the files (see docs/file-formats.md).")
    ],
    out: Annotated[Path, typer.Option(metavar="SESSION", help="Session folder to make.")],
    json: JsonOption = None,
) -> None:
    """Import a scan made by other software as a session.

    Example:

        impasto import photos/ --capture capture.toml --out session/
    """
    import shutil

    from acquisition.atomic_files import folder_in_progress
    from acquisition.capture_description import read_description
    from acquisition.errors import SessionError
    from acquisition.foreign_capture import find_capture, record_capture
    from acquisition.session import Session
    from calibration.opencv_files import read_rig_geometry
    from workstation.destinations import check_destinations
    from workstation.interruption import too_late_to_stop
    from workstation.progress import progress

    check_destinations(folder, capture, makes={"--out": out}, writes={"--json": json})
    description = read_description(capture)
    found = find_capture(folder, description)
    rig = original = None
    if description.calibration is not None:
        original = folder / description.calibration.file
        rig = read_rig_geometry(
            original,
            description.calibration,
            camera=description.camera,
            projector=description.projector,
        )
    check_destinations(*found.files.values(), original, writes={"--json": json})
    if out.exists():
        raise SessionError(f"{out} exists already; choose another place, or remove it first")
    with (
        progress(f"importing {description.name}", total=len(found.files)) as steps,
        folder_in_progress(out) as folder_being_made,
        TemporaryDirectory() as stage,
    ):
        if rig is not None and original is not None:
            rig.save(Path(stage))
            shutil.copy(original, stage)
        record_capture(
            found,
            folder_being_made,
            calibration=Path(stage) if rig is not None else None,
            advance=lambda _: steps.advance(),
        )
        too_late_to_stop()
    session = Session.open(out)
    write_json(json, {"frames": len(session.plan.frames), "digest": session.digest})
    typer.echo(f"{out}: {len(session.plan.frames)} frames")
