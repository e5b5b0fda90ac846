"""Run time against error, drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from acquisition.atomic_files import write_bytes
from workstation.benchmarks.pipeline_scenes import Point
from workstation.report_page import figure_png


def draw_curves(points: Sequence[Point], path: Path) -> None:
    """Draw processor's time against errors of heights and of photographs kept out, as PNG.

    What nothing else beats in both is joined by a line; the defaults are a star.
    """
    figure = Figure(figsize=(13, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    _draw(left, points, lambda point: 1e3 * point.height_mm, "RMS error of heights, µm")
    _draw(right, points, lambda point: -point.heldout_db, "PSNR of photographs kept out, dB")
    right.set_yticks(ticks := right.get_yticks(), [f"{-tick:.1f}" for tick in ticks])
    write_bytes(path, figure_png(figure, dpi=110))


def _draw(axes: Axes, points: Sequence[Point], error: Callable[[Point], float], name: str) -> None:
    curves = dict.fromkeys(point.curve for point in points)
    for number, curve in enumerate(curves):
        colour = f"C{number}"
        for point in points:
            if point.curve != curve:
                continue
            label = point.name if curve == "quality" else f"{curve} {point.name}"
            mark = "*" if point.default else "o"
            size = 14 if point.default else 6
            axes.plot(point.seconds, error(point), mark, color=colour, markersize=size)
            axes.annotate(
                label,
                (point.seconds, error(point)),
                xytext=(5, 4),
                textcoords="offset points",
                fontsize=8,
            )
    front = [
        one
        for one in sorted(points, key=lambda point: point.seconds)
        if not any(
            o.seconds <= one.seconds and error(o) <= error(one) and o is not one for o in points
        )
    ]
    axes.plot([p.seconds for p in front], [error(p) for p in front], color="0.6", lw=1, zorder=0)
    axes.set_xscale("log")
    axes.set_xlabel("processor time, s")
    axes.set_ylabel(name)
    axes.margins(x=0.15)
