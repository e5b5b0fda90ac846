"""Gates of a calibration by name, and what they let through."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Gate(StrEnum):
    """What is tested."""

    TILT = "tilt"
    COVERAGE = "coverage"
    RESIDUALS = "residuals"
    VIEWS = "views"
    WARP = "board warp"
    HELDOUT = "held-out pose"
    DIFFERENCE = "cross-validation difference"
    SCALE = "scale"
    PLANE = "plane"
    REPEATABILITY = "repeatability"
    DRIFT = "drift"
    MOTION = "motion"


@dataclass(frozen=True, kw_only=True)
class GateLimits:
    """What is let through.

    Attributes
    ----------
    tilt_deg : float
        Least spread of the boards' normals: the root mean square of their angles to the mean
        normal, along the direction in which they spread least widely but one.
    covered_share : float
        Least share of the cells of the imager, 4×4, in which corners were seen.
    residual_px : float
        Most root mean square distance per point.
    outlier_share : float
        Most share of corners left out.
    warp_over_square : float
        Most bow or displacement of the board's corners, over a square.
    heldout_ratio : float
        Most residual of a held-out pose over its noise.
    difference_px : float
        Most difference of two calibrations from halves of the views.
    scale_error : float
        Most relative error of a known length, beyond twice its standard error.
    plane_over_noise : float
        Most deviation of a reconstructed plane, over its noise: of the worst of those held out.
    repeatability : float
        Most difference of a held-out board's relief from those of the others, over what noise and
        calibration predict; twice as much refuses.
    drift_over_predicted : float
        Most change of shape since an earlier calibration, over what the uncertainties of both
        explain.
    motion_px : float
        Most motion of the projector's picture on the board between the views, beyond twice its
        standard error; ten times as much refuses.
    """

    tilt_deg: float = 6.0
    covered_share: float = 0.6
    residual_px: float = 0.5
    outlier_share: float = 0.05
    warp_over_square: float = 0.02
    heldout_ratio: float = 3.0
    difference_px: float = 0.5
    scale_error: float = 0.002
    plane_over_noise: float = 2.0
    repeatability: float = 3.0
    drift_over_predicted: float = 2.5
    motion_px: float = 0.1
