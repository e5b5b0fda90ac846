"""The paper's two tables, as ratios, beside the paper's own."""

from __future__ import annotations

from dataclasses import replace
from statistics import median

import numpy as np

from fitting.digital_copy import DigitalCopy
from fitting.relief_classification import ReliefOptions, classify_relief
from render.adaptive import AdaptiveOptions
from render.painter import Painter
from render.painting_node import Mode
from render.views import NamedView, View, named_view
from workstation.benchmark_records import Record
from workstation.benchmarks.render_bounds import UNBOUNDED, at_most
from workstation.benchmarks.render_cases import Case, Work, find_cases, time_ratio
from workstation.benchmarks.render_scenes import OIL, SIZES, RenderedScene

_PAPER_MODES = (Mode.MESH, Mode.RELIEF, Mode.HYBRID, Mode.ADAPTIVE)
# Hz of the paper's table 1, the middle of its ranges.
_TABLE_1 = {
    NamedView.NEAR_GRAZING: (71, 36, 40.5, 46.5),
    NamedView.NEAR_FRONT: (85, 32, 43.5, 64),
    NamedView.INSHOT_GRAZING: (60, 100, 61, 330),
    NamedView.INSHOT_FRONT: (52, 74, 60, 350),
    NamedView.FAR_GRAZING: (96, 365, 82, 650),
    NamedView.FAR_FRONT: (96, 192.5, 80, 1250),
}
# Hz of its table 2 by box size: front, intermediate, grazing.
_TABLE_2 = {
    5: (305, 142, 18),
    10: (300, 185, 38),
    20: (330, 250, 75),
    50: (240, 175, 145),
    100: (135, 130, 125),
}
_TABLE_2_ELEVATIONS = {"front": 82.0, "intermediate": 45.0, "grazing": 15.0}
# Sensitive enough that boxes are drawn at all three angles.
_TABLE_2_OPTIONS = AdaptiveOptions(K=4.0)
_TABLE_2_TURNS = 5
_USUAL_CELL = 20


def table_1(cases: list[Case]) -> list[Record]:
    """Times over the mesh's; over relief mapping's, and the paper's own, in the notes.

    Every view has a note on the order of the four columns, and on the work that makes it where it
    is not the paper's.
    """
    records = []
    width, height = SIZES[0]
    for view, hertz in _TABLE_1.items():
        found = find_cases(cases, scene=OIL, size=f"{width}x{height}", view=view)
        paper = dict(zip(_PAPER_MODES, hertz, strict=True))
        mesh, relief = found[Mode.MESH], found[Mode.RELIEF]
        for mode in (mode for mode in Mode if mode is not Mode.MESH):
            case = found[mode]
            note = (
                f"{median(case.pass_ms):.2f} ms, {time_ratio(case, relief):.3g} of relief mapping"
            )
            if mode in paper:
                note += f"; the paper's {paper[Mode.MESH] / paper[mode]:.2g} of the mesh, "
                note += f"{paper[Mode.RELIEF] / paper[mode]:.2g} of relief mapping"
            if mode is Mode.ADAPTIVE:
                note += _order(found, paper)
            name = f"table1.{view}.{mode}_over_mesh"
            value = time_ratio(case, mesh)
            records.append(at_most(name, value, "", UNBOUNDED, note, runs=len(mesh.pass_ms)))
    return records


def _order(found: dict[str, Case], paper: dict[Mode, float]) -> str:
    """The order of the four columns; where it is not the paper's, the work that makes it."""
    ours = sorted(_PAPER_MODES, key=lambda mode: median(found[mode].pass_ms))
    theirs = sorted(_PAPER_MODES, key=lambda mode: -paper[mode])
    if ours == theirs:
        return "; fastest to slowest as in the paper"
    done = ", ".join(f"{mode} {_described(found[mode].work)}" for mode in ours)
    boxes = found[Mode.ADAPTIVE]
    return (
        f"; fastest to slowest {', '.join(ours)}, the paper's {', '.join(theirs)}: a covered pixel "
        f"has of {done}; α draws {boxes.boxes_opaque + boxes.boxes_blended} of "
        f"{found[Mode.HYBRID].boxes_opaque} boxes, {boxes.boxes_blended} of them blended"
    )


def _described(work: Work) -> str:
    return f"{work.fragments:.2f} fragments and {work.steps:.1f} steps"


