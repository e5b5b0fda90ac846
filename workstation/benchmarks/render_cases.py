"""Every mode seen from the six views: what it costs, and how far it is from its reference.

Times are processor time of the painting pass, so that other work on the machine counts little. Bump
mapping, relief mapping and the bounded mode take turns, and ratios between them are of the same
turn: what load there is hits all of them alike. The other modes take turns of their own after them,
and their ratios to those three are of one turn over another.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.adaptive import box_alpha
from render.painter import Painter
from render.painting_node import Mode
from render.views import NamedView, View, named_view
from workstation.benchmarks.picture_differences import Difference, difference
from workstation.benchmarks.render_scenes import OIL, SIZES, RenderedScene

# What is held against a bound, and what it is held against.
BOUNDED_AND_RIVALS = (Mode.BUMP, Mode.BOUNDED, Mode.RELIEF, Mode.MESH)
JUDGED = (Mode.EXACT, Mode.BOUNDED)
_PAIRED = (Mode.BUMP, Mode.BOUNDED, Mode.RELIEF)
_FEWEST_TURNS, _MOST_TURNS = 7, 31
_OTHER_TURNS = 3
_SECONDS = 1.5  # of the paired modes, after which a view's turns end
Pictures = dict[tuple[str, str], NDArray[np.float32]]


@dataclass(frozen=True)
class Work:
    """Fragments and steps of the search per pixel that the painting covers."""

    fragments: float
    steps: float


@dataclass(frozen=True)
class Case:
    """One mode seen from one view.

    Attributes
    ----------
    scene, size, view, mode : str
    pass_ms : list of float
        Of the painting pass, by turn.
    frame_ms : float
        Median of the whole picture.
    work : Work
    boxes_opaque, boxes_blended : int
    difference : Difference or None
        None where only the time is wanted.
    """

    scene: str
    size: str
    view: str
    mode: str
    pass_ms: list[float]
    frame_ms: float
    work: Work
    boxes_opaque: int
    boxes_blended: int
    difference: Difference | None


def measure_cases(scenes: list[RenderedScene]) -> tuple[list[Case], Pictures]:
    """All modes on the oil painting at the smaller size; elsewhere those that have bounds.

    Returns
    -------
    cases : list of Case
    pictures : dict
        Radiance (rows, cols, 3) of the oil painting by mode, or ``"reference"``, and view.
    """
    cases: list[Case] = []
    pictures: Pictures = {}
    for scene in scenes:
        for size in SIZES:
            whole = scene.name == OIL and size == SIZES[0]
            modes = tuple(Mode) if whole else (*BOUNDED_AND_RIVALS, Mode.EXACT)
            painters = {mode: Painter(supersampling=1) for mode in modes}
            for name in NamedView:
                cases += _seen_from(
                    scene,
                    name,
                    size,
                    painters,
                    judged=modes if whole else JUDGED,
                    keep=pictures if whole else None,
                )
            for painter in painters.values():
                painter.close()
    return cases, pictures


def _seen_from(
    scene: RenderedScene,
    name: NamedView,
    size: tuple[int, int],
    painters: dict[Mode, Painter],
    *,
    judged: tuple[Mode, ...],
    keep: Pictures | None,
) -> list[Case]:
    width, height = size
    view = named_view(scene.copy, name, aspect=width / height)
    truth = scene.reference.picture(view, width=width, height=height)
    covered = max(int(truth.covered.sum()), 1)
    turns = _turns(scene, view, size, painters)
    alpha = box_alpha(scene.copy, view.position)
    cases = []
    for mode, painter in painters.items():
        options: dict[str, Any] = {"mode": mode, "width": width, "height": height}
        found = None
        if mode in judged:
            radiance = painter.paint(scene.copy, view, **options).radiance
            points = painter.points(scene.copy, view, **options)
            found = difference(radiance, points, truth, scene.reference, view)
            if keep is not None:
                keep[str(mode), str(name)] = radiance
        work = painter.work(scene.copy, view, **options)
        boxes = alpha if mode is Mode.ADAPTIVE else np.full(len(alpha), mode is Mode.HYBRID)
        cases.append(
            Case(
                *(scene.name, f"{width}x{height}", str(name), str(mode)),
                pass_ms=[1000 * turn[0] for turn in turns[mode]],
                frame_ms=1000 * median(turn[1] for turn in turns[mode]),
                work=Work(float(work[..., 1].sum() / covered), float(work[..., 0].sum() / covered)),
                boxes_opaque=int((boxes >= 1).sum()),
                boxes_blended=int(((boxes > 0) & (boxes < 1)).sum()),
                difference=found,
            )
        )
    if keep is not None:
        keep["reference", str(name)] = truth.radiance.astype(np.float32)
    return cases


def _turns(
    scene: RenderedScene, view: View, size: tuple[int, int], painters: dict[Mode, Painter]
) -> dict[Mode, list[tuple[float, float]]]:
    """Seconds of the painting pass and of the frame by mode, turn by turn.

    The modes with bounds take turns among themselves, before the slow ones clear the caches.
    """
    paired = [mode for mode in _PAIRED if mode in painters]
    others = [mode for mode in painters if mode not in _PAIRED]
    return _taken(scene, view, size, {mode: painters[mode] for mode in paired}, _MOST_TURNS) | (
        _taken(scene, view, size, {mode: painters[mode] for mode in others}, _OTHER_TURNS)
    )


def _taken(
    scene: RenderedScene,
    view: View,
    size: tuple[int, int],
    painters: dict[Mode, Painter],
    most: int,
) -> dict[Mode, list[tuple[float, float]]]:
    seconds: dict[Mode, list[tuple[float, float]]] = {mode: [] for mode in painters}
    began = process_time()
    for turn in range(most + 1):
        if turn > _FEWEST_TURNS and process_time() - began > _SECONDS:
            break
        order = list(painters.items())
        for mode, painter in order if turn % 2 else reversed(order):
            cost = painter.cost(scene.copy, view, mode=mode, width=size[0], height=size[1])
            # The first compiles and uploads.
            if turn:
                seconds[mode].append(cost)
    return seconds


def time_ratio(one: Case, other: Case) -> float:
    """Median over the turns that both had, in their order, of the one's time over the other's."""
    turns = zip(one.pass_ms, other.pass_ms, strict=False)
    return median(mine / theirs for mine, theirs in turns)


def find_cases(cases: list[Case], *, scene: str, size: str, view: str) -> dict[str, Case]:
    """One view's cases by mode."""
    return {
        case.mode: case
        for case in cases
        if (case.scene, case.size, case.view) == (scene, size, view)
    }
