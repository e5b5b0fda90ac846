"""From a correspondence map to the copy of a surface: paper sections 4.1 to 4.3 in order."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from acquisition.correspondence import CorrespondenceMap
from calibration.rig_geometry import RigGeometry
from fitting.calibration_uncertainty import CalibrationUncertainty, propagate_calibration
from fitting.canvas import Canvas, CanvasOptions, extract_canvas
from fitting.canvas_shape import CanvasShape, measure_shape
from fitting.digital_copy import DigitalCopy
from fitting.neighbour_kernels import triangle_normals
from fitting.range_image import RangeImage, RangeOptions, triangulate
from fitting.relief_classification import ReliefOptions, classify_relief
from fitting.resampling import footprint_radius_mm, point_spacing_mm, resample_heights
from fitting.surface_noise import SurfaceNoise, measure_surface_noise, slope_error_ratio

# Errors of good calibrations across the baseline are a few tenths of a pixel.
_LARGEST_MISALIGNMENT_PX = 2.0


@dataclass(frozen=True, kw_only=True)
class SurfaceOptions:
    """Options of every step of the surface.

    Attributes
    ----------
    range_image : RangeOptions
    canvas : CanvasOptions
    relief : ReliefOptions
    pitch_mm : float or None
        Texel pitch; None takes the spacing of the points.
    pitch_factor : float
        Texel pitch over the spacing of the points, where ``pitch_mm`` is None: coarser texels cost
        less time.
    footprint_mm : float or None
        Radius of the resampling's footprint, where smoothing is wanted; None takes the least.
    """

    range_image: RangeOptions = field(default_factory=RangeOptions)
    canvas: CanvasOptions = field(default_factory=CanvasOptions)
    relief: ReliefOptions = field(default_factory=ReliefOptions)
    pitch_mm: float | None = None
    pitch_factor: float = 1.0
    footprint_mm: float | None = None


@dataclass(frozen=True)
class Surface:
    """What came of the scan: the copy, and the steps that led to it.

    Attributes
    ----------
    copy : DigitalCopy
    range_image : RangeImage
    canvas : Canvas
    noise : SurfaceNoise
    footprint_mm : (float, float)
        Radius along X and Y under which the heights were fitted.
    shape : CanvasShape or None
        Bow and twist of the canvas; None where too little of it was measured.
    calibration : CalibrationUncertainty or None
        What the rig's uncertainty does to the heights; None where it is unknown.
    """

    copy: DigitalCopy
    range_image: RangeImage
    canvas: Canvas
    noise: SurfaceNoise
    footprint_mm: tuple[float, float]
    shape: CanvasShape | None
    calibration: CalibrationUncertainty | None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was ambiguous or doubtful on the way."""
        off = self.range_image.misalignment_px
        if off <= _LARGEST_MISALIGNMENT_PX:
            return self.canvas.warnings
        doubt = (
            f"decoded columns and rows disagree by {off:.1f} px (RMS) of what the calibration "
            "says: it belongs to another rig, or the rig was moved; heights may be off in scale"
        )
        return (*self.canvas.warnings, doubt)


def reconstruct_surface(
    correspondence: CorrespondenceMap, rig: RigGeometry, options: SurfaceOptions | None = None
) -> Surface:
    """Triangulate, find the canvas, resample its heights, and classify the relief.

    Parameters
    ----------
    correspondence : CorrespondenceMap
        Decoded scan.
    rig : RigGeometry
        Calibration in force.
    options : SurfaceOptions, optional

    Returns
    -------
    Surface
        The copy carries no reflectance yet.

    Raises
    ------
    FittingError
        From any step; see there.
    """
    options = options or SurfaceOptions()
    range_image = triangulate(correspondence, rig, options.range_image)
    canvas = extract_canvas(range_image, options.canvas)
    noise = measure_surface_noise(range_image, canvas)
    spacing = point_spacing_mm(range_image, canvas)
    pitch_mm = options.pitch_mm
    if pitch_mm is None and options.pitch_factor != 1.0:
        pitch_mm = options.pitch_factor * math.sqrt(spacing[0] * spacing[1])
    heights = resample_heights(
        range_image, canvas, pitch_mm=pitch_mm, footprint_mm=options.footprint_mm
    )
    normal_xy, slope_sigma = triangle_normals(
        heights.height, heights.mask, heights.variance, heights.pitch_mm
    )
    if heights.correlation is not None:
        slope_sigma = slope_sigma * np.float32(slope_error_ratio(heights.correlation))
    # A texel that belongs to no whole triangle has no normal: it is a gap too.
    lonely = heights.mask & ~np.isfinite(slope_sigma)
    if lonely.any():
        heights = heights.without(lonely)
        slope_sigma = np.where(lonely, np.float32(0), slope_sigma)
    relief = classify_relief(heights, options.relief)
    return Surface(
        DigitalCopy(heights, normal_xy, relief, slope_sigma),
        range_image,
        canvas,
        noise,
        footprint_radius_mm(spacing, heights.pitch_mm, options.footprint_mm),
        measure_shape(heights),
        propagate_calibration(correspondence, rig, canvas),
    )
