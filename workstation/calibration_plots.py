"""Pictures of a calibration's report: residuals, uncertainty, coverage, planes, drift.

Each function draws one figure and returns it as PNG. Colours keep their order in print and
for readers who do not tell red from green.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from numpy.typing import NDArray

from calibration.board_relief import PITCH_MM
from calibration.cross_validation import CalibrationDifference
from calibration.procam import LENS_NAMES
from workstation.calibration_figures import tilts_deg
from workstation.report_page import figure_png
from workstation.rig_calibration import CalibratedRig, HeightUncertainty

_WIDTH_IN = 4.6
_DPI = 150
_CELLS = 6
_INK = "#204a6b"
_HOT = "#b3402a"


def residual_vectors(done: CalibratedRig, number: int) -> bytes:
    """Residuals of all views over a lens's imager, drawn long enough to be seen."""
    pixels, left = _residuals(done, number)
    figure, axes = _imager(done, number)
    size = done.calibration.solution.lenses[number].width
    usual = max(float(np.percentile(np.linalg.norm(left, axis=1), 90)), 1e-9)
    scale = usual / (0.035 * size)
    kept = _thinned(len(pixels), 1500)
    arrows = axes.quiver(
        *pixels[kept].T,
        *left[kept].T,
        angles="xy",
        scale_units="xy",
        scale=scale,
        width=0.0022,
        color=_INK,
    )
    _key(axes, arrows, usual)
    return figure_png(figure, dpi=_DPI)


def residual_means(done: CalibratedRig, number: int) -> bytes:
    """Mean residual of regions of the imager, over its own standard error."""
    pixels, left = _residuals(done, number)
    lens = done.calibration.solution.lenses[number]
    rows = max(2, round(_CELLS * lens.height / lens.width))
    cell = np.floor((pixels + 0.5) / [lens.width, lens.height] * [_CELLS, rows]).astype(int)
    cell = np.clip(cell, 0, [_CELLS - 1, rows - 1])
    place = cell[:, 1] * _CELLS + cell[:, 0]
    count = np.bincount(place, minlength=rows * _CELLS)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.stack(
            [np.bincount(place, r, minlength=rows * _CELLS) / count for r in left.T], axis=1
        )
        error = np.std(left) / np.sqrt(count)
        ratio = np.linalg.norm(mean, axis=1) / error / np.sqrt(2)
    figure, axes = _imager(done, number)
    shown = axes.imshow(
        np.where(count > 3, ratio, np.nan).reshape(rows, _CELLS),
        extent=(-0.5, lens.width - 0.5, lens.height - 0.5, -0.5),
        cmap="Purples",
        vmin=0,
        vmax=4,
    )
    for row, col in np.ndindex(rows, _CELLS):
        n = row * _CELLS + col
        if count[n] > 3:
            x, y = (col + 0.5) * lens.width / _CELLS, (row + 0.5) * lens.height / rows
            text = f"{mean[n, 0]:+.3f}\n{mean[n, 1]:+.3f}".replace("-", "\N{MINUS SIGN}")
            ink = "white" if ratio[n] > 2.5 else "black"
            axes.text(x, y, text, ha="center", va="center", fontsize=6.5, color=ink)
    _bar(figure, shown, axes, "mean over its standard error")
    return figure_png(figure, dpi=_DPI)


def residual_histogram(done: CalibratedRig, number: int) -> bytes:
    """Residuals over their standard deviations, beside the normal distribution."""
    solution, views = done.calibration.solution, done.calibration.views
    kept = solution.inliers[:, number]
    sigma = np.stack([view.sigma_px[number] for view in views])[kept] * solution.sigma0
    white = (solution.residuals_px[:, number][kept] / sigma[:, np.newaxis]).ravel()
    figure = Figure(figsize=(_WIDTH_IN, 2.9), layout="compressed", dpi=_DPI)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    bins = np.linspace(-5, 5, 51)
    axes.hist(np.clip(white, -5, 5), bins.tolist(), density=True, color="#9db8cc", label="corners")
    normal = np.exp(-(bins**2) / 2) / np.sqrt(2 * np.pi)
    axes.plot(bins, normal, color=_HOT, lw=1.4, label="normal")
    axes.set_xlabel("residual / its standard deviation", fontsize=9)
    axes.set_yticks([])
    beyond = float(np.mean(np.abs(white) > 3))
    axes.set_title(f"{100 * beyond:.2f} % beyond 3σ (normal: 0.27 %)", fontsize=9)
    axes.legend(fontsize=8, frameon=False)
    axes.tick_params(labelsize=8)
    return figure_png(figure, dpi=_DPI)


