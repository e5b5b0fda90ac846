"""Progress of stages that take unequal times: a bar of seconds, and the time left.

What a stage is expected to take comes from its last run, or else from :func:`expected_seconds`, a
model of the work. As stages end, what is left is scaled by how the ones before compared with what
was expected of them.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from rich.console import Console
from rich.progress import Progress, ProgressColumn, SpinnerColumn, Task, TextColumn
from rich.progress_bar import ProgressBar
from rich.text import Text

from workstation.interruption import stop_if_requested
from workstation.stage_cache import StageRun

_LEAST_S = 0.05


@dataclass
class StageClock:
    """What is done of some stages, and how long the rest will take.

    Attributes
    ----------
    expected_s : dict of str to float
        Seconds of each stage, in order; stages that are not in it count once they are begun.
    """

    expected_s: dict[str, float]
    _left: dict[str, float] = field(default_factory=dict)
    _begun: float = field(default_factory=time.monotonic)
    _stage_begun: float = field(default_factory=time.monotonic)
    _current: str | None = None
    _planned_s: float = 0.0
    _taken_s: float = 0.0

    def __post_init__(self) -> None:
        self._left = {name: max(s, _LEAST_S) for name, s in self.expected_s.items()}

    @property
    def stage(self) -> str:
        """What is being done."""
        return self._current or "beginning"

    @property
    def elapsed_s(self) -> float:
        """Since the beginning."""
        return time.monotonic() - self._begun

    @property
    def left_s(self) -> float:
        """Seconds that are left, as far as is known."""
        rest = sum(s for name, s in self._left.items() if name != self._current)
        current = self._left.get(self._current or "", 0.0)
        in_stage = time.monotonic() - self._stage_begun if self._current is not None else 0.0
        return self._pace * rest + max(self._pace * current - in_stage, 0.0)

    @property
    def share(self) -> float:
        """Share of the time that has passed."""
        whole = self.elapsed_s + self.left_s
        return self.elapsed_s / whole if whole > 0 else 1.0

    @property
    def _pace(self) -> float:
        """How the stages so far compared with what was expected; trusted as they add up."""
        prior = 0.2 * sum(self.expected_s.values())
        return (self._taken_s + prior) / (self._planned_s + prior) if prior > 0 else 1.0

    def begin(self, stage: str) -> None:
        """A stage begins."""
        if self._current is not None and self._current != stage:
            # Some stages tell of their parts: what was expected of the whole is not over.
            part_of = self._left.pop(self._current, 0.0)
            in_stage = time.monotonic() - self._stage_begun
            self._left.setdefault(stage, max(part_of - in_stage, 0.0))
        if self._current != stage:
            self._current, self._stage_begun = stage, time.monotonic()

    def done(self, run: StageRun) -> None:
        """A stage has ended, or was left out."""
        expected = self._left.pop(run.name, None)
        if self._current is not None and not run.skipped:
            self._left.pop(self._current, None)
            self._current = None
        if expected is not None and not run.skipped:
            self._planned_s += expected
            self._taken_s += run.seconds


class StageProgress:
    """Shows stages as they begin and end."""

    def __init__(self, progress: Progress, title: str, clock: StageClock) -> None:
        self._progress = progress
        self._title = title
        self._clock = clock
        self._task = progress.add_task(title, total=1.0, clock=clock)

    def begin(self, stage: str) -> None:
        """A stage begins."""
        stop_if_requested()
        if stage == self._clock.stage:
            return
        self._clock.begin(stage)
        self._progress.update(self._task, description=f"{self._title}: {stage}")
        console = self._progress.console
        if not console.is_terminal:
            console.print(f"{self._title}: {stage}, {clock_text(self._clock.left_s)} left")

    def done(self, run: StageRun) -> None:
        """A stage has ended."""
        self._clock.done(run)
        if run.skipped:
            self._progress.console.print(
                f"{self._title}: {run.name} is as it was, {clock_text(run.saved_s)} saved"
            )
        stop_if_requested()


@contextmanager
def stage_progress(title: str, expected_s: Mapping[str, float]) -> Iterator[StageProgress]:
    """Show the progress of stages while the block runs; lines where stderr is no terminal.

    Parameters
    ----------
    title : str
    expected_s : mapping of str to float
        Seconds that each stage is expected to take, in order.
    """
    console = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
    clock = StageClock(dict(expected_s))
    bar = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        _Bar(),
        _Times(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    with bar:
        yield StageProgress(bar, title, clock)
    if not console.is_terminal:
        console.print(f"{title}: done in {clock.elapsed_s:.1f} s")


def clock_text(seconds: float) -> str:
    """A length of time as people say it."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {rest:02} s"


class _Bar(ProgressColumn):
    def render(self, task: Task) -> ProgressBar:
        """The share of the time that has passed."""
        return ProgressBar(total=1.0, completed=task.fields["clock"].share, width=32)


class _Times(ProgressColumn):
    def render(self, task: Task) -> Text:
        """Time passed and left."""
        clock: StageClock = task.fields["clock"]
        return Text(f"{clock_text(clock.elapsed_s)}, {clock_text(clock.left_s)} left")
