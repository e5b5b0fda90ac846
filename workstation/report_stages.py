"""The part of a report that says what each stage took, and what was not done."""

from __future__ import annotations

from typing import Any

from acquisition.session import Session
from workstation.report_page import Section, Table
from workstation.stage_progress import clock_text


def stages_section(run: dict[str, Any], sessions: tuple[Session, ...]) -> Section:
    """Time and memory of stages, and skipped work with what it would have cost.

    Parameters
    ----------
    run : dict
        Record of a run (``COPY-run.json``).
    sessions : tuple of Session
        What was processed.
    """
    rows: list[tuple[str, ...]] = []
    for stage in run.get("stages", ()):
        skipped = stage["skipped"]
        took = stage["saved_s"] if skipped else stage["seconds"]
        peak = f"{stage['peak_mb']:.0f} MB" if stage.get("peak_mb") else "not known"
        done = f"kept from before: {clock_text(took)} spared" if skipped else clock_text(took)
        rows.append((str(stage["name"]), done, peak))
    taken = sum(s["seconds"] for s in run.get("stages", ()))
    spared = sum(s["saved_s"] for s in run.get("stages", ()))
    rows.append(("in all", f"{clock_text(taken)}, {clock_text(spared)} spared", ""))
    tables = [Table(tuple(rows), ("stage", "time", "most memory"))]
    skipped_rows = [*_skipped_frames(sessions), *_skipped_rays(run)]
    if skipped_rows:
        tables.append(Table(tuple(skipped_rows), ("not done", "how much", "would have cost")))
    text = "What is kept from before was made from the same recording by the same program."
    if run.get("quality"):
        expected = sum((run.get("expected_seconds") or {}).values())
        foreseen = (
            f", which was expected to take {clock_text(expected)} if every stage ran"
            if expected > 0
            else ""
        )
        text = f"Quality {run['quality']}{foreseen}. {text}"
    return Section("Stages", text, tables=tuple(tables))


def _skipped_frames(sessions: tuple[Session, ...]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for session in sessions:
        if not session.skipped:
            continue
        planned = {frame.id: frame.exposure_s or 0.0 for frame in session.plan.frames}
        seconds = sum(planned[name] for name in session.skipped)
        rows.append(
            (
                f"exposures of {session.path.name} that no pixel needed",
                f"{len(session.skipped)} of {len(session.plan.frames)} frames",
                f"{clock_text(seconds)} of exposure",
            )
        )
    return rows


def _skipped_rays(run: dict[str, Any]) -> list[tuple[str, ...]]:
    rays = run.get("rays")
    if not rays or not rays["tested"]:
        return []
    spared = rays["tested"] - rays["cast"]
    return [
        (
            "rays towards what stands above the local horizon",
            f"{spared} of {rays['tested']}",
            f"{rays['tested'] / max(rays['cast'], 1) - 1:.1f} times the rays that were cast",
        )
    ]
