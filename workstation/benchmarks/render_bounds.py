"""Records of the exact and the bounded mode: what they promise, and what it costs."""

from __future__ import annotations

from statistics import median

from render.painting_node import Mode
from render.views import NamedView
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.picture_differences import Difference
from workstation.benchmarks.render_cases import Case, find_cases, time_ratio
from workstation.benchmarks.render_scenes import OIL, SIZES

UNBOUNDED = float("inf")
_OVER_BUMP = {
    NamedView.INSHOT_FRONT: 1.15,
    NamedView.INSHOT_GRAZING: 1.6,
    NamedView.FAR_FRONT: 1.15,
    NamedView.FAR_GRAZING: 1.15,
}


def at_most(
    name: str, value: float, unit: str, bound: float, note: str = "", *, runs: int = 1
) -> Record:
    """A figure with an upper bound."""
    return Record(
        name=name, value=value, unit=unit, bound=bound, sense=Sense.AT_MOST, runs=runs, note=note
    )


def exact_records(cases: list[Case]) -> list[Record]:
    """The exact mode against Embree, the worst of all scenes, sizes and views."""
    found = _judged(cases, Mode.EXACT)
    scenes = len({case.scene for case, _ in found})
    where = f"{scenes} scenes, {len(SIZES)} sizes, six views"
    runs = len(found)

    def worst(name: str, unit: str, bound: float, values: list[float]) -> Record:
        return at_most(f"exact.{name}", max(values), unit, bound, where, runs=runs)

    return [
        worst("coverage_px_max", "px", 4, [off.coverage_px for _, off in found]),
        worst("hit_um_median", "µm", 1, [off.hit_um[0] for _, off in found]),
        worst("hit_um_max", "µm", 10, [off.hit_um[1] for _, off in found]),
        Record(
            name="exact.psnr_db_min",
            value=min(off.psnr_db for _, off in found),
            unit="dB",
            bound=55.0,
            sense=Sense.AT_LEAST,
            runs=runs,
            note=f"{where}; where the painting is, "
            f"{min(off.psnr_covered_db for _, off in found):.1f} dB at least",
        ),
    ]


def bounded_records(cases: list[Case]) -> list[Record]:
    """What is left of parallax and of visible difference, the worst of each scene's views."""
    records = []
    for scene in dict.fromkeys(case.scene for case in cases):
        found = [pair for pair in _judged(cases, Mode.BOUNDED) if pair[0].scene == scene]
        case, off = max(found, key=lambda pair: pair[1].parallax_px[1])
        note = f"{case.view} {case.size}; covered by one of the two alone, "
        note += f"{max(off.coverage_px for _, off in found)} px at most"
        name = f"bounded.parallax_p95_px_max{_suffix(scene)}"
        records.append(at_most(name, off.parallax_px[1], "px", 0.25, note, runs=len(found)))
        case, off = max(found, key=lambda pair: pair[1].flip)
        note = f"{case.view} {case.size}; where the painting is, "
        note += f"{max(off.flip_covered for _, off in found):.4f} at most"
        name = f"bounded.flip_max{_suffix(scene)}"
        records.append(at_most(name, off.flip, "", 0.01, note, runs=len(found)))
    return records


def time_records(cases: list[Case]) -> list[Record]:
    """The bounded mode's time over bump mapping's and over its rivals', the worse of both sizes.

    The bounds over bump mapping are those of a painting: a relief that is searched exactly
    everywhere has none but its rivals.
    """
    records = []
    for scene in dict.fromkeys(case.scene for case in cases):
        for view in NamedView:
            records += _view_times(cases, scene, view)
    return records


def _view_times(cases: list[Case], scene: str, view: NamedView) -> list[Record]:
    over_bump, over_rival, rivals, turns = [], [], [], 0
    for width, height in SIZES:
        found = find_cases(cases, scene=scene, size=f"{width}x{height}", view=view)
        bounded, bump = found[Mode.BOUNDED], found[Mode.BUMP]
        rival = min((found[Mode.MESH], found[Mode.RELIEF]), key=lambda case: median(case.pass_ms))
        over_bump.append(time_ratio(bounded, bump))
        over_rival.append(time_ratio(bounded, rival))
        rivals.append(rival.mode)
        turns = max(turns, len(bounded.pass_ms))
    sizes = " at " + ", ".join(f"{width}x{height}" for width, height in SIZES)
    bound = _OVER_BUMP.get(view, UNBOUNDED) if scene == OIL else UNBOUNDED
    return [
        at_most(
            f"bounded.time_over_bump.{view}{_suffix(scene)}",
            *(max(over_bump), "", bound, ", ".join(f"{ratio:.2f}" for ratio in over_bump) + sizes),
            runs=turns,
        ),
        at_most(
            f"bounded.time_over_rival.{view}{_suffix(scene)}",
            *(max(over_rival), "", 1.0),
            ", ".join(
                f"{ratio:.2f} of {rival}" for ratio, rival in zip(over_rival, rivals, strict=True)
            )
            + sizes,
            runs=turns,
        ),
    ]


def _suffix(scene: str) -> str:
    return "" if scene == OIL else f".{scene}"


def _judged(cases: list[Case], mode: Mode) -> list[tuple[Case, Difference]]:
    return [
        (case, case.difference)
        for case in cases
        if case.mode == mode and case.difference is not None
    ]
