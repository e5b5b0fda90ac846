"""Rendering: the paper's two tables, every mode against a reference, and no popping.

The reference is :mod:`workstation.benchmarks.reference_rendering`. Pictures, plots and every figure
are left where a folder is named.
"""

from __future__ import annotations

from collections.abc import Collection
from enum import StrEnum
from pathlib import Path

from workstation.benchmark_records import Record
from workstation.benchmarks.render_bounds import bounded_records, exact_records, time_records
from workstation.benchmarks.render_budget import budget_curve, halving_record
from workstation.benchmarks.render_cases import measure_cases
from workstation.benchmarks.render_copy import copy_records
from workstation.benchmarks.render_path import measure_popping
from workstation.benchmarks.render_scenes import OIL, RenderedScene, oil_scene, real_scenes
from workstation.benchmarks.render_tables import table_1, table_2


class Part(StrEnum):
    """What can be measured by itself."""

    VIEWS = "views"
    """The oil painting in all modes from the six views: bounds, and the paper's table 1."""
    REAL = "real"
    """The dime and the plaster relief by their bounds, where there are real captures."""
    BUDGET = "budget"
    BOXES = "boxes"
    """The paper's table 2."""
    PATH = "path"
    COPY = "copy"


def bench(*, pictures: Path | None = None, parts: Collection[str] = tuple(Part)) -> list[Record]:
    """Every mode at six views, both tables, the budget's curve, a path, and the copy's size.

    Parameters
    ----------
    pictures : Path, optional
        Folder for pictures, plots and every figure.
    parts : collection of str
        Of :class:`Part`.
    """
    wanted = {Part(part) for part in parts}
    oil = oil_scene()
    records = []
    scenes = [oil] if Part.VIEWS in wanted else []
    scenes += real_scenes() if Part.REAL in wanted else []
    if scenes:
        records += _views(scenes, pictures)
    if Part.BUDGET in wanted:
        records += _budget(oil, pictures)
    if Part.PATH in wanted:
        records += _path(oil, pictures)
    if Part.BOXES in wanted:
        records += table_2(oil)
    if Part.COPY in wanted:
        records += copy_records(oil)
    return records


def _views(scenes: list[RenderedScene], pictures: Path | None) -> list[Record]:
    cases, shown = measure_cases(scenes)
    if pictures is not None:
        from workstation.benchmarks.render_pictures import draw_cases

        draw_cases(pictures, cases, shown)
    return [
        *exact_records(cases),
        *bounded_records(cases),
        *time_records(cases),
        *(table_1(cases) if scenes[0].name == OIL else ()),
    ]


def _budget(scene: RenderedScene, pictures: Path | None) -> list[Record]:
    curve = budget_curve(scene)
    if pictures is not None:
        from workstation.benchmarks.render_pictures import draw_curve

        draw_curve(pictures, curve)
    return [halving_record(curve)]


def _path(scene: RenderedScene, pictures: Path | None) -> list[Record]:
    popping = measure_popping(scene)
    if pictures is not None:
        from workstation.benchmarks.render_pictures import draw_popping

        draw_popping(pictures, popping)
    return popping.records()
