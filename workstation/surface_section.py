"""The part of a calibration's page on the board's surface: how it is printed, and what moved."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from calibration.dense_solution import DenseSolution
from workstation.report_page import Picture, Section, Table, figure_png
from workstation.surface_figures import surface_sentences

_PITCH_MM = 0.5
_WIDTH_IN = 4.6
_DPI = 150


def surface_section(surface: DenseSolution, figures: dict[str, Any]) -> Section:
    """What the surface showed.

    Parameters
    ----------
    surface : DenseSolution
    figures : dict
        Of :func:`~workstation.surface_figures.surface_figures`.
    """
    board, moved = surface_sentences(figures)
    rows = tuple(
        (
            pose["name"],
            str(pose["blocks"]),
            ", ".join(f"{rms:.3f}" for rms in pose["blocks_rms_px"]),
            f"{pose['corners_rms_px']:.3f}",
            f"{pose['turn_mrad']:.2f} ± {pose['turn_sigma_mrad']:.2f}",
            f"{pose['shift_mm']:.3f} ± {pose['shift_sigma_mm']:.3f}",
            f"{pose['moved_px']:.3f} ± {pose['moved_sigma_px']:.3f}",
        )
        for pose in figures["poses"]
    )
    heading = (
        "pose",
        "blocks",
        "left in columns, rows, px",
        "left at corners, px",
        "projector turned, mrad",
        "shifted, mm",
        "moved on the board, px",
    )
    return Section(
        "Surface of the board",
        f"Lenses and poses were solved from all of the board's white surface. In short, {board}. "
        f"And {moved}. Turns and shifts of the projector explain much of one another; what both do "
        "to its picture is told well.",
        tables=(Table(rows, heading=heading),),
        pictures=(
            Picture("Relief of the board, and the corners on it", _relief_picture(surface)),
            Picture(
                "Corners off the even grid, drawn longer, and the ellipse of their standard error",
                _corner_picture(surface),
            ),
        ),
    )


def _relief_picture(surface: DenseSolution) -> bytes:
    far = surface.problem.board.points[-1, -1, :2]
    x, y = (np.arange(0, size + _PITCH_MM, _PITCH_MM) for size in far)
    places = np.stack(np.meshgrid(x, y), axis=-1)
    height = 1000 * surface.heights(places.reshape(-1, 2)).reshape(places.shape[:2])
    figure, axes = _board(far)
    reach = max(float(np.abs(height).max()), 1e-3)
    shown = axes.imshow(
        height, extent=(0, far[0], far[1], 0), cmap="RdBu_r", vmin=-reach, vmax=reach
    )
    axes.plot(*surface.corner_places.reshape(-1, 3)[:, :2].T, ".", color="black", ms=2)
    bar = figure.colorbar(shown, ax=axes, shrink=0.85)
    bar.set_label("height, µm", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    return figure_png(figure, dpi=_DPI)


def _corner_picture(surface: DenseSolution) -> bytes:
    board = surface.problem.board
    figure, axes = _board(board.points[-1, -1, :2])
    places = board.points.reshape(-1, 3)[:, :2]
    moved = surface.displacement_mm.reshape(-1, 2)
    longest = max(float(np.linalg.norm(moved, axis=1).max()), 1e-6)
    scale = longest / (0.8 * board.square_mm)
    axes.quiver(
        *places.T,
        *moved.T,
        angles="xy",
        scale_units="xy",
        scale=scale,
        width=0.003,
        color="#204a6b",
    )
    sigma = surface.corner_sigma_mm.reshape(-1, 3)[:, :2] / scale
    turn = np.linspace(0, 2 * np.pi, 40)
    for end, spread in zip(places + moved / scale, sigma, strict=True):
        axes.plot(
            end[0] + spread[0] * np.cos(turn),
            end[1] + spread[1] * np.sin(turn),
            color="#b3402a",
            lw=0.5,
        )
    axes.set_title(f"the longest arrow is {1000 * longest:.0f} µm", fontsize=9)
    return figure_png(figure, dpi=_DPI)


def _board(far: NDArray[np.float64]) -> tuple[Figure, Any]:
    figure = Figure(
        figsize=(_WIDTH_IN, min(6.5, _WIDTH_IN * 0.85 * far[1] / far[0] + 0.7)),
        layout="constrained",
        dpi=_DPI,
    )
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    margin = 0.06 * float(far.max())
    axes.set_xlim(-margin, far[0] + margin)
    axes.set_ylim(far[1] + margin, -margin)
    axes.set_aspect("equal")
    axes.set_xlabel("along the board's columns, mm", fontsize=9)
    axes.set_ylabel("along its rows, mm", fontsize=9)
    axes.tick_params(labelsize=8)
    return figure, axes
