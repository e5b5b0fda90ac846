"""Progress on stderr: a bar with the time left, or plain lines where stderr is no terminal."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from workstation.interruption import stop_if_requested


class Steps:
    """Counts the steps of one long job."""

    def __init__(self, progress: Progress, title: str, total: int) -> None:
        self._progress = progress
        self._title = title
        self._task = progress.add_task(title, total=total)

    def begin(self, step: str) -> None:
        """Say what is being done now."""
        stop_if_requested()
        self._progress.update(self._task, description=f"{self._title}: {step}")
        if not self._progress.console.is_terminal:
            self._progress.console.print(f"{self._title}: {step}", highlight=False)

    def advance(self) -> None:
        """One step is done."""
        stop_if_requested()
        self._progress.advance(self._task)


@contextmanager
def progress(title: str, *, total: int) -> Iterator[Steps]:
    """Show the progress of ``total`` steps while the block runs.

    Where stderr is no terminal there is a line at the beginning and one at the end instead.
    """
    console = Console(stderr=True, highlight=False, markup=False)
    bar = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    begun = time.monotonic()
    if not console.is_terminal:
        console.print(title)
    with bar:
        yield Steps(bar, title, total)
    if not console.is_terminal:
        console.print(f"{title}: done in {time.monotonic() - begun:.1f} s")
