"""From a session on disk to a digital copy on disk, with the figures of every step."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from acquisition.correspondence import CorrespondenceMap, Rejection
from acquisition.decoding import DecodingOptions, decode
from acquisition.plan import Purpose
from acquisition.session import Session
from calibration.errors import CalibrationError
from calibration.registration import RegisteredView, register_photographs
from calibration.rig_geometry import RigGeometry
from fitting.digital_copy import DigitalCopy
from fitting.reflectance.held_out import Comparison
from fitting.reflectance.lamp_table import LampTable
from fitting.reflectance.recorded_photographs import PhotographOptions, read_photographs
from fitting.surface import Surface, SurfaceOptions, reconstruct_surface
from workstation.interruption import interruption_held
from workstation.reflectance_processing import ReflectanceOptions, add_reflectance

_ERROR_SUMMARY = (
    "height_noise",
    "height_sigma_mm",
    "height_unresolved_mm",
    "canvas_shape",
    "calibration_uncertainty",
)


@dataclass(frozen=True, kw_only=True)
class ProcessingOptions:
    """Options of every stage of processing."""

    decoding: DecodingOptions = field(default_factory=DecodingOptions)
    surface: SurfaceOptions = field(default_factory=SurfaceOptions)
    photographs: PhotographOptions = field(default_factory=PhotographOptions)
    reflectance: ReflectanceOptions = field(default_factory=ReflectanceOptions)


@dataclass(frozen=True)
class Processed:
    """A processed session.

    Attributes
    ----------
    copy : DigitalCopy
        With its provenance filled in.
    correspondence : CorrespondenceMap
    surface : Surface
    figures : dict
        Plain JSON values for ``--json`` and reports.
    rig : RigGeometry
        The calibration in force.
    comparisons : tuple of Comparison
        Photographs that were kept out of the fit of the reflectance, beside their renderings.
    """

    copy: DigitalCopy
    correspondence: CorrespondenceMap
    surface: Surface
    figures: dict[str, Any]
    rig: RigGeometry
    comparisons: tuple[Comparison, ...] = ()


def process_session(
    path: Path,
    *,
    calibration: Path | None = None,
    options: ProcessingOptions | None = None,
    begin: Callable[[str], None] = lambda stage: None,
) -> Processed:
    """Process a session into a digital copy in memory.

    Parameters
    ----------
    path : Path
        Session folder.
    calibration : Path, optional
        Folder of a rig calibration to use instead of the session's own.
    options : ProcessingOptions, optional
    begin : callable, optional
        Called with the name of each stage as it starts.

    Raises
    ------
    ImpastoError
        From any stage.
    """
    options = options or ProcessingOptions()
    seconds: dict[str, float] = {}

    def stage(name: str) -> Callable[[], None]:
        begin(name)
        started = time.perf_counter()

        def done() -> None:
            seconds[name] = round(time.perf_counter() - started, 3)

        return done

    done = stage("checking the session")
    session = Session.open(path)
    folder = calibration or session.calibration_folder
    if folder is None:
        raise CalibrationError(
            f"{path}: the session has no rig calibration, so it can be decoded but not "
            "triangulated; name one with --calibration DIR"
        )
    rig = RigGeometry.load(folder)
    _check_sizes(session, rig, folder)
    done()

    done = stage("decoding")
    with interruption_held():
        correspondence = decode(session.plan_of(Purpose.CODE), session.read_frame, options.decoding)
    done()
    done = stage("reconstructing the surface")
    with interruption_held():
        surface = reconstruct_surface(correspondence, rig, options.surface)
    done()

    figures = _figures(correspondence, surface) | {"seconds": seconds}
    provenance = {
        "software": f"impasto {version('impasto')}",
        "session": session.digest,
        "source": session.plan.source,
        "parameters": {"decoding": asdict(options.decoding), "surface": asdict(options.surface)},
        "errors": {name: figures[name] for name in _ERROR_SUMMARY},
        "warnings": figures["warnings"],
    }
    copy = replace(surface.copy, provenance=provenance)
    return Processed(copy, correspondence, surface, figures, rig)


def add_photographs(
    processed: Processed,
    path: Path,
    lamps: Path,
    *,
    options: ProcessingOptions | None = None,
    begin: Callable[[str], None] = lambda stage: None,
) -> Processed:
    """Give a processed scan the reflectance that a session of photographs shows.

    Parameters
    ----------
    processed : Processed
    path : Path
        Session of photographs: the projected code and the lamp's poses from each place.
    lamps : Path
        Table of lamps (:class:`~fitting.reflectance.lamp_table.LampTable`).
    options : ProcessingOptions, optional
    begin : callable, optional
        Called with the name of each stage as it starts.

    Raises
    ------
    ImpastoError
        From any stage.
    """
    options = options or ProcessingOptions()
    begin("registering the photographs")
    session = Session.open(path)
    table = LampTable.load(lamps)
    with interruption_held():
        views = register_photographs(
            session, processed.correspondence, processed.rig, decoding=options.decoding
        )
    begin("reading the photographs")
    with TemporaryDirectory(prefix="impasto-photographs-") as scratch:
        with interruption_held():
            photographs = read_photographs(
                session,
                views,
                table,
                processed.copy.height_field.rt_cam_canvas,
                scratch=Path(scratch),
                options=options.photographs,
            )
        added = add_reflectance(
            processed.copy,
            photographs,
            surface=processed.surface,
            options=options.reflectance,
            begin=begin,
        )
    figures = added.figures | {"registration": _registration(views)}
    provenance = processed.copy.provenance | {
        "photographs": session.digest,
        "reflectance": {name: added.figures.get(name) for name in ("materials", "held_out")},
    }
    return replace(
        processed,
        copy=replace(added.copy, provenance=provenance),
        figures=processed.figures | {"reflectance": figures},
        comparisons=tuple(added.comparisons),
    )


def process_light_only(
    path: Path,
    *,
    pitch_mm: float = 1.0,
    linear: bool = False,
    options: ReflectanceOptions | None = None,
    begin: Callable[[str], None] = lambda stage: None,
) -> tuple[DigitalCopy, list[Comparison], dict[str, Any]]:
    """Reflectance of a flat object from an ``.lp`` file and its pictures.

    Parameters
    ----------
    path : Path
        The ``.lp`` file; its pictures lie beside it.
    pitch_mm : float
        Size of a pixel on the object.
    linear : bool
        Whether 8-bit pictures hold linear values.
    options : ReflectanceOptions, optional
    begin : callable, optional

    Returns
    -------
    copy : DigitalCopy
        Flat.
    comparisons : list of Comparison
    figures : dict

    Raises
    ------
    ImpastoError
    """
    from fitting.reflectance.light_only import read_light_only

    begin("reading the pictures")
    copy, photographs = read_light_only(path, pitch_mm=pitch_mm, linear=linear)
    added = add_reflectance(copy, photographs, options=options, begin=begin)
    figures = {
        "texels": int(copy.height_field.mask.sum()),
        "shape": list(copy.height_field.shape),
        "pitch_mm": pitch_mm,
        "reflectance": added.figures,
    }
    provenance = copy.provenance | {
        "software": f"impasto {version('impasto')}",
        "pictures": [photograph.name for photograph in photographs],
        "reflectance": {name: added.figures.get(name) for name in ("materials", "held_out")},
    }
    return replace(added.copy, provenance=provenance), added.comparisons, figures


def _registration(views: dict[str | None, RegisteredView]) -> dict[str, Any]:
    return {
        place or "where it stood": {
            "pairs": view.pairs,
            "inliers": view.inliers,
            "residual_px": view.residual_px,
            "texture_px": view.texture_px,
        }
        for place, view in views.items()
    }


def _check_sizes(session: Session, rig: RigGeometry, folder: Path) -> None:
    for name, lens, imager in (
        ("camera", rig.camera, session.plan.camera),
        ("projector", rig.projector, session.plan.projector),
    ):
        if (lens.width, lens.height) != (imager.width, imager.height):
            raise CalibrationError(
                f"{folder}: the {name} was calibrated at {lens.width}×{lens.height}, the session "
                f"was recorded at {imager.width}×{imager.height}"
            )


def _figures(correspondence: CorrespondenceMap, surface: Surface) -> dict[str, Any]:
    copy = surface.copy
    heights = copy.height_field
    low, high = heights.height_range_mm
    sigma = np.sqrt(heights.variance[heights.mask])
    rejection = surface.range_image.rejection
    return {
        "decoded_share": float(correspondence.valid.mean()),
        "rejected_share": {
            reason.name: float(np.mean(rejection & reason != 0))
            for reason in Rejection
            if reason and reason.name
        },
        "sample_noise": correspondence.noise_sigma,
        "epipolar_misalignment_px": surface.range_image.misalignment_px,
        "canvas_pixels": int(surface.canvas.mask.sum()),
        "canvas_axes": str(surface.canvas.axes),
        "canvas_shape": _shape(surface),
        "texels": int(heights.mask.sum()),
        "shape": list(heights.shape),
        "size_mm": list(heights.size_mm),
        "pitch_mm": heights.pitch_mm,
        "height_range_mm": [low, high],
        "height_rms_mm": float(np.std(heights.height[heights.mask])),
        "height_sigma_mm": float(np.median(sigma)),
        "height_unresolved_mm": heights.unresolved_mm,
        "height_correlation": [] if heights.correlation is None else heights.correlation.tolist(),
        "footprint_mm": list(surface.footprint_mm),
        "calibration_uncertainty": _calibration(surface),
        "height_noise": {
            "observed_mm": surface.noise.observed_mm,
            "predicted_mm": surface.noise.predicted_mm,
            "samples": surface.noise.samples,
        },
        "delta0_mm": copy.relief.delta0_mm,
        "delta0_proposed_mm": copy.relief.proposed_delta0_mm,
        "boxes": len(copy.relief.boxes),
        "significant_share": float(copy.relief.significant[heights.mask].mean()),
        "warnings": list(surface.warnings),
    }


def _shape(surface: Surface) -> dict[str, Any] | str:
    shape = surface.shape
    if shape is None:
        return "unknown: too little of the canvas was measured"
    named = zip(("bow_x", "bow_y", "twist"), shape.sigma_mm, strict=True)
    return {
        "bow_x_mm": shape.bow_x_mm,
        "bow_y_mm": shape.bow_y_mm,
        "twist_mm": shape.twist_mm,
    } | {f"{name}_sigma_mm": sigma for name, sigma in named}


def _calibration(surface: Surface) -> dict[str, Any] | str:
    uncertainty = surface.calibration
    if uncertainty is None:
        return "unknown: the rig's calibration carries no covariance"
    named = zip(("bow_x", "bow_y", "twist"), uncertainty.shape_mm, strict=True)
    return {"height_sigma_mm": uncertainty.height_mm} | {
        f"{name}_sigma_mm": sigma for name, sigma in named
    }
