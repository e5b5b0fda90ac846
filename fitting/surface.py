"""From a correspondence map to the copy of a surface: paper sections 4.1 to 4.3 in order."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from acquisition.correspondence import CorrespondenceMap
from calibration.rig_geometry import RigGeometry
from fitting.canvas import Canvas, CanvasOptions, extract_canvas
from fitting.digital_copy import DigitalCopy
from fitting.neighbour_kernels import triangle_normals
from fitting.range_image import RangeImage, RangeOptions, triangulate
from fitting.relief_classification import ReliefOptions, classify_relief
from fitting.resampling import resample_heights
from fitting.surface_noise import SurfaceNoise, measure_surface_noise, slope_error_ratio


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
    """

    range_image: RangeOptions = field(default_factory=RangeOptions)
    canvas: CanvasOptions = field(default_factory=CanvasOptions)
    relief: ReliefOptions = field(default_factory=ReliefOptions)
    pitch_mm: float | None = None


@dataclass(frozen=True)
class Surface:
    """What came of the scan: the copy, and the steps that led to it."""

    copy: DigitalCopy
    range_image: RangeImage
    canvas: Canvas
    noise: SurfaceNoise


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
    heights = resample_heights(range_image, canvas, pitch_mm=options.pitch_mm)
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
    return Surface(DigitalCopy(heights, normal_xy, relief, slope_sigma), range_image, canvas, noise)
