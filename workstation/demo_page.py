"""The demo's page of figures and pictures."""

from __future__ import annotations

import base64
from io import BytesIO
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from acquisition.atomic_files import write_bytes
from fitting.digital_copy import DigitalCopy
from render.views import NamedView
from workstation.demonstration import HeightError
from workstation.processing import Processed


def write_demo_page(done: Processed, error: HeightError, seconds: float, path: Path) -> None:
    """Write ``index.html`` beside the demo's renders."""
    environment = Environment(
        loader=PackageLoader("workstation"), autoescape=select_autoescape(default=True)
    )
    figures = done.figures
    noise = figures["height_noise"]
    rows = [
        ("height error against truth", f"{error.observed_rms_mm * 1000:.1f} µm RMS"),
        ("predicted", f"{error.predicted_rms_mm * 1000:.1f} µm RMS (ratio {error.ratio:.2f})"),
        ("bias", f"{error.bias_mm * 1000:.2f} µm"),
        ("spread of the z-scores", f"{error.spread:.2f}"),
        (
            "white noise of the range image",
            f"{noise['observed_mm'] * 1000:.1f} µm observed, "
            f"{noise['predicted_mm'] * 1000:.1f} µm predicted",
        ),
        ("texels", f"{figures['texels']} of {figures['pitch_mm']:.3f} mm"),
        ("of them on the frame or beyond", f"{error.outside_canvas}"),
        ("relief threshold δ0", f"{figures['delta0_mm']:.2f} mm, {figures['boxes']} boxes"),
        ("time in all", f"{seconds:.1f} s"),
    ]
    page = environment.get_template("demo.html").render(
        canvas=figures["size_mm"], rows=rows, maps=_maps(done.copy), views=list(NamedView)
    )
    write_bytes(path, page.encode())


def _maps(copy: DigitalCopy) -> list[tuple[str, str]]:
    field = copy.height_field
    gaps = ~field.mask
    heights: NDArray[np.floating] = np.ma.masked_array(field.height, gaps)
    sigma: NDArray[np.floating] = np.ma.masked_array(1000 * np.sqrt(field.variance), gaps)
    relief: NDArray[np.floating] = np.ma.masked_array(copy.relief.significant.astype(float), gaps)
    boxes = _plot(relief, "", copy, "Greys", boxes=True)
    return [
        ("Height above the canvas plane, mm", _plot(heights, "mm", copy, "viridis")),
        ("Standard error of the height, µm", _plot(sigma, "µm", copy, "magma", top=98.0)),
        ("Significant relief and its boxes", boxes),
    ]


def _plot(
    values: NDArray[np.floating],
    unit: str,
    copy: DigitalCopy,
    colours: str,
    *,
    top: float = 100.0,
    boxes: bool = False,
) -> str:
    """A map with its scale, as base64 PNG."""
    field = copy.height_field
    x0, y0 = field.origin_mm
    width, height = field.size_mm
    figure = Figure(figsize=(6, 6 * height / width + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    shown = axes.imshow(
        values,
        extent=(x0, x0 + width, y0 - height, y0),
        cmap=colours,
        vmax=float(np.percentile(np.ma.compressed(values), top)),
    )
    axes.set_xlabel("X, mm")
    axes.set_ylabel("Y, mm")
    if unit:
        figure.colorbar(shown, ax=axes, label=unit, shrink=0.8)
    if boxes:
        from matplotlib.patches import Rectangle

        for (row, col), (rows, cols) in zip(
            copy.relief.boxes.corner, copy.relief.boxes.size, strict=True
        ):
            corner = (x0 + col * field.pitch_mm, y0 - (row + rows) * field.pitch_mm)
            size = (cols * field.pitch_mm, rows * field.pitch_mm)
            axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor="tab:red", linewidth=0.8))
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return base64.b64encode(buffer.getvalue()).decode()
