"""The part of a report on run time against error: stated before, measured after, and the curve."""

from __future__ import annotations

import math
from typing import Any

from workstation.quality_curve import QualityCurve
from workstation.quality_plots import curve_pictures
from workstation.report_page import Section, Table
from workstation.stage_progress import clock_text


def quality_section(
    run: dict[str, Any], errors: dict[str, Any], curve: QualityCurve, *, height_mm: float | None
) -> Section:
    """What the quality of a copy was said to cost and give, what it did, and what others do.

    Parameters
    ----------
    run : dict
        Record of the run (``COPY-run.json``).
    errors : dict
        Of the copy's stages, as its provenance has them.
    curve : QualityCurve
    height_mm : float or None
        RMS error of the heights, where the truth is known.
    """
    quality = str(run.get("quality", "normal"))
    usual, chosen = (curve.quality(name) for name in ("normal", quality))
    stages = run.get("stages", ())
    expected = sum((run.get("expected_seconds") or {}).values())
    taken = sum(stage["seconds"] + stage["saved_s"] for stage in stages)
    found = [f"standard error {1e3 * errors.get('height_sigma_mm', math.nan):.1f} µm, median"]
    if height_mm is not None:
        found.insert(0, f"RMS {1e3 * height_mm:.1f} µm")
    rows = [
        ("all stages", clock_text(expected) if expected else "", clock_text(taken)),
        (
            "error of heights",
            f"{1e3 * chosen.height_mm:.1f} µm on {curve.scene}, "
            f"{chosen.height_mm / usual.height_mm:.2f} times that of normal",
            "; ".join(found),
        ),
    ]
    if isinstance(errors.get("heldout_psnr_db"), float):
        rows.append(
            (
                "photographs kept out of the fit",
                f"{chosen.heldout_db:.1f} dB there, "
                f"{chosen.heldout_db - usual.heldout_db:+.1f} dB against normal",
                f"{errors['heldout_psnr_db']:.1f} dB",
            )
        )
    front = [point.label for point in curve.front]
    on_it = "lies" if chosen.label in front else "does not lie"
    return Section(
        "Run time against error",
        f"Quality {quality} of this copy, and below it what other settings cost and give: measured "
        f"on {curve.scene} on {curve.measured} by {curve.software}, {curve.machine}. The line "
        "joins what no other setting beats; the star is normal, and a ring is around this copy's "
        f"quality, which {on_it} on the Pareto front of time and both errors. Other paintings, "
        "sizes and machines have other figures.",
        tables=(Table(tuple(rows), ("", "stated before", "measured")),),
        pictures=curve_pictures(curve, chosen=quality),
    )
