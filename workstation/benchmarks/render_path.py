"""No popping: a camera path on which a mode may not change more than what it shows does.

FLIP between neighbouring frames is what moves; of the reference it is what has to move. A mode that
switches its way of drawing shows the switch as FLIP in excess of the reference's. Where the bounded
mode switches, the camera is moved by so little that nothing else changes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from render.bounded import BUDGET_PX, SurfaceShape, ViewNeeds
from render.painter import Painter
from render.painting_maps import PaintingMaterial
from render.painting_node import Mode
from render.views import NamedView, View, named_view
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.picture_differences import encode, flip_map
from workstation.benchmarks.render_bounds import UNBOUNDED, at_most
from workstation.benchmarks.render_scenes import RenderedScene

_WIDTH, _HEIGHT = 320, 240
_FRAMES = 90
_BOUND = 0.002
_HALVINGS = 20  # of the way between two frames, until it is that of a switch
_MODES = (Mode.BOUNDED, Mode.ADAPTIVE)


@dataclass(frozen=True)
class Popping:
    """What modes change beyond the reference.

    Attributes
    ----------
    excess : dict of list of float
        FLIP from frame to frame beyond the reference's, by mode.
    switches : list of (str, float)
        What the bounded mode switches between, and FLIP across it.
    """

    excess: dict[str, list[float]]
    switches: list[tuple[str, float]]

    def records(self) -> list[Record]:
        """The worst frames, and the worst switch."""
        ours, adaptive = (max(self.excess[mode]) for mode in _MODES)
        return [
            at_most(
                "popping.flip_excess_max",
                *(ours, "", _BOUND),
                f"from far in front to near and grazing; the paper's adaptive mode {adaptive:.4f}",
                runs=len(self.excess[Mode.BOUNDED]),
            ),
            at_most(
                "popping.adaptive_flip_excess_max",
                *(adaptive, "", UNBOUNDED, "the paper's adaptive mode on the same path"),
                runs=len(self.excess[Mode.ADAPTIVE]),
            ),
            Record(
                name="popping.switches",
                value=float(len(self.switches)),
                unit="",
                bound=1.0,
                sense=Sense.AT_LEAST,
                runs=len(self.excess[Mode.BOUNDED]),
                note="of the bounded mode on the path: without any, it shows nothing of them",
            ),
            at_most(
                "popping.switch_flip_max",
                # Where nothing was switched, nothing was held.
                *(max((flip for _, flip in self.switches), default=UNBOUNDED), "", _BOUND),
                ", ".join(f"{what} {flip:.5f}" for what, flip in self.switches),
                runs=len(self.switches),
            ),
        ]


def camera_path(scene: RenderedScene) -> list[View]:
    """From far in front to near, while the camera sinks from the front to a grazing angle."""
    front = named_view(scene.copy, NamedView.INSHOT_FRONT, aspect=_WIDTH / _HEIGHT)
    return [
        View(
            np.deg2rad(-90 + 20 * share),
            np.deg2rad(80 - 60 * share),
            front.distance_mm * 4 * 0.08**share,
        )
        for share in np.linspace(0, 1, _FRAMES)
    ]


def measure_popping(scene: RenderedScene) -> Popping:
    """Draw the path in the bounded mode and the paper's, and the bounded mode's switches."""
    views = camera_path(scene)
    excess: dict[str, list[float]] = {mode: [] for mode in _MODES}
    painters = {mode: Painter(supersampling=1) for mode in _MODES}
    before: dict[str, NDArray[np.float32]] = {}
    for view in views:
        truth = scene.reference.picture(view, width=_WIDTH, height=_HEIGHT)
        now = {"reference": encode(truth.radiance)}
        now |= {mode: _shown(painter, scene, view, mode) for mode, painter in painters.items()}
        if before:
            moved = {name: flip_map(now[name], before[name]).mean() for name in now}
            for mode in _MODES:
                excess[mode].append(float(moved[mode] - moved["reference"]))
        before = now
    changes = []
    for what, pair in switches(scene, views):
        pictures = [_shown(painters[Mode.BOUNDED], scene, view, Mode.BOUNDED) for view in pair]
        changes.append((what, float(flip_map(*pictures).mean())))
    for painter in painters.values():
        painter.close()
    return Popping(excess, changes)


def _shown(painter: Painter, scene: RenderedScene, view: View, mode: Mode) -> NDArray[np.float32]:
    return encode(painter.paint(scene.copy, view, mode=mode, width=_WIDTH, height=_HEIGHT).radiance)


def switches(scene: RenderedScene, views: list[View]) -> Iterator[tuple[str, tuple[View, View]]]:
    """Views just before and just after each change of what the bounded mode does."""
    levels = PaintingMaterial(scene.copy).height_levels
    shape = SurfaceShape.of(scene.copy.height_field, levels)

    def way(view: View) -> tuple[object, ...]:
        pixel_angle = 2 * np.tan(view.field_of_view / 2) / _HEIGHT
        return _way(shape.needs(view.position, pixel_angle, BUDGET_PX))

    for one, other in pairwise(views):
        # There may be several changes between two frames.
        while way(one) != way(other):
            first, last = _change(way, one, other)
            what = " to ".join(" ".join(str(part) for part in way(view)) for view in (first, last))
            yield what, (first, last)
            one = last


def _change(way: Callable[[View], tuple[object, ...]], one: View, other: View) -> tuple[View, View]:
    """Views just before and just after a change from what is done at the one."""
    first, last = one, other
    for _ in range(_HALVINGS):
        middle = replace(
            first,
            azimuth=0.5 * (first.azimuth + last.azimuth),
            elevation=0.5 * (first.elevation + last.elevation),
            distance_mm=0.5 * (first.distance_mm + last.distance_mm),
        )
        if way(middle) == way(one):
            first = middle
        else:
            last = middle
    return first, last


def _way(needs: ViewNeeds) -> tuple[object, ...]:
    return (
        needs.search,
        "on triangles" if needs.triangle_share > 0 else "on texels",
        f"level {needs.level}",
        needs.heading.name.lower(),
    )
