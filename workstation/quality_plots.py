"""Run time against error, drawn."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from workstation.pareto_front import pareto_front
from workstation.quality_curve import QUALITY, CurvePoint, QualityCurve
from workstation.report_page import Picture, figure_png

_DPI = 150
# Of a number from its point.
_REACH_IN = 0.17


def curve_pictures(curve: QualityCurve, *, chosen: str | None = None) -> tuple[Picture, Picture]:
    """Time of rig and processor against errors of heights, and of photographs kept out.

    What nothing else beats in the two figures of a picture is joined by a line; the defaults are a
    star.

    Parameters
    ----------
    curve : QualityCurve
    chosen : str, optional
        A quality, which gets a ring.
    """
    heights = _draw(curve, chosen, lambda point: 1e3 * point.height_mm, "RMS error of heights, µm")
    photographs = _draw(
        curve, chosen, lambda point: -point.heldout_db, "PSNR of photographs kept out, dB"
    )
    return (
        Picture("Time and the error of heights; lower is better", heights),
        Picture("Time and photographs kept out of the fit; lower is better", photographs),
    )


def _draw(
    curve: QualityCurve,
    chosen: str | None,
    error: Callable[[CurvePoint], float],
    name: str,
) -> bytes:
    figure = Figure(figsize=(5.8, 4.1), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    colours = {name: f"C{n}" for n, name in enumerate(dict.fromkeys(p.curve for p in curve.points))}
    for number, point in enumerate(curve.points, start=1):
        ringed = point.name == chosen
        _mark(axes, number, point, error(point), colours[point.curve], ringed=ringed)
    front = pareto_front(curve.points, lambda point: (point.total_s, error(point)))
    axes.plot([p.total_s for p in front], [error(p) for p in front], color="0.6", lw=1, zorder=0)
    axes.set_xscale("log")
    # Before the scale is asked for its ticks.
    axes.margins(x=0.2, y=0.1)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(lambda value, _: f"{abs(value):.1f}")
    axes.set_xlabel("recording and processing, s")
    axes.set_ylabel(name)
    # Settings that cost and give nearly the same would write over one another by their names.
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=8)
    figure.draw_without_rendering()
    _number(axes, np.array([(p.total_s, error(p)) for p in curve.points]), inch=figure.dpi)
    return figure_png(figure, dpi=_DPI)


def _mark(
    axes: Axes, number: int, point: CurvePoint, error: float, colour: str, *, ringed: bool
) -> None:
    mark, size = ("*", 14) if point.default else ("o", 6)
    name = f"{number}  {point.label}"
    axes.plot(point.total_s, error, mark, color=colour, markersize=size, label=name)
    if ringed and point.curve == QUALITY:
        axes.plot(point.total_s, error, "o", color="0.2", markersize=20, fillstyle="none")


def _number(axes: Axes, points: NDArray[np.float64], *, inch: float) -> None:
    """Write its number beside each point, on the side that is the farthest from all others."""
    places = axes.transData.transform(points) / inch
    turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    around = _REACH_IN * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    taken = places
    for number, (point, place) in enumerate(zip(points, places, strict=True), start=1):
        free = np.linalg.norm((place + around)[:, np.newaxis] - taken, axis=2).min(axis=1)
        offset = around[np.argmax(np.round(free, 6))]
        taken = np.vstack([taken, place + offset])
        axes.annotate(
            str(number),
            point,
            xytext=72 * offset,
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=8,
        )