def uncertainty_picture(done: CalibratedRig, number: int) -> bytes:
    """Standard deviation of projection along the worst direction, in pixels."""
    found = done.uncertainty[number]
    lens = done.calibration.solution.lenses[number]
    figure, axes = _imager(done, number)
    worst = found.worst_sigma_px
    shown = axes.pcolormesh(
        found.pixels[..., 0],
        found.pixels[..., 1],
        worst,
        cmap="viridis",
        shading="gouraud",
        vmin=0,
        vmax=float(np.percentile(worst, 97)),
    )
    bar = _bar(figure, shown, axes, "standard deviation, px", extend="max")
    # Lines where the scale has its ticks, so that they need no labels.
    ticks = [tick for tick in bar.get_ticks() if 0 < tick < shown.norm.vmax]
    lines = axes.contour(
        found.pixels[..., 0], found.pixels[..., 1], worst, ticks, colors="white", linewidths=0.7
    )
    bar.add_lines(lines)
    axes.set_xlim(-0.5, lens.width - 0.5)
    axes.set_ylim(lens.height - 0.5, -0.5)
    return figure_png(figure, dpi=_DPI)


def height_picture(heights: HeightUncertainty) -> bytes:
    """Standard error of heights over the working plane, in µm."""
    x, y = heights.points[:, 0], heights.points[:, 1]
    figure, axes = _map_axes(float(np.ptp(x)), float(np.ptp(y)))
    shown = axes.tricontourf(x, y, 1000 * heights.sigma_mm, 14, cmap="viridis")
    axes.plot(x, y, ".", color="white", ms=1.5)
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.set_xlabel("x, mm", fontsize=9)
    axes.set_ylabel("y, mm", fontsize=9)
    _bar(figure, shown, axes, "standard error of height, µm")
    return figure_png(figure, dpi=_DPI)


def coverage_picture(done: CalibratedRig, number: int) -> bytes:
    """Corners that took part, over the imager and the cells of the gate."""
    pixels, _ = _residuals(done, number)
    lens = done.calibration.solution.lenses[number]
    figure, axes = _imager(done, number)
    kept = _thinned(len(pixels), 6000)
    axes.plot(*pixels[kept].T, ".", color=_INK, ms=2, alpha=0.5)
    for share in (0.25, 0.5, 0.75):
        axes.axvline(share * lens.width, color="#999", lw=0.5)
        axes.axhline(share * lens.height, color="#999", lw=0.5)
    return figure_png(figure, dpi=_DPI)


def tilt_picture(done: CalibratedRig) -> bytes:
    """Tilts of the boards to the right and downwards, degrees."""
    tilts = tilts_deg(done)
    figure = Figure(figsize=(_WIDTH_IN, _WIDTH_IN * 0.85), layout="compressed", dpi=_DPI)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    reach = max(45.0, float(np.abs(tilts).max()) + 5)
    turn = np.linspace(0, 2 * np.pi, 200)
    for ring in (20, 40):
        axes.plot(ring * np.cos(turn), ring * np.sin(turn), color="#bbb", lw=0.7)
    axes.plot(*tilts.T, "o", color=_INK, ms=4)
    for (x, y), view in zip(tilts, done.calibration.views, strict=True):
        if len(tilts) <= 20:
            axes.annotate(
                view.name, (x, y), fontsize=6.5, xytext=(3, 3), textcoords="offset points"
            )
    axes.set_xlim(-reach, reach)
    axes.set_ylim(reach, -reach)
    axes.set_aspect("equal")
    axes.set_xlabel("tilt to the right, °", fontsize=9)
    axes.set_ylabel("tilt downwards, °", fontsize=9)
    axes.tick_params(labelsize=8)
    return figure_png(figure, dpi=_DPI)


