"""The demo from its first frame to its report, in stages that say what they took."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from acquisition.session import Session
from devices.simulated.rig import SimulatedRig
from fitting.digital_copy import DigitalCopy
from fitting.reflectance.lamp_table import LampTable
from workstation.copy_places import run_file
from workstation.copy_writing import read_run, write_processed, write_run
from workstation.demo_bounds import bounds_section, demo_records
from workstation.demo_processing import (
    LAMPS_FILE,
    RIG_FOLDER,
    calibrate_arm,
    calibrate_from_board,
    process_demo,
)
from workstation.demo_recording import (
    PHOTOGRAPHS_SESSION,
    SCAN_SESSION,
    DemoCapture,
    DemoRecorder,
    DemoSize,
)
from workstation.demo_truth import declared_lamps, measure_truth
from workstation.demonstration import true_geometry
from workstation.interruption import interruption_held, stop_if_requested
from workstation.json_output import write_json
from workstation.processing import DECODING, FIGURES, REFLECTANCE, REGISTRATION, RELIEF, SURFACE
from workstation.quality import Quality
from workstation.report_page import Section, Table
from workstation.session_report import write_session_report
from workstation.stage_cache import StageCache, StageRun, peak_memory

T = TypeVar("T")

REPORT_FILE = "report.json"
SESSIONS_FOLDER = "sessions"
COPY_FOLDER = "copy"
PAINTING = "painting and lighting the scene"
BOARD = "scanning a calibration board"
CALIBRATION = "calibrating camera and projector"
LIGHTS = "photographing mirror spheres and a white target"
ARM = "calibrating the light arm"
SCAN = "scanning the painting"
PHOTOGRAPHS = "photographing it under the light arm"
RENDERING = "rendering six views"
TRUTH = "comparing with the truth"
REPORT = "writing the report"
_NAME = "the demo's oil sketch"

# On two cores of a server of 2023; only to tell the time left.
EXPECTED_S: dict[DemoSize, dict[str, float]] = {
    DemoSize.USUAL: {
        PAINTING: 1.5,
        BOARD: 9.0,
        CALIBRATION: 22.0,
        LIGHTS: 4.5,
        SCAN: 1.6,
        PHOTOGRAPHS: 12.0,
        ARM: 11.0,
        DECODING: 0.2,
        SURFACE: 0.7,
        RELIEF: 0.1,
        FIGURES: 0.1,
        REGISTRATION: 3.0,
        REFLECTANCE: 36.0,
        RENDERING: 3.5,
        TRUTH: 1.3,
        REPORT: 8.0,
    },
    DemoSize.TINY: {
        PAINTING: 1.5,
        SCAN: 0.5,
        PHOTOGRAPHS: 1.5,
        DECODING: 0.4,
        SURFACE: 0.4,
        REGISTRATION: 1.5,
        REFLECTANCE: 5.0,
        RENDERING: 3.0,
        REPORT: 3.0,
    },
}


@dataclass
class _Stages:
    """Runs what is no stage of processing, and notes what it took."""

    begin: Callable[[str], None]
    done: Callable[[StageRun], None]
    runs: list[StageRun] = field(default_factory=list)

    def run(self, name: str, work: Callable[[], T]) -> T:
        self.begin(name)
        started = time.perf_counter()
        with peak_memory() as peak_mb:
            result = work()
        self.ended(StageRun(name, time.perf_counter() - started, False, 0.0, peak_mb()))
        return result

    def ended(self, run: StageRun) -> None:
        self.runs.append(run)
        self.done(run)


def run_demo(
    folder: Path,
    size: DemoSize,
    *,
    seed: int = 0,
    begin: Callable[[str], None] = lambda stage: None,
    done: Callable[[StageRun], None] = lambda run: None,
) -> dict[str, Any]:
    """Record, process, render and judge the simulated painting.

    Parameters
    ----------
    folder : Path
        An empty folder: gets the sessions, the rig, the copy, renders, ``index.html`` and
        ``report.json``.
    size : DemoSize
    seed : int
        Of painting and noise.
    begin, done : callable, optional
        Told of each stage.

    Returns
    -------
    dict
        The figures, as ``report.json`` has them.

    Raises
    ------
    ImpastoError
        From any stage.
    """
    started = time.perf_counter()
    stages = _Stages(begin, done)
    capture = DemoCapture.of(size)
    rig = stages.run(PAINTING, lambda: capture.rig(seed=seed))
    sessions = folder / SESSIONS_FOLDER
    sessions.mkdir()
    recorder = DemoRecorder(rig, capture, sessions, advance=lambda _: stop_if_requested())
    calibration = _record_and_calibrate(stages, recorder, capture, rig, folder)
    cache = StageCache(None, begin, done=stages.ended)
    processed = process_demo(sessions, folder, capture, cache)
    copy = folder / COPY_FOLDER
    write_processed(processed, copy)
    stages.run(RENDERING, lambda: _render(processed.copy, folder / "renders", capture.render_px))
    lamps = LampTable.load(folder / LAMPS_FILE)
    arm = calibration.get("lights", {})
    truth = stages.run(
        TRUTH,
        lambda: measure_truth(
            processed,
            rig,
            lamps,
            lamp_direction_predicted_deg=arm.get("direction_error_deg_median"),
        ),
    )
    write_run(
        processed, copy, {"quality": str(Quality.NORMAL), "expected_seconds": EXPECTED_S[size]}
    )

    def gathered() -> dict[str, Any]:
        return processed.figures | {
            "size": str(size),
            "seed": seed,
            "calibration": calibration,
            "truth": truth.figures(),
            "stages": [vars(one) for one in stages.runs],
            "peak_mb": max(one.peak_mb for one in stages.runs),
            "total_seconds": round(time.perf_counter() - started, 2),
        }

    def write_report() -> None:
        run = (read_run(copy) or {}) | {"stages": [vars(one) for one in stages.runs]}
        write_json(run_file(copy), run)
        write_session_report(
            copy,
            folder / "index.html",
            # The folder has another name while it is being filled.
            name=_NAME,
            session=Session.open(sessions / SCAN_SESSION),
            photographs=Session.open(sessions / PHOTOGRAPHS_SESSION),
            run=run,
            view_px=capture.render_px,
            more=(
                truth.section(processed.copy),
                bounds_section(demo_records(gathered())),
                _calibration_section(calibration),
            ),
            height_mm=truth.heights.observed_rms_mm,
        )

    stages.run(REPORT, write_report)
    figures = gathered()
    figures["bounds"] = [record.as_json() for record in demo_records(figures)]
    write_json(folder / REPORT_FILE, figures)
    return figures


def _record_and_calibrate(
    stages: _Stages,
    recorder: DemoRecorder,
    capture: DemoCapture,
    rig: SimulatedRig,
    folder: Path,
) -> dict[str, Any]:
    """Record every session, with the calibrations that they need in between; their figures."""
    sessions = folder / SESSIONS_FOLDER
    if not capture.calibrates:
        true_geometry(rig).save(folder / RIG_FOLDER)
        stages.run(SCAN, lambda: recorder.record_scan(folder / RIG_FOLDER))
        stages.run(PHOTOGRAPHS, recorder.record_photographs)
        declared_lamps(rig, sessions / PHOTOGRAPHS_SESSION).save(folder / LAMPS_FILE)
        return {"declared": True}
    stages.run(BOARD, recorder.record_board)
    board = stages.run(CALIBRATION, lambda: calibrate_from_board(sessions, folder))
    stages.run(LIGHTS, recorder.record_lights)
    stages.run(SCAN, lambda: recorder.record_scan(folder / RIG_FOLDER))
    stages.run(PHOTOGRAPHS, recorder.record_photographs)
    lights = stages.run(ARM, lambda: calibrate_arm(sessions, board, folder))
    solution = board.calibration.solution
    return {
        "declared": False,
        "poses": len(board.calibration.views),
        "stereo_px": solution.rms_per_point_px,
        "gates_failed": [str(verdict.gate) for verdict in board.gates.failures],
        "height_sigma_mm": None if board.heights is None else board.heights.rms_mm,
        "lights": lights.figures(),
    }


def _calibration_section(calibration: dict[str, Any]) -> Section:
    if calibration["declared"]:
        return Section(
            "How the rig was calibrated",
            "It was not: this tiny demo takes the geometry and the lamps that the simulated rig "
            "declares.",
        )
    lights = calibration["lights"]
    rows = (
        ("poses of the board", str(calibration["poses"])),
        ("residual of a corner", f"{calibration['stereo_px']:.3f} px"),
        ("gates that failed", ", ".join(calibration["gates_failed"]) or "none"),
        ("lamps", f"{lights['poses']} poses on {len(lights['spheres'])} mirror spheres"),
        ("residual of a lamp's direction", f"{lights['residual_deg_rms']:.3f}°"),
        ("standard error of a lamp's direction", f"{lights['direction_sigma_deg_median']:.3f}°"),
    )
    return Section(
        "How the rig was calibrated",
        "Camera and projector by scans of a board at several poses; the light arm by photographs "
        "of mirror spheres and of a white target.",
        tables=(Table(rows),),
    )


def _render(copy: DigitalCopy, folder: Path, size: tuple[int, int]) -> None:
    from render.painter import Painter
    from render.painting_node import Mode
    from render.picture_files import write_picture
    from render.views import NamedView, named_view

    folder.mkdir()
    with Painter() as painter:
        for view in NamedView:
            stop_if_requested()
            camera = named_view(copy, view, aspect=4 / 3)
            picture = painter.paint(copy, camera, mode=Mode.RELIEF, width=size[0], height=size[1])
            with interruption_held():
                write_picture(picture, folder / f"{view}.png")
