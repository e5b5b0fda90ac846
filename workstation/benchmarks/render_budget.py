"""The bounded mode's error as its budget falls."""

from __future__ import annotations

from typing import Any

import numpy as np

from render.painter import Painter
from render.painting_node import Mode
from render.views import NamedView, named_view
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.picture_differences import parallax_px
from workstation.benchmarks.render_scenes import SIZES, RenderedScene

_BUDGETS_PX = (1.0, 0.5, 0.25, 0.125, 0.0625)


def budget_curve(scene: RenderedScene) -> dict[float, float]:
    """95 % parallax in pixels by budget, in shot at grazing angle."""
    width, height = SIZES[0]
    view = named_view(scene.copy, NamedView.INSHOT_GRAZING, aspect=width / height)
    truth = scene.reference.picture(view, width=width, height=height)
    curve = {}
    with Painter(supersampling=1) as painter:
        for budget in _BUDGETS_PX:
            options: dict[str, Any] = {"mode": Mode.BOUNDED, "width": width, "height": height}
            points = painter.points(scene.copy, view, budget_px=budget, **options)
            off = parallax_px(points, truth.points, view)
            curve[budget] = float(np.nanquantile(off, 0.95))
    return curve


def halving_record(curve: dict[float, float]) -> Record:
    """Slope of error over budget in logarithms: one where halving the one halves the other."""
    slope = np.polyfit(np.log(list(curve)), np.log(list(curve.values())), 1)[0]
    return Record(
        name="bounded.error_over_budget_slope",
        value=float(slope),
        unit="",
        bound=(0.7, 1.5),
        sense=Sense.WITHIN,
        runs=len(curve),
        note=", ".join(f"{budget:g}: {error:.3f}" for budget, error in curve.items()) + " px",
    )
