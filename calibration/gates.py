"""Gates: what a calibration must show before anything is measured with it.

mrcal can return nonsense without failing, and a small reprojection error proves little: boards held
parallel leave focal length and distance undetermined, and an image half covered says nothing of the
other half. Each gate measures one such thing, and says what to record where it does not hold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.cross_validation import CalibrationDifference, FittedPose
from calibration.drift import Drift
from calibration.gate_limits import Gate, GateLimits
from calibration.procam import LENS_NAMES, ProcamCalibration
from calibration.recording_gates import coverage_verdict, tilt_verdict, views_verdict
from calibration.surface_gates import motion_verdict, surface_criterion, surface_remedy
from calibration.verdicts import Criterion, GateReport, Untested, Verdict

# Standard error of a known length, relative, beyond which it tells nothing of the squares.
_LARGEST_KNOWN_SIGMA = 0.01


@dataclass(frozen=True)
class KnownDistance:
    """A length that is known independently of the board.

    Attributes
    ----------
    measured_mm, known_mm : float
    sigma_mm : float
        Standard error of their difference.
    """

    measured_mm: float
    known_mm: float
    sigma_mm: float = 0.0


def check_calibration(
    calibration: ProcamCalibration,
    *,
    limits: GateLimits | None = None,
    heldout: Sequence[FittedPose] = (),
    differences: Sequence[CalibrationDifference] = (),
    distances: Sequence[KnownDistance] = (),
    planes: Mapping[str, float] | None = None,
    repeatability: Mapping[str, float] | None = None,
    drift: Drift | None = None,
    unread: Mapping[str, str] | None = None,
) -> GateReport:
    """Put a calibration through the gates.

    Parameters
    ----------
    calibration : ProcamCalibration
    limits : GateLimits, optional
    heldout : sequence of FittedPose
        Poses that took no part at all, besides those held out in turn by the choice of the model.
    differences : sequence of CalibrationDifference
        Of camera and projector, from halves of the views.
    distances : sequence of KnownDistance
        The baseline between camera and projector measured by hand, or a scale bar.
    planes : dict of str to float, optional
        Deviation of each reconstructed plane over its predicted noise, by the pose's name.
    repeatability : dict of str to float, optional
        Difference of each plane's relief from those of the others over that predicted.
    drift : Drift, optional
        Against an earlier calibration.
    unread : dict of str to str, optional
        Why no board was measured in recorded poses, by their names.
    """
    limits = limits or GateLimits()
    verdicts = [tilt_verdict(calibration, limits)]
    verdicts += [coverage_verdict(calibration, number, limits) for number in range(len(LENS_NAMES))]
    verdicts += [
        _residuals(calibration, limits),
        views_verdict(calibration, unread or {}),
        _warp(calibration, limits),
    ]
    if calibration.surface is not None:
        verdicts.append(motion_verdict(calibration.surface, calibration.solution.names, limits))
    optional: list[list[Verdict] | Untested] = [
        _heldout(calibration, heldout, limits),
        _differences(differences, limits),
        _scales(calibration, distances, limits),
        _planes(planes or {}, limits),
        _repeatability(repeatability or {}, limits),
        _drift(drift, limits),
    ]
    for one in optional:
        if not isinstance(one, Untested):
            verdicts += one
    return GateReport(tuple(verdicts), tuple(o for o in optional if isinstance(o, Untested)))


def _residuals(calibration: ProcamCalibration, limits: GateLimits) -> Verdict:
    solution, surface = calibration.solution, calibration.surface
    # By the surface, corners of the projector take no part, and none is left out.
    lenses = slice(None if surface is None else 1)
    out, kept = (int(of[:, lenses].sum()) for of in (solution.outliers, solution.inliers))
    left_out = out / max(1, out + kept)
    rms = solution.rms_per_point_px
    criteria = [
        Criterion("RMS per point, px", float(rms), limits.residual_px),
        Criterion("share of corners left out", left_out, limits.outlier_share),
    ]
    blocks = None if surface is None else surface_criterion(surface, limits)
    if left_out > limits.outlier_share:
        remedy = (
            f"{left_out:.0%} of the corners were left out, the worst of them "
            f"{calibration.rejected_corners[0]}; check focus and light of these views"
        )
    elif surface is not None and blocks is not None and criteria[0].passed and not blocks.passed:
        remedy = surface_remedy(surface, solution.names)
    else:
        per_view = np.sqrt(np.nanmean(np.sum(solution.residuals_px**2, axis=-1), axis=(1, 2, 3)))
        remedy = (
            f"corners are {rms:.2f} px off, most of all in "
            f"{solution.names[int(np.argmax(per_view))]}; record it again, or choose a richer lens "
            "model"
        )
    return Verdict(Gate.RESIDUALS, (*criteria, *(() if blocks is None else (blocks,))), remedy)


def _warp(calibration: ProcamCalibration, limits: GateLimits) -> Verdict:
    bow = float(np.abs(calibration.solution.warp_mm).sum())
    if calibration.surface is not None:
        bow = float(np.abs(calibration.surface.corner_places[..., 2]).max())
    elif calibration.shape is not None:
        bow = max(bow, float(np.linalg.norm(calibration.shape.rms_mm)))
    share = bow / calibration.board.square_mm
    return Verdict(
        Gate.WARP,
        (Criterion("warp over a square", share, limits.warp_over_square, refuses=False),),
        f"the board is warped by {bow:.2f} mm; it was solved for, but take a stiffer board",
    )


def _heldout(
    calibration: ProcamCalibration, poses: Sequence[FittedPose], limits: GateLimits
) -> list[Verdict] | Untested:
    left = {f"pose {n + 1}": pose.weighted_rms for n, pose in enumerate(poses)}
    if calibration.models is not None:
        ratios = calibration.models.score.heldout_over_noise
        left |= {v.name: float(r) for v, r in zip(calibration.views, ratios, strict=True)}
    if not left:
        return Untested(Gate.HELDOUT, "takes four poses")
    worst = max(left, key=lambda name: left[name])
    remedy = (
        f"{worst}, held out, leaves {left[worst]:.1f} times the noise of the views solved from; "
        "record more poses, over the depth and the tilts in which the painting will stand"
    )
    criterion = Criterion("worst residual over noise", left[worst], limits.heldout_ratio)
    return [Verdict(Gate.HELDOUT, (criterion,), remedy)]


def _differences(
    differences: Sequence[CalibrationDifference], limits: GateLimits
) -> list[Verdict] | Untested:
    if not differences:
        return Untested(Gate.DIFFERENCE, "takes six poses")
    return [
        Verdict(
            Gate.DIFFERENCE,
            (Criterion("RMS, px", float(one.rms_px), limits.difference_px),),
            f"two calibrations of the {name} from half of the views each differ by "
            f"{one.rms_px:.2f} px; record more poses",
            name,
        )
        for name, one in zip(LENS_NAMES, differences, strict=False)
    ]


def _planes(planes: Mapping[str, float], limits: GateLimits) -> list[Verdict] | Untested:
    if not planes:
        return Untested(
            Gate.PLANE, "takes a board that can be held out: four poses, seen and decoded whole"
        )
    # A figure that is not known is the worst.
    worst = max(planes, key=lambda name: np.nan_to_num(planes[name], nan=np.inf))
    return [
        Verdict(
            Gate.PLANE,
            (Criterion("worst deviation over noise", planes[worst], limits.plane_over_noise),),
            f"the board of {worst} comes out {planes[worst]:.1f} times rougher than its noise; "
            "check that it is flat and that nothing moved while it was recorded, and record poses "
            "where it bends",
        )
    ]


def _repeatability(
    repeatability: Mapping[str, float], limits: GateLimits
) -> list[Verdict] | Untested:
    if not repeatability:
        return Untested(Gate.REPEATABILITY, "takes two boards that can be held out")
    worst = max(repeatability, key=lambda name: np.nan_to_num(repeatability[name], nan=np.inf))
    found, bound, name = repeatability[worst], limits.repeatability, "difference over predicted"
    return [
        Verdict(
            Gate.REPEATABILITY,
            (
                Criterion(f"worst {name}", found, bound, refuses=False),
                Criterion(f"worst {name}, to be used at all", found, 2 * bound),
            ),
            f"the board of {worst} differs from what the other poses make of it by {found:.1f} "
            "times what noise and calibration explain; record more poses, over the tilts and the "
            "depth in which the painting will stand",
        )
    ]


def _drift(drift: Drift | None, limits: GateLimits) -> list[Verdict] | Untested:
    if drift is None:
        return Untested(Gate.DRIFT, "no earlier calibration was named")
    if not np.isfinite(drift.predicted_mm):
        return Untested(Gate.DRIFT, "the earlier calibration holds no covariance")
    return [
        Verdict(
            Gate.DRIFT,
            (
                Criterion(
                    "change over predicted",
                    float(drift.over_predicted),
                    limits.drift_over_predicted,
                    refuses=False,
                ),
            ),
            f"the rig is not what it was: shapes measured with the earlier calibration change by "
            f"{drift.shape_rms_mm * 1000:.0f} µm, {drift.over_predicted:.1f} times what both leave "
            "uncertain; use this calibration from now on, and look for what became loose or warm",
        )
    ]


def _scales(
    calibration: ProcamCalibration, distances: Sequence[KnownDistance], limits: GateLimits
) -> list[Verdict] | Untested:
    if not distances:
        return Untested(Gate.SCALE, "no length was measured by hand")
    sharp = [d for d in distances if d.sigma_mm <= _LARGEST_KNOWN_SIGMA * d.known_mm]
    if not sharp:
        best = min(distances, key=lambda d: d.sigma_mm / d.known_mm)
        return Untested(
            Gate.SCALE,
            f"{best.known_mm:.6g} ± {best.sigma_mm:.3g} mm tell nothing of the squares: measure to "
            f"{_LARGEST_KNOWN_SIGMA:.0%} or better",
        )
    return [_scale(calibration, distance, limits) for distance in sharp]


def _scale(calibration: ProcamCalibration, distance: KnownDistance, limits: GateLimits) -> Verdict:
    error = abs(distance.measured_mm / distance.known_mm - 1)
    bound = limits.scale_error + 2 * distance.sigma_mm / distance.known_mm
    square = calibration.board.square_mm * distance.known_mm / distance.measured_mm
    return Verdict(
        Gate.SCALE,
        (Criterion("relative error of a known length", error, bound),),
        f"a known length of {distance.known_mm:.2f} mm measures {distance.measured_mm:.2f} mm; "
        f"squares of {square:.3f} mm would explain it, {calibration.board.square_mm:.3f} mm were "
        "given: measure the board",
    )
