"""The demo's figures against bounds: whether the instrument as a whole is as good as its parts."""

from __future__ import annotations

from typing import Any

from workstation.benchmark_records import Record, Sense, record_row
from workstation.report_page import Section, Table


def demo_records(figures: dict[str, Any]) -> list[Record]:
    """Hold a demo's figures against the bounds of its stages.

    Parameters
    ----------
    figures : dict
        As :func:`workstation.demo_job.run_demo` gathers them.

    Returns
    -------
    list of Record
        Those of the calibration only where there was one.
    """
    truth, held = figures["truth"], figures["reflectance"]["held_out"]
    return [
        *_of_calibration(figures),
        _within(
            "height_rms_over_predicted",
            truth["height_rms_over_predicted"],
            (0.8, 1.25),
            f"{1e3 * truth['height_rms_mm']:.1f} µm RMS",
        ),
        _at_most("texels_outside_canvas", truth["texels_outside_canvas"], 0),
        Record(
            name="demo.heldout_psnr_db",
            value=held["psnr_db"],
            unit="dB",
            bound=35.0,
            sense=Sense.AT_LEAST,
            runs=len(held["photographs"]),
            note="of photographs kept out of the fit; their noise alone leaves "
            f"{held['noise_psnr_db']:.1f} dB",
        ),
        _at_most(
            "heldout_delta_e",
            held["delta_e"],
            1.5,
            note=f"noise alone leaves {held['noise_delta_e']:.2f}",
            runs=len(held["photographs"]),
        ),
        _at_most("peak_mb", figures["peak_mb"], 3000.0, "MB", _dearest(figures, "peak_mb", "MB")),
        _at_most(
            "seconds", figures["total_seconds"], 150.0, "s", _dearest(figures, "seconds", "s")
        ),
    ]


def bounds_section(records: list[Record]) -> Section:
    """The part of the demo's report."""
    rows = tuple(
        (record.name.removeprefix("demo.").replace("_", " "), *record_row(record)[1:])
        for record in records
    )
    return Section(
        "Figures and bounds",
        "What the stages are held against on their own, of this one painting as a whole.",
        tables=(Table(rows, ("", "measured", "bound", "holds", "")),),
    )


def _of_calibration(figures: dict[str, Any]) -> list[Record]:
    calibration, truth = figures["calibration"], figures["truth"]
    if calibration["declared"]:
        return []
    predicted = truth["lamp_direction_predicted_deg"]
    return [
        _at_most(
            "stereo_px",
            calibration["stereo_px"],
            0.3,
            "px",
            f"residual of a corner, {calibration['poses']} poses of the board",
        ),
        _at_most(
            "gates_failed",
            len(calibration["gates_failed"]),
            0,
            note=", ".join(calibration["gates_failed"]),
        ),
        _at_most(
            "lamp_direction_deg",
            truth["lamp_direction_deg"],
            0.1,
            "°",
            f"median against the truth; predicted {predicted:.3f}°",
        ),
    ]


def _at_most(
    name: str, value: float, bound: float, unit: str = "", note: str = "", runs: int = 1
) -> Record:
    return Record(
        name=f"demo.{name}",
        value=value,
        unit=unit,
        bound=bound,
        sense=Sense.AT_MOST,
        runs=runs,
        note=note,
    )


def _within(name: str, value: float, bound: tuple[float, float], note: str) -> Record:
    return Record(
        name=f"demo.{name}", value=value, unit="", bound=bound, sense=Sense.WITHIN, note=note
    )


def _dearest(figures: dict[str, Any], what: str, unit: str) -> str:
    """The three stages that take the most of something."""
    dearest = sorted(figures["stages"], key=lambda stage: -stage[what])[:3]
    return ", ".join(f"{stage['name']} {stage[what]:.0f} {unit}" for stage in dearest)
