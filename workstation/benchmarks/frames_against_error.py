"""Frames taken against the error of heights: fixed plans, and metered ones at several targets.

The simulated oil painting is scanned once, by the full set of frames. A metered plan is then
recorded from these by the ordinary way, with a rig that replays them; a fixed plan is a part of
them. All are decoded, and their heights held against the true ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from acquisition.decoding import decode
from acquisition.patterns import Axis, PhaseShift
from acquisition.plan import Metering, Plan, Purpose
from acquisition.recorded_frames import recording_of
from acquisition.recording import record_plan
from acquisition.scan import plan_scan, scan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from calibration.rig_geometry import RigGeometry
from devices.replay import replay_rig
from devices.simulated.rig import SimulatedRig
from devices.simulated.settings import PaintingKind, SimulationSettings
from fitting.surface import reconstruct_surface
from workstation.benchmark_records import Record, Sense
from workstation.demonstration import measure_height_error, true_geometry
from workstation.scan_target import panel_sigma

_PERIODS = (1, 3, 9)
_FRAME_S = 1 / 60
# Target of the plan that is held against the full one, and those of the others, mm.
_TARGET_MM = 0.06
_OTHER_TARGETS_MM = (0.1, 0.3, 0.5, 1.0)
# Of the camera whose plans are drawn.
_CURVE_WIDTH = 1024


class PlanKind(StrEnum):
    """How the frames of a plan were chosen."""

    FULL = "full"
    FIXED = "fixed"
    METERED = "metered"


@dataclass(frozen=True)
class Outcome:
    """What came of a plan.

    Attributes
    ----------
    kind : PlanKind
    name : str
        For people.
    frames : int
        That were taken, those of metering included.
    decoded : float
        Share of the pixels.
    error_mm : float
        RMS error of the heights.
    """

    kind: PlanKind
    name: str
    frames: int
    decoded: float
    error_mm: float


def compare_with_full() -> tuple[Outcome, Outcome]:
    """Scan the oil painting with three megapixels, by the full plan and by a metered one."""
    full, metered = _compare(None, (_TARGET_MM,), fixed=False)
    return full, metered


def compare_plans() -> list[Outcome]:
    """Scan the oil painting with a smaller camera by the full plan, metered and fixed ones."""
    return _compare(_CURVE_WIDTH, (_TARGET_MM, *_OTHER_TARGETS_MM), fixed=True)


def _compare(
    camera_width: int | None, targets_mm: tuple[float, ...], *, fixed: bool
) -> list[Outcome]:
    rig = SimulationSettings(painting=PaintingKind.OIL, camera_width=camera_width).build()
    geometry = true_geometry(rig)
    with TemporaryDirectory() as folder:
        full = _record_full(rig, Path(folder) / "full")
        outcomes = [_outcome(PlanKind.FULL, "full", full, full.plan, rig, geometry)]
        for target_mm in targets_mm:
            metered = _record_metered(full, geometry, Path(folder) / f"{target_mm}", target_mm)
            plan = metered.plan_of(Purpose.CODE)
            name = f"{1000 * target_mm:.0f} µm"
            outcomes.append(_outcome(PlanKind.METERED, name, metered, plan, rig, geometry))
        for name, plan in _fixed_plans(full.plan) if fixed else ():
            outcomes.append(_outcome(PlanKind.FIXED, name, full, plan, rig, geometry))
    return outcomes


def skip_records(full: Outcome, metered: Outcome, outcomes: list[Outcome]) -> list[Record]:
    """Records of a metered plan against the full one; others are told in a note."""
    others = "; ".join(
        f"{o.kind} {o.name}: {o.frames}, {1000 * o.error_mm:.1f} µm, {o.decoded:.0%}"
        for o in outcomes
    )
    return [
        Record(
            name="skip.frames_fraction",
            value=metered.frames / full.frames,
            unit="",
            bound=0.6,
            sense=Sense.AT_MOST,
            note=f"{metered.frames} of {full.frames} frames for a target of {metered.name}, those "
            "of metering included",
        ),
        Record(
            name="skip.height_error_ratio",
            value=metered.error_mm / full.error_mm,
            unit="",
            bound=1.05,
            sense=Sense.AT_MOST,
            note=f"{1000 * metered.error_mm:.2f} over {1000 * full.error_mm:.2f} µm; with fewer "
            f"pixels, {others}",
        ),
        Record(
            name="skip.decoded_ratio",
            value=metered.decoded / full.decoded,
            unit="",
            bound=0.995,
            sense=Sense.AT_LEAST,
            note=f"{metered.decoded:.2%} of the pixels over {full.decoded:.2%}",
        ),
    ]


def draw_outcomes(outcomes: list[Outcome], file: Path) -> None:
    """Draw errors against frames, each with the share of pixels that were decoded."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    styles = {PlanKind.FULL: "kD", PlanKind.FIXED: "s", PlanKind.METERED: "o-"}
    for kind, style in styles.items():
        of_kind = sorted((o for o in outcomes if o.kind is kind), key=lambda o: o.frames)
        frames, errors = [o.frames for o in of_kind], [1000 * o.error_mm for o in of_kind]
        axes.plot(frames, errors, style, label=str(kind))
        for number, outcome in enumerate(of_kind):
            # Targets that ask for the same frames have one label.
            alike = [o.name for o in of_kind if o.frames == outcome.frames and _same(o, outcome)]
            if outcome.name != alike[0]:
                continue
            axes.annotate(
                f"{', '.join(alike)}: {outcome.decoded:.0%}",
                (outcome.frames, 1000 * outcome.error_mm),
                textcoords="offset points",
                xytext=(6, 5) if kind is PlanKind.FIXED else (-4, -12 - 11 * (number % 2)),
                fontsize=8,
            )
    axes.set_xlabel("frames taken")
    axes.set_ylabel("RMS error of heights, µm")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}")
    axes.set_title("Simulated oil painting; beside each plan the share of pixels decoded")
    axes.margins(x=0.14, y=0.1)
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    figure.savefig(file, dpi=120)


