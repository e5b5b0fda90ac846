"""One module per command of the command line."""

from __future__ import annotations

import typer

from workstation.commands import bench, demo, devices, import_capture, process, render, replay


def register(app: typer.Typer) -> None:
    """Add every command to the application."""
    for command in (demo, devices, import_capture, replay, process, render, bench):
        command.register(app)
