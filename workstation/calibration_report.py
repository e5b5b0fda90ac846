"""The page that says how good a calibration is: ``index.html`` without outside requests, and JSON.

It opens with what a conservator needs, verdict and uncertainty of heights, and goes on to what a
metrologist asks for: residuals and their distribution, uncertainty over the image, coverage,
cross-validation, a plane that took no part, drift, and every pose and corner that was left out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acquisition.atomic_files import write_bytes
from calibration.procam import LENS_NAMES
from calibration.verdicts import GateReport
from workstation.calibration_figures import calibration_figures
from workstation.calibration_messages import messages_on_lights
from workstation.calibration_plots import (
    coverage_picture,
    difference_picture,
    height_picture,
    plane_picture,
    residual_histogram,
    residual_means,
    residual_vectors,
    tilt_picture,
    uncertainty_picture,
)
from workstation.json_output import write_json
from workstation.light_calibration import CalibratedLights
from workstation.report_page import Picture, Section, Table, anchor, page_templates, write_page
from workstation.report_sections import LightSection, ReportSections, srgb_code
from workstation.rig_calibration import CalibratedRig
from workstation.section_plots import flat_field_picture, light_picture, response_picture
from workstation.surface_figures import surface_sentences
from workstation.surface_section import surface_section

PAGE_FILE = "index.html"
JSON_FILE = "report.json"
_PARAMETERS = ("f_x", "f_y", "c_x", "c_y", "k₁", "k₂", "p₁", "p₂", "k₃", "k₄", "k₅", "k₆")


def write_report(
    done: CalibratedRig,
    folder: Path,
    *,
    sections: ReportSections | None = None,
    figures: dict[str, Any] | None = None,
    light_gates: GateReport | None = None,
) -> None:
    """Write the page and its figures into a folder, which is made.

    Parameters
    ----------
    done : CalibratedRig
    folder : Path
    sections : ReportSections, optional
        Light positions, response curves, colours and flat field, if they were measured.
    figures : dict, optional
        Those of :func:`~workstation.calibration_figures.calibration_figures`, and others.
    light_gates : GateReport, optional
        Of the light arm, whose figures are among those given as ``light_arm``.
    """
    sections = sections or ReportSections()
    figures = figures or calibration_figures(done)
    environment = page_templates()
    environment.filters["srgb"] = srgb_code
    environment.filters["anchor"] = anchor
    page = environment.get_template("calibration.html").render(
        figures=figures,
        verdict=_verdict(done.gates),
        gates=_gate_table(done.gates),
        light_verdict=None if light_gates is None else _verdict(light_gates),
        light_gates=None if light_gates is None else _gate_table(light_gates),
        lights=None if sections.lights is None else _light_table(sections.lights),
        summary=_summary(figures),
        parameters=_parameters(figures),
        pictures=_pictures(done),
        surface=_surface(done, figures),
        sections=sections,
        light_picture=_light_picture(sections),
        flat_field_picture=_flat_field_picture(sections),
        response_pictures=[Picture(c.name, response_picture(c)) for c in sections.responses],
    )
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / JSON_FILE, figures | sections.as_json())
    write_bytes(folder / PAGE_FILE, page.encode())


def write_light_report(lights: CalibratedLights, sections: ReportSections, folder: Path) -> None:
    """Write a page on a light arm that was calibrated by itself.

    Parameters
    ----------
    lights : CalibratedLights
    sections : ReportSections
        Light positions among them.
    folder : Path
        It is made.
    """
    figures = lights.figures()
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / JSON_FILE, {"light_arm": figures} | sections.as_json())
    pictures = [_light_picture(sections), _flat_field_picture(sections)]
    responses = tuple(Picture(c.name, response_picture(c)) for c in sections.responses)
    shown = [
        Section("Gates", tables=(_gate_table(lights.gates),)),
        Section(
            "Light arm",
            tables=() if sections.lights is None else (_light_table(sections.lights),),
            pictures=tuple(picture for picture in pictures if picture is not None),
        ),
    ]
    if responses:
        shown.append(Section("Response", pictures=responses))
    write_page(
        folder / PAGE_FILE,
        title="Calibration of the light arm",
        summary=(
            f"{lights.gates.sentence()} {len(figures['spheres'])} mirror spheres under "
            f"{figures['poses']} poses of the lamp. "
            f"Directions to it are known to {figures['direction_sigma_deg_median']:.3f}° at the "
            f"white target, {figures['direction_sigma_deg_largest']:.3f}° at worst; highlights are "
            f"off by {figures['residual_deg_rms']:.2f}° RMS."
        ),
        sections=tuple(shown),
        warnings=messages_on_lights(lights).warnings,
    )


def _gate_table(gates: GateReport) -> Table:
    rows = [
        (
            ", ".join(filter(None, (str(verdict.gate), verdict.subject))) if first else "",
            one.name,
            _figure(one.value),
            f"{one.sense} {_figure(one.bound)}",
            "holds" if one.passed else ("refused" if one.refuses else "warning"),
            verdict.remedy if first else "",
        )
        for verdict in gates.verdicts
        for first, one in ((n == 0, c) for n, c in enumerate(verdict.criteria))
    ]
    rows += [(str(one.gate), "", "–", "", "not tested", one.why) for one in gates.not_tested]
    return Table(
        tuple(rows), heading=("gate", "criterion", "found", "bound", "outcome", "what to do")
    )


def _figure(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.4g}"


def _light_table(lights: LightSection) -> Table:
    rows = zip(lights.names, lights.position_mm, lights.residual_deg, lights.sigma_deg, strict=True)
    return Table(
        tuple(
            (
                name,
                ", ".join(f"{value:.1f}" for value in place),
                "–" if np.isnan(off) else f"{off:.3f}°",
                f"{sigma:.3f}°",
            )
            for name, place, off, sigma in rows
        ),
        heading=("azimuth, elevation", "X, Y, Z, mm", "residual", "standard error"),
    )


def _surface(done: CalibratedRig, figures: dict[str, Any]) -> Section | None:
    surface = done.calibration.surface
    return None if surface is None else surface_section(surface, figures["surface"])


def _verdict(gates: GateReport) -> dict[str, str]:
    colour = "flag" if gates.failures or gates.not_tested else "good"
    return {"colour": colour if gates.passed else "bad", "sentence": gates.sentence()}


def _summary(figures: dict[str, Any]) -> list[str]:
    """What somebody who only wants to scan has to know."""
    said = []
    heights = figures["heights"]
    distance = figures["working_distance_mm"]
    if heights is not None:
        length = 100 * heights["scale_sigma"]
        said.append(
            f"At {distance:.0f} mm from the camera this calibration leaves heights uncertain by "
            f"{1000 * heights['sigma_rms_mm']:.0f} µm (one standard deviation, the plane of the "
            f"painting removed; {1000 * heights['sigma_largest_mm']:.0f} µm at worst, near the "
            f"edges), and lengths by {length:.3f} %, which is {10 * length:.2f} mm in a metre. The "
            "noise of a scan comes on top."
        )
    else:
        said.append("Camera and projector share too little of the field to tell heights.")
    if not figures["board"]["square_sigma_mm"]:
        said.append(
            "The side of the board's squares was taken as exact: an error of it is an error of all "
            "lengths in proportion. Give its standard error with --square-sigma."
        )
    if figures["surface"] is not None:
        said += [f"{text[0].upper()}{text[1:]}." for text in surface_sentences(figures["surface"])]
    planes = figures["heldout_planes"]
    if planes:
        plane = max(planes, key=lambda one: one["smoothed_rms_mm"])
        sizes = max((one["scale_error"] for one in planes), key=abs)
        said.append(
            f"Of {len(planes)} boards, each reconstructed by a calibration that has not seen it, "
            f"the worst, {plane['pose']}, is flat to {1000 * plane['smoothed_rms_mm']:.0f} µm over "
            f"1.5 mm; sizes are up to {100 * sizes:+.3f} % off."
        )
    if figures.get("light_arm_error"):
        said.append(f"The light arm was not calibrated: {figures['light_arm_error']}.")
    unread = [pose["name"] for pose in figures["unread"]]
    if unread:
        said.append(
            f"In {len(unread)} of {len(unread) + len(figures['sessions'])} sessions no board was "
            f"measured: {', '.join(unread)}."
        )
    return said


def _parameters(figures: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """Intrinsics with their standard errors, a column per lens; only for lenses of few numbers."""
    lenses = [figures["lenses"][name] for name in LENS_NAMES]
    count = len(lenses[0]["intrinsics"])
    if count > len(_PARAMETERS):
        return []
    return [
        (
            _PARAMETERS[n] + (", px" if n < 4 else ""),
            [
                _with_error(lens["intrinsics"][n], lens["intrinsics_sigma"][n], 2 if n < 4 else 5)
                for lens in lenses
            ],
        )
        for n in range(count)
    ]


def _with_error(value: float, sigma: float, digits: int) -> str:
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _of_one_scale(heights_mm: list[NDArray[np.float64]], name: str) -> list[bytes]:
    """Maps of heights with one scale of colours."""
    if not heights_mm:
        return []
    reach = max(float(np.nanpercentile(np.abs(height), 99)) for height in heights_mm)
    return [plane_picture(height, reach_mm=reach, name=name) for height in heights_mm]


def _light_picture(sections: ReportSections) -> Picture | None:
    if sections.lights is None:
        return None
    caption = (
        "Positions of the lamp about the white target, which is the square; colours are what the "
        "model of the arm leaves of the lamp's direction, grey where that was not seen"
    )
    return Picture(caption, light_picture(sections.lights))


def _flat_field_picture(sections: ReportSections) -> Picture | None:
    if sections.flat_field is None:
        return None
    caption = "Vignetting: what the camera makes of even light, 1 on its axis"
    return Picture(caption, flat_field_picture(sections.flat_field))


def _pictures(done: CalibratedRig) -> dict[str, list[Picture]]:
    numbers = range(len(LENS_NAMES))

    def each(draw: Any, caption: str) -> list[Picture]:
        return [Picture(f"{LENS_NAMES[n].capitalize()}: {caption}", draw(done, n)) for n in numbers]

    pictures = {
        "vectors": each(residual_vectors, "residuals of all poses, solved less observed"),
        "histograms": each(residual_histogram, "residuals over their standard deviations"),
        "means": each(
            residual_means,
            "mean residual of regions, columns above rows, px; shaded where it is more than noise",
        ),
        "uncertainty": each(
            uncertainty_picture,
            "standard deviation of projection at the working distance, worst direction; colours "
            "end at 97 % of the imager",
        ),
        "coverage": each(coverage_picture, "corners that took part"),
        "tilts": [Picture("Tilts of the boards; rings at 20° and 40°", tilt_picture(done))],
        "heights": [],
        "difference": [],
        "plane": [],
        "repeatability": [],
        "drift": [],
    }
    if done.heights is not None:
        pictures["heights"] = [
            Picture(
                "Standard error of heights on a plane at the working distance, plane removed",
                height_picture(done.heights),
            )
        ]
    pictures["difference"] = [
        Picture(
            f"{LENS_NAMES[n].capitalize()}: difference of two calibrations from every other pose",
            difference_picture(done, n, difference),
        )
        for n, difference in enumerate(done.differences)
    ]
    reliefs = [plane.relief.height_mm for plane in done.planes]
    pictures["plane"] = [
        Picture(f"Board of {plane.pose}, its plane removed", picture)
        for plane, picture in zip(done.planes, _of_one_scale(reliefs, "height"), strict=True)
    ]
    repeatability = done.repeatability
    if repeatability is not None:
        differences = _of_one_scale(list(repeatability.difference_mm), "difference")
        pictures["repeatability"] = [
            Picture(f"Board of {plane.pose} less the mean of the others", picture)
            for plane, picture in zip(done.planes, differences, strict=True)
        ]
    if done.earlier:
        drift = done.earlier[0].drift
        pictures["drift"] = [
            Picture(
                f"{LENS_NAMES[n].capitalize()}: change since {done.earlier[0].name}",
                difference_picture(done, n, change),
            )
            for n, change in enumerate((drift.camera, drift.projector))
        ]
    return pictures