def table_2(scene: RenderedScene) -> list[Record]:
    """Adaptive rendering by box size, as times over those of boxes of 20 texels.

    Times over the mesh's and over relief mapping's are in the notes, and the work that makes them;
    on the smallest boxes, the order of the sizes where it is not the paper's.
    """
    width, height = SIZES[0]
    distance = named_view(scene.copy, NamedView.INSHOT_FRONT, aspect=width / height).distance_mm
    views = {
        angle: View(np.deg2rad(-90), np.deg2rad(elevation), distance)
        for angle, elevation in _TABLE_2_ELEVATIONS.items()
    }
    field = scene.copy.height_field
    subjects = {
        str(n): (
            Mode.ADAPTIVE,
            replace(scene.copy, relief=classify_relief(field, ReliefOptions(cell=n))),
        )
        for n in _TABLE_2
    }
    subjects |= {str(mode): (mode, scene.copy) for mode in (Mode.RELIEF, Mode.MESH)}
    painters = {name: Painter(supersampling=1) for name in subjects}
    ms: dict[tuple[str, str], list[float]] = {}
    for turn in range(_TABLE_2_TURNS + 1):
        for name, (mode, copy) in subjects.items():
            for angle, view in views.items():
                cost = painters[name].cost(
                    *(copy, view),
                    mode=mode,
                    width=width,
                    height=height,
                    adaptive=_TABLE_2_OPTIONS,
                )
                # The first compiles and uploads.
                if turn:
                    ms.setdefault((name, angle), []).append(1000 * cost[0])
    done = {
        (n, angle): _work(painters[str(n)], subjects[str(n)][1], view)
        for n in _TABLE_2
        for angle, view in views.items()
    }
    for painter in painters.values():
        painter.close()

    def over(name: str, other: str, angle: str) -> float:
        pairs = zip(ms[name, angle], ms[other, angle], strict=True)
        return median(mine / theirs for mine, theirs in pairs)

    records = []
    for n, hertz in _TABLE_2.items():
        for angle, paper, usual in zip(views, hertz, _TABLE_2[_USUAL_CELL], strict=True):
            note = (
                f"{len(subjects[str(n)][1].relief.boxes)} boxes, "
                f"{median(ms[str(n), angle]):.1f} ms, {over(str(n), Mode.MESH, angle):.2f} of the "
                f"mesh, {over(str(n), Mode.RELIEF, angle):.2f} of relief mapping; "
                f"the paper's {usual / paper:.2g} of boxes of {_USUAL_CELL}; a pixel has "
                f"{_described(done[n, angle])}"
            )
            if n == min(_TABLE_2):
                had = {
                    n: f"{len(subjects[str(n)][1].relief.boxes)} boxes, "
                    + _described(done[n, angle])
                    for n in _TABLE_2
                }
                note += order_of_sizes({n: median(ms[str(n), angle]) for n in _TABLE_2}, had, angle)
            value = over(str(n), str(_USUAL_CELL), angle)
            name = f"table2.{n}.{angle}_over_{_USUAL_CELL}"
            records.append(at_most(name, value, "", UNBOUNDED, note, runs=_TABLE_2_TURNS))
    return records


def _work(painter: Painter, copy: DigitalCopy, view: View) -> Work:
    """Of the adaptive mode, by pixels that it draws."""
    width, height = SIZES[0]
    work = painter.work(
        *(copy, view),
        mode=Mode.ADAPTIVE,
        width=width,
        height=height,
        adaptive=_TABLE_2_OPTIONS,
    )
    steps, fragments = work.sum(axis=(0, 1)) / max(int((work[..., 1] > 0).sum()), 1)
    return Work(float(fragments), float(steps))


def order_of_sizes(ms: dict[int, float], had: dict[int, str], angle: str) -> str:
    """Sizes from the fastest to the slowest; where the paper has them otherwise, what made it so.

    That is the work of the fastest and the slowest: few large boxes have many steps a pixel, many
    small ones have to be set up.
    """
    place = list(_TABLE_2_ELEVATIONS).index(angle)
    ours = sorted(_TABLE_2, key=lambda n: ms[n])
    theirs = sorted(_TABLE_2, key=lambda n: -_TABLE_2[n][place])
    if ours == theirs:
        return "; fastest to slowest size as in the paper"
    listed = [", ".join(str(n) for n in order) for order in (ours, theirs)]
    return (
        f"; fastest to slowest size {listed[0]}, the paper's {listed[1]}: {ours[0]} has "
        f"{had[ours[0]]}, {ours[-1]} {had[ours[-1]]}"
    )