def difference_picture(
    done: CalibratedRig, number: int, difference: CalibrationDifference
) -> bytes:
    """Where two calibrations of a lens differ, and by how much."""
    figure, axes = _imager(done, number)
    length = np.linalg.norm(difference.difference_px, axis=-1)
    x, y = difference.pixels[..., 0], difference.pixels[..., 1]
    shown = axes.pcolormesh(x, y, length, cmap="viridis", shading="gouraud", vmin=0)
    step = max(1, len(x) // 8)
    at = np.s_[::step, ::step]
    # An arrow of the usual length reaches to the next, none farther than to the third.
    usual = max(float(np.nanpercentile(length[at], 90)), float(np.nanmax(length[at])) / 3, 1e-9)
    pitch = float(np.abs(np.diff(x[at], axis=1)).mean())
    arrows = axes.quiver(
        x[at],
        y[at],
        *np.moveaxis(difference.difference_px[at], -1, 0),
        angles="xy",
        scale_units="xy",
        scale=usual / pitch,
        color="white",
        width=0.004,
    )
    _key(axes, arrows, usual)
    _bar(figure, shown, axes, "length of the difference, px")
    return figure_png(figure, dpi=_DPI)


def plane_picture(height_mm: NDArray[np.float64], *, reach_mm: float, name: str) -> bytes:
    """A board's heights or their differences, in µm, with colours up to ``reach_mm``."""
    rows, cols = height_mm.shape
    size = cols * PITCH_MM, rows * PITCH_MM
    figure, axes = _map_axes(*size)
    reach = 1000 * max(reach_mm, 1e-6)
    shown = axes.imshow(
        1000 * height_mm,
        extent=(0, size[0], size[1], 0),
        cmap="RdBu_r",
        vmin=-reach,
        vmax=reach,
    )
    axes.set_xlabel("along the board's columns, mm", fontsize=9)
    axes.set_ylabel("along its rows, mm", fontsize=9)
    _bar(figure, shown, axes, f"{name}, µm", extend="both")
    return figure_png(figure, dpi=_DPI)


def _residuals(done: CalibratedRig, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    solution, views = done.calibration.solution, done.calibration.views
    kept = solution.inliers[:, number]
    pixels = np.stack([view.pixels[number] for view in views])[kept]
    return pixels, solution.residuals_px[:, number][kept]


def _imager(done: CalibratedRig, number: int) -> tuple[Figure, Axes]:
    lens = done.calibration.solution.lenses[number]
    figure, axes = _map_axes(lens.width, lens.height)
    axes.set_xlim(-0.5, lens.width - 0.5)
    axes.set_ylim(lens.height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel(f"{LENS_NAMES[number]} column, px", fontsize=9)
    axes.set_ylabel("row, px", fontsize=9)
    return figure, axes


def _map_axes(width: float, height: float) -> tuple[Figure, Axes]:
    """Axes for a map of a size, with room for its scale."""
    tall = min(6.0, 0.8 * _WIDTH_IN * height / width + 0.6)
    figure = Figure(figsize=(_WIDTH_IN, tall), layout="compressed", dpi=_DPI)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.tick_params(labelsize=8)
    return figure, axes


def _bar(
    figure: Figure, shown: object, axes: Axes, label: str, *, extend: str | None = None
) -> Colorbar:
    bar = figure.colorbar(shown, ax=axes, extend=extend)  # type: ignore[arg-type]
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)
    return bar


def _key(axes: Axes, arrows: Quiver, usual_px: float) -> None:
    """Say above the axes how long an arrow of a round length is."""
    key = _round_figure(usual_px)
    axes.set_title(" ", fontsize=9)
    axes.quiverkey(
        arrows,
        0.9,
        1.04,
        key,
        f"{key:g} px",
        labelpos="W",
        color=_INK,
        edgecolor="none",
        fontproperties={"size": 8},
    )


def _thinned(count: int, most: int) -> NDArray[np.int_]:
    order = np.random.default_rng(0).permutation(count)
    return np.sort(order[:most])


def _round_figure(value: float) -> float:
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * next(f for f in (5, 2, 1) if f * power <= value))
