"""Gates: what a calibration must show before anything is measured with it.

mrcal can return nonsense without failing, and a small reprojection error proves little: boards held
parallel leave focal length and distance undetermined, and an image half covered says nothing of the
other half. Each gate measures one such thing, and says what to record where it does not hold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from calibration.cross_validation import CalibrationDifference, FittedPose
from calibration.drift import Drift
from calibration.lens import rotation
from calibration.procam import LENS_NAMES, ProcamCalibration
from calibration.verdicts import Criterion, GateReport, Sense, Untested, Verdict

_CELLS = 4
# Of a side's cells.
_COVERED_SIDE = 0.5
_REFUSED_VIEWS_SHARE = 0.25
# Standard error of a known length, relative, beyond which it tells nothing of the squares.
_LARGEST_KNOWN_SIGMA = 0.01


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
    verdicts = [_tilt(calibration, limits)]
    verdicts += [_coverage(calibration, number, limits) for number in range(len(LENS_NAMES))]
    verdicts += [
        _residuals(calibration, limits),
        _views(calibration, unread or {}),
        _warp(calibration, limits),
    ]
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


def normal_spread_deg(calibration: ProcamCalibration) -> NDArray[np.float64]:
    """Spread of the boards' normals along their widest and narrowest direction, degrees."""
    normals = np.array([rotation(rt)[:, 2] for rt in calibration.solution.rt_ref_board])
    normals *= np.sign(normals @ normals.sum(axis=0))[:, np.newaxis]
    values = np.linalg.svd(normals - normals.mean(axis=0), compute_uv=False)
    return np.degrees(values[:2] / np.sqrt(len(normals)))


def covered_cells(calibration: ProcamCalibration, number: int) -> NDArray[np.bool_]:
    """(4, 4) bool array: cells of a lens's imager in which corners took part."""
    lens = calibration.solution.lenses[number]
    kept = calibration.solution.inliers[:, number]
    pixels = np.stack([view.pixels[number] for view in calibration.views])[kept]
    cell = np.floor((pixels + 0.5) / [lens.width, lens.height] * _CELLS).astype(int)
    cell = cell[((cell >= 0) & (cell < _CELLS)).all(axis=1)]
    covered = np.zeros((_CELLS, _CELLS), bool)
    covered[cell[:, 1], cell[:, 0]] = True
    return covered


def _tilt(calibration: ProcamCalibration, limits: GateLimits) -> Verdict:
    widest, narrowest = map(float, normal_spread_deg(calibration))
    return Verdict(
        Gate.TILT,
        (
            Criterion("widest spread of the normals, °", widest, limits.tilt_deg, Sense.AT_LEAST),
            Criterion("narrowest spread, °", narrowest, limits.tilt_deg / 3, Sense.AT_LEAST),
        ),
        f"the boards are nearly parallel, their normals spread over {widest:.1f}° and "
        f"{narrowest:.1f}° only, so focal length and distance cannot be told apart; record poses "
        f"{_missing_tilts(calibration)}, by 20° to 40°",
    )


def _missing_tilts(calibration: ProcamCalibration) -> str:
    normals = np.array([rotation(rt)[:, 2] for rt in calibration.solution.rt_ref_board])
    normals *= -np.sign(normals[:, 2:])
    limit = np.sin(np.radians(8))
    sides = (
        ("to the left", normals[:, 0] < -limit),
        ("to the right", normals[:, 0] > limit),
        ("upwards", normals[:, 1] < -limit),
        ("downwards", normals[:, 1] > limit),
    )
    missing = [name for name, there in sides if not there.any()]
    return "tilted " + (" and ".join(missing) if missing else "more, in all four directions")


def _coverage(calibration: ProcamCalibration, number: int, limits: GateLimits) -> Verdict:
    covered = covered_cells(calibration, number)
    share = float(covered.mean())
    half = _CELLS // 2
    sides = (
        ("left", covered[:, :half]),
        ("right", covered[:, half:]),
        ("top", covered[:half]),
        ("bottom", covered[half:]),
    )
    shares = {name: float(cells.mean()) for name, cells in sides}
    bare = [name for name, found in shares.items() if found < _COVERED_SIDE]
    part = f"the {' and the '.join(bare)}" if bare else "the corners of the image"
    criteria = [Criterion("share of the image", share, limits.covered_share, Sense.AT_LEAST)]
    criteria += [
        Criterion(f"share of its {name} half", found, _COVERED_SIDE, Sense.AT_LEAST)
        for name, found in shares.items()
    ]
    return Verdict(
        Gate.COVERAGE,
        tuple(criteria),
        f"corners were seen in {share:.0%} of the {LENS_NAMES[number]}'s image; record poses that "
        f"fill {part} of it",
        LENS_NAMES[number],
    )


def _residuals(calibration: ProcamCalibration, limits: GateLimits) -> Verdict:
    solution = calibration.solution
    left_out = float(solution.outliers.sum() / max(1, solution.inliers.sum()))
    rms = solution.rms_per_point_px
    if left_out > limits.outlier_share:
        remedy = (
            f"{left_out:.0%} of the corners were left out, the worst of them "
            f"{calibration.rejected_corners[0]}; check focus and light of these views"
        )
    else:
        per_view = np.sqrt(np.nanmean(np.sum(solution.residuals_px**2, axis=-1), axis=(1, 2, 3)))
        remedy = (
            f"corners are {rms:.2f} px off, most of all in "
            f"{solution.names[int(np.argmax(per_view))]}; record it again, or choose a richer lens "
            "model"
        )
    criteria = (
        Criterion("RMS per point, px", float(rms), limits.residual_px),
        Criterion("share of corners left out", left_out, limits.outlier_share),
    )
    return Verdict(Gate.RESIDUALS, criteria, remedy)


def _views(calibration: ProcamCalibration, unread: Mapping[str, str]) -> Verdict:
    rejected = calibration.rejected_views
    solved = len(rejected) + len(calibration.views)
    left = {view.name: view.why for view in rejected} | dict(unread)
    remedy = "; ".join(f"{name} was left out: {why}" for name, why in left.items())
    criteria = (
        Criterion("poses left out", float(len(left)), 0.0, refuses=False),
        Criterion(
            "share left out that contradicts the others",
            len(rejected) / max(solved, 1),
            _REFUSED_VIEWS_SHARE,
        ),
    )
    return Verdict(Gate.VIEWS, criteria, remedy)


def _warp(calibration: ProcamCalibration, limits: GateLimits) -> Verdict:
    bow = float(np.abs(calibration.solution.warp_mm).sum())
    if calibration.shape is not None:
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
