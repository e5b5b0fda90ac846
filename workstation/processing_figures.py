"""Figures of a processed session, as plain JSON values: what reports and ``--json`` show."""

from __future__ import annotations

from typing import Any

import numpy as np

from acquisition.correspondence import CorrespondenceMap, Rejection
from calibration.registration import RegisteredView
from fitting.height_field import HeightField
from fitting.relief import Relief
from fitting.surface import Surface

_ERROR_SUMMARY = (
    "decoded_sigma_px",
    "height_noise",
    "height_sigma_mm",
    "height_unresolved_mm",
    "canvas_shape",
    "calibration_uncertainty",
)


def scan_figures(correspondence: CorrespondenceMap, surface: Surface) -> dict[str, Any]:
    """What decoding and the surface came to; relief is another stage's."""
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
        "decoded_sigma_px": _decoded_sigma(correspondence),
        "warnings": list(surface.warnings),
    }


def relief_figures(heights: HeightField, relief: Relief) -> dict[str, Any]:
    """δ0 and what stands above it."""
    return {
        "delta0_mm": relief.delta0_mm,
        "delta0_proposed_mm": relief.proposed_delta0_mm,
        "boxes": len(relief.boxes),
        "significant_share": float(relief.significant[heights.mask].mean()),
    }


def errors_by_stage(figures: dict[str, Any]) -> dict[str, Any]:
    """The error of each stage, for a copy's provenance."""
    errors = {name: figures[name] for name in _ERROR_SUMMARY}
    reflectance = figures.get("reflectance")
    if reflectance is None:
        return errors
    places = reflectance["registration"].values()
    held_out = reflectance.get("held_out") or {}
    return errors | {
        "registration_texture_px": max(place["texture_px"] for place in places),
        "reflectance_residual": reflectance["residual_median"],
        "heldout_psnr_db": held_out.get("psnr_db"),
        "heldout_delta_e": held_out.get("delta_e"),
        "heldout_noise_psnr_db": held_out.get("noise_psnr_db"),
        "heldout_noise_delta_e": held_out.get("noise_delta_e"),
    }


def reflectance_provenance(figures: dict[str, Any]) -> dict[str, Any]:
    """What a copy keeps of the figures of its reflectance."""
    return {name: figures.get(name) for name in ("photographs", "materials", "held_out")}


def _decoded_sigma(correspondence: CorrespondenceMap) -> dict[str, float]:
    valid = correspondence.valid
    return {
        str(axis): float(np.sqrt(np.median(found.variance[valid])))
        for axis, found in correspondence.axes.items()
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


def registration_figures(views: dict[str | None, RegisteredView]) -> dict[str, Any]:
    """How well the photographs of each place of the camera lie on the scan."""
    return {
        place or "where it stood": {
            "pairs": view.pairs,
            "inliers": view.inliers,
            "residual_px": view.residual_px,
            "texture_px": view.texture_px,
        }
        for place, view in views.items()
    }
