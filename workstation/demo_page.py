"""The demo's page of figures and pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from acquisition.atomic_files import write_bytes
from fitting.digital_copy import DigitalCopy
from render.views import NamedView
from workstation.demonstration import HeightError
from workstation.processing import Processed
from workstation.report_maps import draw_map
from workstation.report_page import Picture, page_templates


def write_demo_page(done: Processed, error: HeightError, seconds: float, path: Path) -> None:
    """Write ``index.html`` beside the demo's renders."""
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
    page = (
        page_templates()
        .get_template("demo.html")
        .render(canvas=figures["size_mm"], rows=rows, maps=_maps(done.copy), views=list(NamedView))
    )
    write_bytes(path, page.encode())


def _maps(copy: DigitalCopy) -> list[Picture]:
    field = copy.height_field
    sigma_um = 1e3 * np.sqrt(field.variance.astype(np.float64))
    relief = copy.relief.significant.astype(np.float64)
    return [
        Picture("Height above the canvas plane, mm", draw_map(copy, field.height, unit="mm")),
        Picture(
            "Standard error of the height, µm",
            draw_map(copy, sigma_um, unit="µm", colours="magma", limits=(0.0, 98.0)),
        ),
        Picture(
            "Significant relief and its boxes", draw_map(copy, relief, colours="Greys", boxes=True)
        ),
    ]
