"""The report of a copy: what was captured, what came of it, how well it is known, how it looks."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from acquisition.contact_sheet import draw_contact_sheets
from acquisition.session import Session
from calibration.rig_geometry import RigGeometry
from fitting.copy_files import read_copy
from fitting.digital_copy import DigitalCopy
from render.painter import Painter
from render.painting_node import Mode
from render.views import NamedView, named_view
from workstation.copy_writing import copy_title
from workstation.quality_curve import QualityCurve, shipped_curve
from workstation.report_maps import draw_map, shaded_relief
from workstation.report_page import Fold, Picture, Section, Table, write_page
from workstation.report_quality import quality_section
from workstation.report_reflectance import held_out_section, reflectance_section
from workstation.report_sources import calibration_behind
from workstation.report_stages import stages_section

# Parts that progress is told of: contact sheet, maps and views.
PARTS = 2 + len(NamedView)
_VIEW_PX = (640, 480)
_JPEG_QUALITY = 88


def write_session_report(
    copy_folder: Path,
    path: Path,
    *,
    name: str | None = None,
    session: Session | None = None,
    photographs: Session | None = None,
    calibration: Path | None = None,
    run: dict[str, Any] | None = None,
    more: Sequence[Section] = (),
    curve: QualityCurve | None = None,
    height_mm: float | None = None,
    view_px: tuple[int, int] = _VIEW_PX,
    begin: Callable[[str], None] = lambda part: None,
) -> dict[str, Any]:
    """Write the report of a copy as one HTML page.

    Parameters
    ----------
    copy_folder : Path
    path : Path
        The page.
    name : str, optional
        What the copy is called, by default after its folder.
    session : Session, optional
        What the copy was made from, for what was captured and how it was calibrated.
    photographs : Session, optional
        Those that its reflectance was made from.
    calibration : Path, optional
        That which the copy was made with, if it is not the session's own.
    run : dict, optional
        Record of the run that made the copy, for what each stage took.
    more : sequence of Section
        Further parts, after the errors.
    curve : QualityCurve, optional
        Run time against error of other settings; by default that which comes with the program.
    height_mm : float, optional
        RMS error of the heights, where the truth is known.
    view_px : (int, int)
        Width and height of a view.
    begin : callable
        Called with the name of each part as it is begun, :data:`PARTS` times at the most.

    Returns
    -------
    dict
        Its main figures, as plain JSON values.

    Raises
    ------
    ImpastoError
        The copy or the session cannot be read, or the copy cannot be drawn.
    """
    copy = read_copy(copy_folder)
    sections = []
    if session is not None:
        begin("contact sheet")
        sections += [
            _captured(session),
            _calibration(calibration_behind(copy.provenance, session, calibration)),
        ]
    elif calibration is not None:
        sections.append(_calibration(calibration))
    if photographs is not None:
        sections.append(_captured(photographs, title="Photographs"))
    begin("maps")
    sections += [_heights(copy), _relief(copy)]
    if copy.reflectance is not None:
        sections.append(reflectance_section(copy))
    held_out = held_out_section(copy_folder)
    if held_out is not None:
        sections.append(held_out)
    sections += [_errors(copy), *more, _views(copy, view_px, begin)]
    if run:
        sessions = tuple(one for one in (session, photographs) if one is not None)
        sections.append(stages_section(run, sessions))
        sections.append(
            quality_section(
                run,
                copy.provenance.get("errors", {}),
                shipped_curve() if curve is None else curve,
                height_mm=height_mm,
            )
        )
    sections.append(_parameters(copy))
    width, height = copy.height_field.size_mm
    write_page(
        path,
        title=f"A digital copy: {name or copy_title(copy_folder)}",
        summary=(
            f"{width:.0f} × {height:.0f} mm of canvas in {int(copy.height_field.mask.sum())} "
            f"texels of {copy.height_field.pitch_mm:.3f} mm, made by "
            f"{copy.provenance.get('software', 'an unknown program')} from "
            f"{copy.provenance.get('source', 'an unknown source')}."
        ),
        sections=tuple(sections),
        warnings=tuple(map(str, copy.provenance.get("warnings", ()))),
    )
    return {
        "size_mm": list(copy.height_field.size_mm),
        "texels": int(copy.height_field.mask.sum()),
        "sections": [section.title for section in sections],
        "errors": copy.provenance.get("errors", {}),
        "warnings": list(copy.provenance.get("warnings", ())),
    }


def _captured(session: Session, *, title: str = "What was captured") -> Section:
    sheets, figures = draw_contact_sheets(session, columns=8, rows=5)
    exposures = sorted({f.exposure_s for f in figures if f.exposure_s is not None})
    purposes = Counter(str(frame.purpose) for frame in session.frames)
    places = {frame.camera_position for frame in session.frames if frame.camera_position}
    saturated = max((f.saturated for f in figures), default=0.0)
    camera, panel = session.plan.camera, session.plan.projector
    rows = [
        ("frames", ", ".join(f"{n} {purpose}" for purpose, n in purposes.items())),
        ("frames not needed in their brackets", str(len(session.skipped))),
        (
            "camera",
            f"{camera.width} × {camera.height} pixels"
            + ("" if camera.mosaic is None else f", mosaic {camera.mosaic}"),
        ),
        ("projector", f"{panel.width} × {panel.height} pixels"),
        ("exposures", ", ".join(f"{1000 * t:.4g} ms" for t in exposures) or "not known"),
        ("camera positions", ", ".join(sorted(places)) or "one"),
        ("most saturated frame", f"{100 * saturated:.2g} % of its samples"),
        ("digest of the session", session.digest),
    ]
    first, *others = (
        Picture(f"Every frame, in the order of the plan{part}", _jpeg(sheet), wide=True)
        for sheet, part in zip(sheets, _parts(len(sheets)), strict=True)
    )
    return Section(
        title,
        tables=(Table(tuple(rows)),),
        pictures=(first,),
        fold=Fold(f"The other sheets ({len(others)})", tuple(others)) if others else None,
    )


def _parts(count: int) -> list[str]:
    return [""] if count == 1 else [f": {n} of {count}" for n in range(1, count + 1)]


def _calibration(folder: Path | None) -> Section:
    if folder is None:
        return Section(
            "Calibration",
            "The copy was made with a calibration that is not the session's own and not at hand; "
            "impasto report takes it by --calibration.",
        )
    rig = RigGeometry.load(folder)
    rows = [
        (
            name,
            f"{lens.model.removeprefix('LENSMODEL_')}, focal length {lens.intrinsics[0]:.1f} × "
            f"{lens.intrinsics[1]:.1f} pixels, centre {lens.intrinsics[2]:.1f}, "
            f"{lens.intrinsics[3]:.1f}",
        )
        for name, lens in (("camera", rig.camera), ("projector", rig.projector))
    ]
    angle = math.degrees(float(np.linalg.norm(rig.rt_proj_cam[:3])))
    rows += [
        ("baseline", f"{np.linalg.norm(rig.rt_proj_cam[3:]):.1f} mm, turned by {angle:.1f}°"),
        ("uncertainty", "known" if rig.covariance is not None else "not known"),
    ]
    return Section("Calibration", tables=(Table(tuple(rows)),))


def _heights(copy: DigitalCopy) -> Section:
    field = copy.height_field
    heights = field.height.astype(np.float64)
    sigma_um = 1e3 * np.sqrt(field.variance.astype(np.float64))
    slope_deg = np.degrees(copy.slope_sigma.astype(np.float64))
    low, high = field.height_range_mm
    rows = [
        ("lowest and highest", f"{low:.3f} and {high:.3f} mm"),
        ("RMS about the canvas plane", f"{np.std(heights[field.mask]):.3f} mm"),
        ("gaps", f"{100 * (1 - field.mask.mean()):.2f} % of the rectangle"),
    ]
    shape = copy.provenance.get("errors", {}).get("canvas_shape")
    if isinstance(shape, dict):
        for name in ("bow_x", "bow_y", "twist"):
            value, sigma = shape[f"{name}_mm"], shape[f"{name}_sigma_mm"]
            rows.append((name.replace("_", " along "), f"{value:.3f} ± {sigma:.3f} mm"))
    return Section(
        "Heights",
        "Heights stand above the plane that fits the canvas best, towards the viewer. Nothing is "
        "smoothed; gaps stay gaps.",
        tables=(Table(tuple(rows)),),
        pictures=(
            Picture(
                "As matt plaster, lit from the upper left", draw_map(copy, shaded_relief(copy))
            ),
            Picture(
                "Height above the canvas plane, mm; colours end at 0.1 and 99.9 % of the texels",
                draw_map(copy, heights, scale="height, mm", limits=(0.1, 99.9)),
            ),
            Picture(
                "Standard error of the height, µm; colours end at 98 %",
                draw_map(
                    copy, sigma_um, scale="standard error, µm", colours="magma", limits=(0, 98)
                ),
            ),
            Picture(
                "Standard error of the slope, degrees; colours end at 98 %",
                draw_map(
                    copy, slope_deg, scale="standard error, °", colours="magma", limits=(0, 98)
                ),
            ),
        ),
    )


def _relief(copy: DigitalCopy) -> Section:
    relief = copy.relief
    proposed = relief.proposed_delta0_mm
    rows = [
        ("height of the plane, δ0", f"{relief.delta0_mm:.3f} mm"),
        ("δ0 that the histogram proposes", "none" if proposed is None else f"{proposed:.3f} mm"),
        ("boxes", f"{len(relief.boxes)} of {relief.cell} × {relief.cell} texels"),
        ("significant texels", f"{int(relief.significant.sum())}"),
    ]
    mask = copy.height_field.mask
    above = mask & (copy.height_field.height > relief.delta0_mm)
    return Section(
        "Relief",
        "Which texels stand above δ0, what is left of them without specks, and the boxes in which "
        "the renderer walks along its rays.",
        tables=(Table(tuple(rows)),),
        pictures=(
            Picture("Above δ0 dark, below it grey", draw_map(copy, _shades(above))),
            Picture("The same without specks", draw_map(copy, _shades(relief.significant))),
            Picture("Boxes, on the plaster", draw_map(copy, shaded_relief(copy), boxes=True)),
        ),
    )


def _shades(marked: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.repeat(np.where(marked, 0.2, 0.8)[..., np.newaxis], 3, axis=-1)


def _errors(copy: DigitalCopy) -> Section:
    errors: dict[str, Any] = copy.provenance.get("errors", {})
    rows: list[tuple[str, ...]] = []
    noise = errors.get("height_noise")
    if isinstance(noise, dict):
        predicted, observed = noise["predicted_mm"], noise["observed_mm"]
        ratio = f"{observed / predicted:.2f}" if predicted > 0 else ""
        rows.append(("white noise of the range image", _um(predicted), _um(observed), ratio))
    sigma_mm = errors.get("height_sigma_mm", math.nan)
    rows.append(("standard error of a height, median", _um(sigma_mm), "", ""))
    calibration = errors.get("calibration_uncertainty")
    if isinstance(calibration, dict):
        by_rig = _um(calibration["height_sigma_mm"])
    else:
        by_rig = str(calibration or "not known")
    rows.append(("standard error of heights by the calibration", by_rig, "", ""))
    rows += _reflectance_errors(errors)
    return Section(
        "Errors, predicted and observed",
        "Predicted errors come from the sensor's noise and the calibration alone; a ratio of one "
        "says that nothing else is at work.",
        tables=(Table(tuple(rows), ("", "predicted", "observed", "ratio")),),
    )


def _reflectance_errors(errors: dict[str, Any]) -> list[tuple[str, ...]]:
    kept_out = "photographs kept out of the fit"
    # What noise alone would leave of photographs is what is predicted of them.
    named = (
        ("misplacement of texture by registration", "registration_texture_px", "", "{:.4f} px"),
        ("residual of radiance over irradiance, median", "", "reflectance_residual", "{:.4f} 1/sr"),
        (f"{kept_out}, PSNR", "heldout_noise_psnr_db", "heldout_psnr_db", "{:.1f} dB"),
        (f"{kept_out}, mean ΔE2000", "heldout_noise_delta_e", "heldout_delta_e", "{:.2f}"),
    )
    rows = []
    for title, predicted, observed, form in named:
        said = [
            form.format(errors[name]) if isinstance(errors.get(name), float) else ""
            for name in (predicted, observed)
        ]
        if any(said):
            rows.append((title, *said, ""))
    return rows


def _um(length_mm: float) -> str:
    return f"{1e3 * length_mm:.1f} µm"


def _views(copy: DigitalCopy, view_px: tuple[int, int], begin: Callable[[str], None]) -> Section:
    width, height = view_px
    pictures = []
    with Painter() as painter:
        for name in NamedView:
            begin(f"view {name}")
            view = named_view(copy, name, aspect=width / height)
            image = painter.paint(copy, view, mode=Mode.RELIEF, width=width, height=height)
            pictures.append(Picture(str(name), _jpeg(image.encoded()[..., ::-1])))
    return Section("Views", pictures=tuple(pictures), small=True)


def _parameters(copy: DigitalCopy) -> Section:
    rows: list[tuple[str, ...]] = []

    def walk(name: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(f"{name}.{key}" if name else key, inner)
        else:
            rows.append((name, _plain(value)))

    walk("", copy.provenance.get("parameters", {}))
    return Section("Parameters", tables=(Table(tuple(rows)),))


def _plain(value: object) -> str:
    if value is None:
        return "by default from the data"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_plain, value))
    return str(value)


def _jpeg(picture: NDArray[np.uint8]) -> bytes:
    done, content = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    assert done
    return content.tobytes()
