"""The relief classification as a picture: the four panels of the paper's figure 2."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.atomic_files import file_in_progress
from fitting.digital_copy import DigitalCopy

_LARGEST_SIDE_PX = 1200


def draw_relief(copy: DigitalCopy, path: Path) -> None:
    """Draw heights, hard threshold, cleaned mask and boxes side by side into a PNG file.

    Parameters
    ----------
    copy : DigitalCopy
    path : Path
        File to write, whole or not at all; one that is there is replaced.
    """
    # Imported here: start-up of the command line would pay for it.
    from matplotlib.figure import Figure

    field, relief = copy.height_field, copy.relief
    width, height = field.size_mm
    # Two by two, or side by side where the painting is tall.
    rows, cols = (2, 2) if width > 0.8 * height else (1, 4)
    panel_width = 12.0 / cols
    size = (12.8, rows * (panel_width * height / width + 0.6))
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    axes = figure.subplots(rows, cols, squeeze=False).ravel()
    left, top = field.origin_mm[0], field.origin_mm[1]
    half = 0.5 * field.pitch_mm
    extent = (left - half, left - half + width, top + half - height, top + half)
    low, high = np.quantile(field.height[field.mask], [0.001, 0.9995])
    heights = _thin(np.where(field.mask, field.height, np.nan))
    tall = field.mask & (field.height > relief.delta0_mm)
    shown = axes[0].imshow(heights, extent=extent, cmap="viridis", vmin=low, vmax=high)
    figure.colorbar(shown, ax=axes[0], fraction=0.04, label="mm")
    axes[0].set_title("heights above the canvas plane")
    axes[1].imshow(_thin(_shades(field.mask, tall)), extent=extent, cmap="gray", vmin=0, vmax=2)
    axes[1].set_title(f"above δ0 = {relief.delta0_mm:.3g} mm: {tall.sum()} texels")
    cleaned = _shades(field.mask, relief.significant)
    axes[2].imshow(_thin(cleaned), extent=extent, cmap="gray", vmin=0, vmax=2)
    axes[2].set_title(f"cleaned: {relief.significant.sum()} texels")
    axes[3].imshow(heights, extent=extent, cmap="gray", vmin=low, vmax=high)
    _draw_boxes(axes[3], copy)
    axes[3].set_title(f"{len(relief.boxes)} boxes of {relief.cell} × {relief.cell} texels")
    for panel in axes:
        panel.set_xlim(extent[:2])
        panel.set_ylim(extent[2:])
        panel.tick_params(labelsize=8)
        panel.set_title(panel.get_title(), fontsize=10)
    with file_in_progress(Path(path)) as temporary:
        figure.savefig(temporary, format="png")


def _thin(picture: NDArray[np.floating]) -> NDArray[np.floating]:
    step = max(1, max(picture.shape) // _LARGEST_SIDE_PX)
    return picture[::step, ::step]


def _shades(mask: NDArray[np.bool_], marked: NDArray[np.bool_]) -> NDArray[np.float32]:
    """0 for gaps, 1 for the canvas, 2 for what is marked."""
    return mask.astype(np.float32) + marked


def _draw_boxes(panel, copy: DigitalCopy) -> None:  # type: ignore[no-untyped-def]
    from matplotlib.collections import PolyCollection

    field, boxes = copy.height_field, copy.relief.boxes
    first = boxes.corner - 0.5
    last = first + boxes.size
    left, right = (field.origin_mm[0] + field.pitch_mm * at[:, 1] for at in (first, last))
    top, bottom = (field.origin_mm[1] - field.pitch_mm * at[:, 0] for at in (first, last))
    around = ((left, top), (right, top), (right, bottom), (left, bottom))
    corners = np.stack([np.stack(corner, axis=1) for corner in around], axis=1)
    panel.add_collection(
        PolyCollection(list(corners), facecolors=(1, 0.3, 0, 0.25), edgecolors="orangered", lw=0.4)
    )
