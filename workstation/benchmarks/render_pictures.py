"""Pictures of the renderer's benchmark: what the modes show, and plots of its figures."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from statistics import median

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter

from render.painting_node import Mode
from render.picture_files import write_contact_sheet
from render.views import NamedView
from workstation.benchmarks.picture_differences import encode
from workstation.benchmarks.render_cases import Case, Pictures, find_cases
from workstation.benchmarks.render_path import Popping
from workstation.benchmarks.render_scenes import OIL, SIZES
from workstation.json_output import write_json
from workstation.pareto_front import pareto_front

_LEAST_PX = 1e-4  # what a logarithmic axis shows of no parallax
_COLOURS = {mode: f"C{number}" for number, mode in enumerate(Mode)}


def draw_cases(folder: Path, cases: list[Case], pictures: Pictures) -> None:
    """Every figure, what the modes show, and time against error."""
    write_json(folder / "cases.json", [asdict(case) for case in cases])
    if not pictures:
        return
    rows = ["reference", *(str(mode) for mode in Mode)]
    views = [str(view) for view in NamedView]
    sheet = [
        [np.round(255 * encode(pictures[row, view]))[::2, ::2].astype(np.uint8) for view in views]
        for row in rows
    ]
    write_contact_sheet(sheet, rows, views, folder / "contact.png")
    _draw_time_and_error(folder / "time-and-error.png", cases)


def _draw_time_and_error(path: Path, cases: list[Case]) -> None:
    """What no other mode beats in both is joined by a line."""
    width, height = SIZES[0]
    figure = Figure(figsize=(13, 7.5), layout="constrained")
    for axis, view in zip(figure.subplots(2, 3).flat, NamedView, strict=True):
        found = find_cases(cases, scene=OIL, size=f"{width}x{height}", view=view)
        points = {
            mode: (median(case.pass_ms), max(case.difference.parallax_px[1], _LEAST_PX))
            for mode, case in found.items()
            if case.difference is not None
        }
        best = pareto_front(points.values(), lambda point: point)
        axis.loglog(*zip(*best, strict=True), color="0.7", zorder=0)
        for mode, (ms, error) in points.items():
            axis.loglog(ms, error, "o", color=_COLOURS[Mode(mode)], label=mode)
        axis.axhline(0.25, color="0.5", linewidth=0.5, linestyle="--")
        axis.set(title=view, xlabel="painting pass (ms)", ylabel="95 % parallax (px)")
        axis.xaxis.set_major_formatter(ScalarFormatter())
        axis.xaxis.set_minor_formatter(NullFormatter())
    figure.legend(*axis.get_legend_handles_labels(), loc="outside right upper")
    figure.savefig(path, dpi=100)


def draw_curve(folder: Path, curve: dict[float, float]) -> None:
    """The bounded mode's error over its budget."""
    figure = Figure(figsize=(5.5, 4.5), layout="constrained")
    axis = figure.add_subplot()
    axis.loglog(list(curve), list(curve.values()), "o-", label="bounded")
    axis.loglog(list(curve), list(curve), ":", color="0.5", label="the budget itself")
    axis.set(xlabel="budget (px)", ylabel="95 % parallax (px), in shot at grazing angle")
    axis.legend()
    figure.savefig(folder / "budget.png", dpi=100)


def draw_popping(folder: Path, popping: Popping) -> None:
    """FLIP from frame to frame beyond the reference's."""
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    axis = figure.add_subplot()
    for mode, excess in popping.excess.items():
        axis.plot(excess, label=mode, color=_COLOURS[Mode(mode)])
    axis.axhline(0.002, color="0.5", linewidth=0.5, linestyle="--")
    axis.set(xlabel="frame", ylabel="FLIP to the frame before, beyond the reference's")
    axis.legend()
    figure.savefig(folder / "popping.png", dpi=100)
