"""One module per command of the command line."""

from __future__ import annotations

import typer

from workstation.commands import (
    bench,
    calibrate,
    demo,
    devices,
    gallery,
    import_capture,
    photograph,
    process,
    render,
    replay,
    report,
    resume,
    scan,
    view,
)
from workstation.finite_options import finite_only

# In the order of the help: from the rig to the copy.
_COMMANDS = (
    demo,
    devices,
    calibrate,
    scan,
    photograph,
    resume,
    replay,
    import_capture,
    process,
    render,
    view,
    gallery,
    report,
    bench,
)


def register(app: typer.Typer) -> None:
    """Add every command to the application."""
    for module in _COMMANDS:
        module.register(app)
    for command in app.registered_commands:
        assert command.callback is not None
        command.callback = finite_only(command.callback)
