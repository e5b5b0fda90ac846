"""The page that says how good a calibration is: ``index.html`` without outside requests, and JSON.

It opens with what a conservator needs, verdict and uncertainty of heights, and goes on to what a
metrologist asks for: residuals and their distribution, uncertainty over the image, coverage,
cross-validation, a plane that took no part, drift, and every pose and corner that was left out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from acquisition.atomic_files import write_bytes
from calibration.procam import LENS_NAMES
from workstation.calibration_figures import calibration_figures
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
from workstation.report_page import Picture, page_templates
from workstation.report_sections import ReportSections, srgb_code
from workstation.rig_calibration import CalibratedRig
from workstation.section_plots import light_picture, response_picture

PAGE_FILE = "index.html"
JSON_FILE = "report.json"
_PARAMETERS = ("f_x", "f_y", "c_x", "c_y", "k₁", "k₂", "p₁", "p₂", "k₃", "k₄", "k₅", "k₆")


def write_report(
    done: CalibratedRig, folder: Path, *, sections: ReportSections | None = None
) -> None:
    """Write the page and its figures into a folder, which is made.

    Parameters
    ----------
    done : CalibratedRig
    folder : Path
    sections : ReportSections, optional
        Light positions, response curves and colours, if they were measured.
    """
    sections = sections or ReportSections()
    figures = calibration_figures(done)
    environment = page_templates()
    environment.filters["srgb"] = srgb_code
    page = environment.get_template("calibration.html").render(
        figures=figures,
        summary=_summary(figures),
        parameters=_parameters(figures),
        pictures=_pictures(done),
        sections=sections,
        light_picture=_light_picture(sections),
        response_pictures=[Picture(c.name, response_picture(c)) for c in sections.responses],
    )
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / JSON_FILE, figures | sections.as_json())
    write_bytes(folder / PAGE_FILE, page.encode())


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
    plane = figures["heldout_plane"]
    if plane is not None:
        said.append(
            f"The board of pose {plane['pose']}, reconstructed by a calibration that has not seen "
            f"it, is flat to {1000 * plane['smoothed_rms_mm']:.0f} µm over 1.5 mm; its size is "
            f"{100 * plane['scale_error']:+.3f} % off."
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


def _light_picture(sections: ReportSections) -> Picture | None:
    if sections.lights is None:
        return None
    caption = "Positions of the lamp; the square is the origin"
    return Picture(caption, light_picture(sections.lights))


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
            "standard deviation of projection at the working distance, worst direction",
        ),
        "coverage": each(coverage_picture, "corners that took part"),
        "tilts": [Picture("Tilts of the boards; rings at 20° and 40°", tilt_picture(done))],
        "heights": [],
        "difference": [],
        "plane": [],
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
    if done.plane is not None:
        caption = f"Board of {done.plane.pose}, held out, its plane removed, averaged over 1.5 mm"
        pictures["plane"] = [Picture(caption, plane_picture(done.plane.relief.height_mm))]
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
