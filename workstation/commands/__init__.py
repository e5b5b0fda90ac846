"""One module per command of the command line."""

from __future__ import annotations

import typer

from workstation.commands import import_capture, process


def register(app: typer.Typer) -> None:
    """Add every command to the application."""
    for command in (import_capture, process):
        command.register(app)
