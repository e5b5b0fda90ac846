"""Maps of a copy as pictures for reports: with scale, unit, and lengths in mm along their edges."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from fitting.digital_copy import DigitalCopy
from workstation.report_page import figure_png

_LARGEST_SIDE_PX = 1200
_DPI = 110
_WIDTH_IN = 7.0


def draw_map(
    copy: DigitalCopy,
    values: NDArray[np.floating],
    *,
    unit: str = "",
    colours: str = "viridis",
    limits: tuple[float, float] = (0.0, 100.0),
    boxes: bool = False,
) -> bytes:
    """Draw a map of a copy's texels.

    Parameters
    ----------
    copy : DigitalCopy
    values : (rows, cols) or (rows, cols, 3) array
        Numbers, or display colours from 0 to 1; gaps of the copy stay empty.
    unit : str
        Of the numbers; a scale is drawn where there is one.
    colours : str
        Name of a matplotlib colour map.
    limits : (float, float)
        Percentiles of the numbers at which the colours end.
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
    figure = Figure(figsize=(_WIDTH_IN, _WIDTH_IN * height / width + 0.7), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    step = max(1, max(field.shape) // _LARGEST_SIDE_PX)
    mask = field.mask[::step, ::step]
    shown = values[::step, ::step]
    if shown.ndim == 3:
        opaque = np.dstack([np.clip(shown, 0, 1), mask.astype(shown.dtype)])
        axes.imshow(opaque, extent=extent)
    else:
        finite = values[field.mask & np.isfinite(values)]
        low, high = np.percentile(finite, limits) if finite.size else (0.0, 1.0)
        masked: NDArray[np.floating] = np.ma.masked_array(shown, ~mask)
        image = axes.imshow(masked, extent=extent, cmap=colours, vmin=low, vmax=high)
        if unit:
            figure.colorbar(image, ax=axes, label=unit, shrink=0.8)
    if boxes:
        axes.add_collection(_boxes(copy))
    _scale_bar(axes, width)
    axes.set_xlabel("X, mm")
    axes.set_ylabel("Y, mm")
    axes.set_xlim(extent[:2])
    axes.set_ylim(extent[2:])
    return figure_png(figure, dpi=_DPI)


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
    return PatchCollection(outlines, facecolor="none", edgecolor="tab:red", linewidth=0.7)


def _scale_bar(axes, width_mm: float) -> None:  # type: ignore[no-untyped-def]
    """A bar of a round length, about a fifth of the width."""
    target = width_mm / 5
    decade = 10 ** math.floor(math.log10(target))
    length = max(n * decade for n in (1, 2, 5) if n * decade <= target)
    x0, x1 = axes.get_xlim()
    y0, y1 = axes.get_ylim()
    x, y = x0 + 0.04 * (x1 - x0), y0 + 0.05 * (y1 - y0)
    axes.plot([x, x + length], [y, y], color="white", linewidth=4, solid_capstyle="butt")
    axes.plot([x, x + length], [y, y], color="black", linewidth=2, solid_capstyle="butt")
    axes.text(
        x + length / 2,
        y + 0.015 * (y1 - y0),
        f"{length:g} mm",
        ha="center",
        va="bottom",
        fontsize=8,
        bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.5},
    )
