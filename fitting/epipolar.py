"""What row and column, decoded both, say of one another: alignment, and wrong fringe orders.

A column fixes the depth along a viewing ray and with it the row. What is smooth in their
disagreement is an error of the calibration; jumps of whole periods are wrong fringe orders.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from acquisition.robust_spread import robust_sigma
from calibration.rig_geometry import RigGeometry
from fitting.depth_solver import (
    PanelCorrection,
    PanelSightings,
    cubic_terms,
    panel_points,
    solve,
)

_SAMPLES = 20_000


@dataclass(frozen=True)
class Alignment:
    """The smooth disagreement between the axes, taken out.

    Attributes
    ----------
    correction : PanelCorrection
        What is added to the coordinate across the baseline.
    rms_px : float
        Its size over the picture.
    """

    correction: PanelCorrection
    rms_px: float


def align_axes(sightings: PanelSightings, rig: RigGeometry) -> Alignment:
    """Fit the smooth disagreement between the decoded axes.

    The axis across the baseline says next to nothing of the depth, but an error of the calibration
    along it would bend the surface. What that axis is off by, a cubic over the picture, is
    returned; wrong periods and noise are left, to be judged after.

    Parameters
    ----------
    sightings : PanelSightings
        Both axes, of pixels all over the picture.
    rig : RigGeometry
    """
    none = Alignment(PanelCorrection.none(), 0.0)
    _, gradient = rig.projector.project_with_gradient(
        np.linalg.norm(rig.rt_proj_cam[3:]) * np.array([[0.0, 0.0, 5.0]])
    )
    along = int(np.argmax(np.abs(gradient[0] @ rig.rt_proj_cam[3:])))
    across = 1 - along
    thin = sightings.take(np.arange(0, len(sightings), max(1, len(sightings) // _SAMPLES)))
    depth = solve(thin.only(along), rig, PanelCorrection.none()).depth
    off = panel_points(thin.slopes, depth, rig)[:, across] - thin.coordinates[across]
    used = np.flatnonzero(np.isfinite(off))
    if not len(used):
        return none
    # No term in the depth: where the period is wrong the depth is too, and would spoil the row.
    terms = cubic_terms(thin.slopes)
    limit = np.inf
    model = np.zeros(terms.shape[1])
    for _ in range(8):
        left = off[used] - terms[used] @ model
        left -= np.median(left) if not model.any() else 0.0
        limit = min(limit, max(4 * robust_sigma(left), 0.1))
        inside = used[np.abs(left) <= limit]
        if len(inside) < 10 * len(model):
            return none
        model = np.linalg.lstsq(terms[inside], off[inside], rcond=1e-8)[0]
    rms = float(np.sqrt(np.mean((terms[inside] @ model) ** 2)))
    return Alignment(PanelCorrection(across, model), rms)


def repair_orders(
    sightings: PanelSightings,
    tolerance: NDArray[np.float32],
    periods: tuple[float, float],
    rig: RigGeometry,
    correction: PanelCorrection,
) -> PanelSightings:
    """Coordinates moved by the one combination of whole periods that the rig's geometry allows.

    The order may be wrong by one, or by the whole panel where a coarse fringe of one period
    wrapped at the panel's edge. A pixel keeps its coordinates, and is rejected for them later,
    where no combination or more than one fits.

    Parameters
    ----------
    sightings : PanelSightings
        Pixels whose axes contradict one another.
    tolerance : (n,) float32 array
        Disagreement on the panel that noise and calibration explain, pixels.
    periods : (float, float)
        Of the finest column and row fringes, projector pixels.
    rig : RigGeometry
    correction : PanelCorrection
        From :func:`align_axes`.
    """
    panel = np.array([rig.projector.width, rig.projector.height])
    across, down = (_orders(size / period) for size, period in zip(panel, periods, strict=True))
    matches = np.zeros(len(sightings), np.int32)
    moved = np.zeros((2, len(sightings)))
    smooth = np.zeros((2, len(sightings)))
    if correction.axis >= 0:
        smooth[correction.axis] = cubic_terms(sightings.slopes) @ correction.cubic
    column, row = sightings.coordinates
    for column_order in across:
        shifted = sightings.moved(column_order * periods[0], 0.0)
        only = replace(correction, axis=correction.axis if correction.axis == 0 else -1)
        depth = solve(shifted.only(0), rig, only).depth
        expected = panel_points(sightings.slopes, depth, rig)[:, 1]
        for row_order in down:
            step = np.array([column_order * periods[0], row_order * periods[1]])
            candidate = np.stack([column + step[0], row + step[1]])
            on_panel = ((candidate >= -0.5) & (candidate <= panel[:, np.newaxis] - 0.5)).all(axis=0)
            fits = on_panel & (np.abs(candidate[1] + smooth[1] - expected) <= tolerance)
            moved[:, fits] = step[:, np.newaxis]
            matches += fits
    moved[:, matches != 1] = 0.0
    return replace(sightings, coordinates=(column + moved[0], row + moved[1]))


def _orders(periods: float) -> list[int]:
    n = round(float(periods))
    return [-1, 0, 1] + [sign * (n - less) for sign in (-1, 1) for less in (0, 1) if n > 2]
