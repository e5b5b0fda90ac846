"""Pictures of the report's optional parts: the lamp's positions, responses, and the flat field."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from calibration.flat_field import FlatField
from workstation.report_page import figure_png
from workstation.report_sections import LightSection, ResponseCurve

_DPI = 150


def light_picture(lights: LightSection) -> bytes:
    """The lamp's positions in space, coloured by what the model leaves, as PNG."""
    figure = Figure(figsize=(4.6, 3.7), dpi=_DPI)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(projection="3d")
    # The label of the third axis stands beside the place.
    axes.set_position((0.0, 0.02, 0.7, 0.98))
    seen = np.isfinite(lights.residual_deg)
    # Poses without a highlight are known by the model alone.
    axes.scatter(*lights.position_mm[~seen].T, color="#999", s=12, depthshade=False)
    shown = axes.scatter(
        *lights.position_mm[seen].T,
        c=lights.residual_deg[seen],
        cmap="viridis",
        s=18,
        depthshade=False,
    )
    for one in lights.position_mm:
        axes.plot(*np.stack([one, one * [1, 1, 0]], axis=1), color="#888", lw=0.6)
    axes.scatter([0], [0], [0], color="#b3402a", marker="s", s=24)
    axes.set_xlabel("X, mm", fontsize=8)
    axes.set_ylabel("Y, mm", fontsize=8)
    axes.set_zlabel("Z, mm", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.set_aspect("equal")
    bar = figure.colorbar(shown, cax=figure.add_axes((0.85, 0.2, 0.03, 0.6)))
    bar.set_label("residual, °", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    return figure_png(figure, dpi=_DPI)


def response_picture(curve: ResponseCurve) -> bytes:
    """A response and, where known, its standard error, as PNG."""
    figure = Figure(figsize=(4.6, 3.2), layout="constrained", dpi=_DPI)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(curve.x, curve.y, ".-", color="#204a6b", ms=4, lw=1)
    if curve.sigma_y is not None:
        axes.fill_between(
            curve.x, curve.y - curve.sigma_y, curve.y + curve.sigma_y, color="#9db8cc", alpha=0.6
        )
    axes.set_xlabel(curve.input_name, fontsize=9)
    axes.set_ylabel(curve.output_name, fontsize=9)
    axes.tick_params(labelsize=8)
    return figure_png(figure, dpi=_DPI)


def flat_field_picture(field: FlatField) -> bytes:
    """A camera's answer to even light over its picture, as PNG."""
    tall = 0.8 * 4.6 * field.height / field.width + 0.6
    figure = Figure(figsize=(4.6, tall), layout="compressed", dpi=_DPI)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    x, y = (np.linspace(0, size - 1, 97) for size in (field.width, field.height))
    gain = field.gain(np.stack(np.meshgrid(x, y), axis=-1))
    shown = axes.pcolormesh(x, y, gain, cmap="gray", shading="gouraud", vmax=1)
    lines = axes.contour(x, y, gain, 6, colors="#b3402a", linewidths=0.7)
    axes.plot(*field.centre, "+", color="#b3402a")
    axes.set_xlim(-0.5, field.width - 0.5)
    axes.set_ylim(field.height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("camera column, px", fontsize=8)
    axes.set_ylabel("row, px", fontsize=8)
    axes.tick_params(labelsize=7)
    bar = figure.colorbar(shown, ax=axes)
    bar.add_lines(lines)
    bar.set_label("answer to even light", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    return figure_png(figure, dpi=_DPI)
