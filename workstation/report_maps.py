"""Maps of a copy as pictures for reports: with scale, unit, and lengths in mm along their edges.

All maps of a copy have one scale and one place in their pictures, so that pictures that stand side
by side can be compared point by point.
"""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy
from workstation.report_page import figure_png

_LARGEST_SIDE_PX = 1200
_DPI = 150
# Inches: the largest map, and what is around it for its edges' lengths and the colours' scale.
_MAP_IN = (3.6, 4.6)
_LEFT_IN, _RIGHT_IN, _BELOW_IN, _ABOVE_IN = 0.6, 1.0, 0.5, 0.12
_BAR_IN, _BAR_GAP_IN = 0.13, 0.1
_FONT = 9


def draw_map(
    copy: DigitalCopy,
    values: NDArray[np.floating],
    *,
    scale: str = "",
    colours: str = "viridis",
    limits: tuple[float, float] = (0.0, 100.0),
    span: tuple[float, float] | None = None,
    boxes: bool = False,
) -> bytes:
    """Draw a map of a copy's texels.

    Parameters
    ----------
    copy : DigitalCopy
    values : (rows, cols) or (rows, cols, 3) array
        Numbers, or display colours from 0 to 1; gaps of the copy stay empty.
    scale : str
        What the numbers are and their unit; a scale of colours is drawn where it is given.
    colours : str
        Name of a matplotlib colour map.
    limits : (float, float)
        Percentiles of the numbers at which the colours end. The scale points beyond an end that
        numbers are beyond.
    span : (float, float), optional
        Numbers at which they end instead, for maps that are to be compared.
    boxes : bool
        Whether the relief boxes are outlined.

    Returns
    -------
    bytes
        PNG.
    """
    field = copy.height_field
    width, height = field.size_mm
    left, top = field.origin_mm[0] - field.pitch_mm / 2, field.origin_mm[1] + field.pitch_mm / 2
    extent = (left, left + width, top - height, top)
    figure, axes, place = _figure(width, height)
    step = max(1, max(field.shape) // _LARGEST_SIDE_PX)
    mask = field.mask[::step, ::step]
    shown = values[::step, ::step]
    if shown.ndim == 3:
        opaque = np.dstack([np.clip(shown, 0, 1), mask.astype(shown.dtype)])
        axes.imshow(opaque, extent=extent)
    else:
        low, high = percentiles(copy, values, limits) if span is None else span
        masked: NDArray[np.floating] = np.ma.masked_array(shown, ~mask)
        image = axes.imshow(masked, extent=extent, cmap=colours, vmin=low, vmax=high)
        if scale:
            beyond = _beyond(values[field.mask], low, high)
            bar = figure.colorbar(image, cax=figure.add_axes(place), extend=beyond)
            bar.set_label(scale, fontsize=_FONT)
            bar.ax.tick_params(labelsize=_FONT)
    if boxes:
        axes.add_collection(_boxes(copy))
    _draw_length(axes, width)
    axes.set_xlabel("X, mm", fontsize=_FONT)
    axes.set_ylabel("Y, mm", fontsize=_FONT)
    axes.tick_params(labelsize=_FONT)
    axes.set_xlim(extent[:2])
    axes.set_ylim(extent[2:])
    return figure_png(figure, dpi=_DPI)


def percentiles(
    copy: DigitalCopy, values: NDArray[np.floating], limits: tuple[float, float]
) -> tuple[float, float]:
    """Two percentiles of a map's numbers, gaps left out; 0 and 1 where there are none."""
    finite = values[copy.height_field.mask & np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = np.percentile(finite, limits)
    return float(low), float(high)


def _figure(width: float, height: float) -> tuple[Figure, Axes, tuple[float, float, float, float]]:
    """A figure with axes for a map of a size, and the place of its scale of colours."""
    inch = min(_MAP_IN[0] / width, _MAP_IN[1] / height)
    across, down = width * inch, height * inch
    # Narrow paintings stand in pictures as wide as any other: text is of one size on a page.
    wide, high = _LEFT_IN + _MAP_IN[0] + _RIGHT_IN, _BELOW_IN + down + _ABOVE_IN
    left = _LEFT_IN + (_MAP_IN[0] - across) / 2
    figure = Figure(figsize=(wide, high))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((left / wide, _BELOW_IN / high, across / wide, down / high))
    bar = (left + across + _BAR_GAP_IN) / wide, _BELOW_IN / high, _BAR_IN / wide, down / high
    return figure, axes, bar


def _beyond(values: NDArray[np.floating], low: float, high: float) -> str:
    """Which ends of a scale numbers lie beyond, in matplotlib's words."""
    below, above = bool((values < low).any()), bool((values > high).any())
    return {(True, True): "both", (True, False): "min", (False, True): "max"}.get(
        (below, above), "neither"
    )


def shaded_relief(
    copy: DigitalCopy, *, azimuth_deg: float = 315.0, altitude_deg: float = 30.0
) -> NDArray[np.float64]:
    """The relief as matt plaster under one light, as display values.

    Returns
    -------
    (rows, cols, 3) float64 array
    """
    field = copy.height_field
    filled = np.where(field.mask, field.height, np.median(field.height[field.mask]))
    light = LightSource(azimuth_deg, altitude_deg)
    # Rows run from the painting's top down, as the light source takes them.
    shade = light.hillshade(filled, dx=field.pitch_mm, dy=field.pitch_mm)
    return np.asarray(np.repeat(shade[..., None], 3, axis=-1))


def _boxes(copy: DigitalCopy) -> PatchCollection:
    field, boxes = copy.height_field, copy.relief.boxes
    left, top = field.origin_mm[0] - field.pitch_mm / 2, field.origin_mm[1] + field.pitch_mm / 2
    outlines = [
        Rectangle(
            (left + col * field.pitch_mm, top - (row + rows) * field.pitch_mm),
            cols * field.pitch_mm,
            rows * field.pitch_mm,
        )
        for (row, col), (rows, cols) in zip(boxes.corner, boxes.size, strict=True)
    ]
    return PatchCollection(outlines, facecolor=(1, 0.3, 0, 0.25), edgecolor="orangered", lw=0.5)


def _draw_length(axes: Axes, width_mm: float) -> None:
    """A bar of a round length, about a fifth of the width."""
    target = width_mm / 5
    decade = 10 ** math.floor(math.log10(target))
    length = max(n * decade for n in (1, 2, 5) if n * decade <= target)
    x0, x1 = axes.get_xlim()
    y0, y1 = axes.get_ylim()
    x, y = x0 + 0.04 * (x1 - x0), y0 + 0.05 * (y1 - y0)
    axes.plot(
        [x, x + length],
        [y, y],
        color="black",
        linewidth=3,
        solid_capstyle="butt",
        path_effects=[withStroke(linewidth=6, foreground="white")],
    )
    axes.text(
        x + length / 2,
        y + 0.02 * (y1 - y0),
        f"{length:g} mm",
        ha="center",
        va="bottom",
        fontsize=_FONT,
        path_effects=[withStroke(linewidth=3, foreground="white")],
    )
