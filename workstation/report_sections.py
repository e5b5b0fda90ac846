"""Typed, optional parts of a calibration's report, measured by other means than the board.

A measurement hands in what is to be shown; the report draws it. None of them is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.flat_field import FlatField


@dataclass(frozen=True, kw_only=True)
class LightSection:
    """Positions of the light arm's lamp.

    Attributes
    ----------
    names : tuple of str
        Of the poses.
    position_mm : (n, 3) float64 array
        In the canvas frame or that of the arm.
    residual_deg : (n,) float64 array
        What the kinematic model leaves of each direction.
    sigma_deg : (n,) float64 array
        Standard error of each direction.
    """

    names: tuple[str, ...]
    position_mm: NDArray[np.float64]
    residual_deg: NDArray[np.float64]
    sigma_deg: NDArray[np.float64]

    def __post_init__(self) -> None:
        count = len(self.names)
        shapes = self.position_mm.shape, self.residual_deg.shape, self.sigma_deg.shape
        if shapes != ((count, 3), (count,), (count,)):
            raise CalibrationError(f"{count} light poses with arrays of {shapes}")


@dataclass(frozen=True, kw_only=True)
class ResponseCurve:
    """What comes out for what goes in.

    Attributes
    ----------
    name, input_name, output_name : str
    x, y : (n,) float64 arrays
    sigma_y : (n,) float64 array or None
    """

    name: str
    input_name: str
    output_name: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    sigma_y: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if self.x.shape != self.y.shape or self.x.ndim != 1:
            raise CalibrationError(f"{self.name}: {self.x.shape} inputs, {self.y.shape} outputs")
        if self.sigma_y is not None and self.sigma_y.shape != self.y.shape:
            raise CalibrationError(f"{self.name}: {self.sigma_y.shape} standard errors")


@dataclass(frozen=True, kw_only=True)
class ColourPatch:
    """A patch of a colour chart.

    Attributes
    ----------
    name : str
    reference_srgb, measured_srgb : (3,) float64 arrays
        0 to 1, measured after correction.
    delta_e_before, delta_e_after : float
        ΔE2000.
    """

    name: str
    reference_srgb: NDArray[np.float64]
    measured_srgb: NDArray[np.float64]
    delta_e_before: float
    delta_e_after: float


@dataclass(frozen=True, kw_only=True)
class ReportSections:
    """Optional parts of the report.

    Attributes
    ----------
    lights : LightSection, optional
    responses : tuple of ResponseCurve
        Of camera and projector.
    colours : tuple of ColourPatch
    flat_field : FlatField, optional
        Of the camera.
    """

    lights: LightSection | None = None
    responses: tuple[ResponseCurve, ...] = ()
    colours: tuple[ColourPatch, ...] = ()
    flat_field: FlatField | None = None

    def as_json(self) -> dict[str, object]:
        """What is there, as plain numbers."""
        found: dict[str, object] = {}
        if self.lights is not None:
            found["lights"] = [
                {
                    "name": n,
                    "position_mm": p.tolist(),
                    # Photographs of the white target alone have no highlight.
                    "residual_deg": None if np.isnan(r) else r,
                    "sigma_deg": s,
                }
                for n, p, r, s in zip(
                    self.lights.names,
                    self.lights.position_mm,
                    self.lights.residual_deg.tolist(),
                    self.lights.sigma_deg.tolist(),
                    strict=True,
                )
            ]
        if self.responses:
            found["responses"] = [
                {
                    "name": c.name,
                    "x": c.x.tolist(),
                    "y": c.y.tolist(),
                    "sigma_y": None if c.sigma_y is None else c.sigma_y.tolist(),
                }
                for c in self.responses
            ]
        if self.colours:
            found["colours"] = [
                {
                    "name": c.name,
                    "reference_srgb": c.reference_srgb.tolist(),
                    "measured_srgb": c.measured_srgb.tolist(),
                    "before": c.delta_e_before,
                    "after": c.delta_e_after,
                }
                for c in self.colours
            ]
        if self.flat_field is not None:
            field = self.flat_field
            found["flat_field"] = {
                "centre": field.centre.tolist(),
                "coefficients": field.coefficients.tolist(),
                "sigma": np.sqrt(np.diagonal(field.covariance)).tolist(),
            }
        return found


def srgb_code(colour: NDArray[np.float64]) -> str:
    """A colour of 0 to 1 as HTML writes it."""
    return "#" + "".join(f"{round(255 * c):02x}" for c in np.clip(colour, 0, 1))