def _same(one: Outcome, other: Outcome) -> bool:
    return bool(np.isclose(one.error_mm, other.error_mm, rtol=1e-6))


def _record_full(rig: SimulatedRig, out: Path) -> Session:
    devices = rig.open()
    plan = plan_scan(devices, exposure_s=tuple(_FRAME_S * n for n in _PERIODS))
    with SessionWriter.create(out, plan) as writer:
        scan(writer, devices)
    return Session.open(out)


def _record_metered(full: Session, geometry: RigGeometry, out: Path, target_mm: float) -> Session:
    sigma = panel_sigma(geometry, target_mm)
    rule = Metering(column_sigma_px=sigma[Axis.COLUMN], row_sigma_px=sigma[Axis.ROW])
    plan = full.plan.model_copy(update={"metering": rule})
    with replay_rig(recording_of(full)) as rig, SessionWriter.create(out, plan) as writer:
        record_plan(writer, rig)
    return Session.open(out)


def _fixed_plans(full: Plan) -> list[tuple[str, Plan]]:
    """Parts of the full plan that somebody might have planned: fewer exposures, or fewer steps."""
    plans = []
    for periods in ((1,), (3,), (9,), (1, 3), (3, 9), _PERIODS):
        for steps in (8, 4):
            if periods == _PERIODS and steps == 8:
                continue
            wanted = {_FRAME_S * n for n in periods}
            frames = tuple(
                frame
                for frame in full.frames
                if frame.exposure_s in wanted
                and (not isinstance(frame.pattern, PhaseShift) or _of_steps(frame.pattern, steps))
            )
            exposures = "+".join(map(str, periods))
            name = f"{exposures} periods, {steps} steps"
            plans.append((name, full.model_copy(update={"frames": frames})))
    return plans


def _of_steps(pattern: PhaseShift, steps: int) -> bool:
    turns = pattern.shift_rad / (2 * np.pi) * steps
    return bool(abs(turns - round(turns)) < 1e-6)


def _outcome(
    kind: PlanKind,
    name: str,
    session: Session,
    plan: Plan,
    rig: SimulatedRig,
    geometry: RigGeometry,
) -> Outcome:
    correspondence = decode(plan, session.read_frame)
    copy = reconstruct_surface(correspondence, geometry).copy
    error = measure_height_error(copy, rig)
    return Outcome(
        kind, name, len(plan.frames), float(correspondence.valid.mean()), error.observed_rms_mm
    )
