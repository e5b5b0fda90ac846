"""From a session on disk to a digital copy on disk, with the figures of every step."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.correspondence import CorrespondenceMap, Rejection
from acquisition.decoding import DecodingOptions, decode
from acquisition.plan import Purpose
from acquisition.session import Session
from calibration.errors import CalibrationError
from calibration.rig_geometry import RigGeometry
from fitting.digital_copy import DigitalCopy
from fitting.surface import Surface, SurfaceOptions, reconstruct_surface
from workstation.interruption import interruption_held

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
    """

    copy: DigitalCopy
    correspondence: CorrespondenceMap
    surface: Surface
    figures: dict[str, Any]


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
        "parameters": asdict(options),
        "errors": {name: figures[name] for name in _ERROR_SUMMARY},
        "warnings": figures["warnings"],
    }
    copy = DigitalCopy(
        surface.copy.height_field,
        surface.copy.normal_xy,
        surface.copy.relief,
        surface.copy.slope_sigma,
        surface.copy.reflectance,
        provenance,
    )
    return Processed(copy, correspondence, surface, figures)


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
