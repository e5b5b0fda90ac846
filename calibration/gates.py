"""Gates: what a calibration must show before anything is measured with it.

mrcal can return nonsense without failing, and a small reprojection error proves little: boards held
parallel leave focal length and distance undetermined, and an image half covered says nothing of the
other half. Each gate measures one such thing, and says what to record where it does not hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from calibration.cross_validation import CalibrationDifference, FittedPose
from calibration.drift import Drift
from calibration.errors import CalibrationRefusedError
from calibration.lens import rotation
from calibration.procam import LENS_NAMES, ProcamCalibration

_CELLS = 4


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
        Most deviation of a reconstructed plane, over its noise.
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
    drift_over_predicted: float = 2.5


@dataclass(frozen=True)
class Verdict:
    """Outcome of one gate.

    Attributes
    ----------
    gate : Gate
    value, bound : float
    passed : bool
    refuses : bool
        Whether failing refuses the calibration; otherwise it is flagged.
    remedy : str
        What is wrong and what to do; empty if the gate is passed.
    subject : str
        The lens, where each has a gate of its own.
    """

    gate: Gate
    value: float
    bound: float
    passed: bool
    refuses: bool
    remedy: str
    subject: str = ""


@dataclass(frozen=True)
class GateReport:
    """Outcomes of all gates that could be tested."""

    verdicts: tuple[Verdict, ...]

    @property
    def passed(self) -> bool:
        """Whether no gate refuses the calibration."""
        return all(v.passed or not v.refuses for v in self.verdicts)

    @property
    def failures(self) -> tuple[Verdict, ...]:
        """Gates that failed, whether they refuse or flag."""
        return tuple(v for v in self.verdicts if not v.passed)

    def refuse(self) -> None:
        """Refuse a calibration that failed.

        Raises
        ------
        CalibrationRefusedError
            With every failure and what to do about it.
        """
        if not self.passed:
            reasons = "; ".join(f"{v.gate}: {v.remedy}" for v in self.failures if v.refuses)
            raise CalibrationRefusedError(f"the calibration is refused. {reasons}")


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
    plane_over_noise: float | None = None,
    drift: Drift | None = None,
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
    plane_over_noise : float, optional
        Deviation of a reconstructed plane over its predicted noise.
    drift : Drift, optional
        Against an earlier calibration.
    """
    limits = limits or GateLimits()
    verdicts = [_tilt(calibration, limits)]
    verdicts += [_coverage(calibration, number, limits) for number in range(len(LENS_NAMES))]
    verdicts += [
        _residuals(calibration, limits),
        _views(calibration),
        _warp(calibration, limits),
    ]
    verdicts += _heldout(calibration, heldout, limits)
    for name, difference in zip(LENS_NAMES, differences, strict=False):
        verdicts.append(
            _verdict(
                Gate.DIFFERENCE,
                difference.rms_px,
                limits.difference_px,
                f"two calibrations of the {name} from half of the views each differ by "
                f"{difference.rms_px:.2f} px; record more poses",
                subject=name,
            )
        )
    verdicts += [_scale(calibration, distance, limits) for distance in distances]
    if plane_over_noise is not None:
        verdicts.append(
            _verdict(
                Gate.PLANE,
                plane_over_noise,
                limits.plane_over_noise,
                f"a plane comes out {plane_over_noise:.1f} times rougher than its noise; check "
                "that the reference is flat, and record poses where it bends",
            )
        )
    if drift is not None and np.isfinite(drift.predicted_mm):
        verdicts.append(_drift(drift, limits))
    return GateReport(tuple(verdicts))


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


def _verdict(
    gate: Gate,
    value: float,
    bound: float,
    remedy: str,
    *,
    refuses: bool = True,
    subject: str = "",
) -> Verdict:
    passed = bool(value <= bound)
    return Verdict(gate, float(value), bound, passed, refuses, "" if passed else remedy, subject)


def _tilt(calibration: ProcamCalibration, limits: GateLimits) -> Verdict:
    widest, narrowest = normal_spread_deg(calibration)
    passed = bool(widest >= limits.tilt_deg and narrowest >= limits.tilt_deg / 3)
    remedy = (
        f"the boards are nearly parallel, their normals spread over {widest:.1f}° and "
        f"{narrowest:.1f}° only, so focal length and distance cannot be told apart; record poses "
        f"{_missing_tilts(calibration)}, by 20° to 40°"
    )
    return Verdict(
        Gate.TILT, float(widest), limits.tilt_deg, passed, True, "" if passed else remedy
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
    bare = [name for name, cells in sides if cells.mean() < 0.5]
    passed = share >= limits.covered_share and not bare
    part = f"the {' and the '.join(bare)}" if bare else "the corners of the image"
    remedy = (
        f"corners were seen in {share:.0%} of the {LENS_NAMES[number]}'s image; record poses that "
        f"fill {part} of it"
    )
    bound = limits.covered_share
    name = LENS_NAMES[number]
    return Verdict(Gate.COVERAGE, share, bound, passed, True, "" if passed else remedy, name)


def _residuals(calibration: ProcamCalibration, limits: GateLimits) -> Verdict:
    solution = calibration.solution
    left_out = float(solution.outliers.sum() / max(1, solution.inliers.sum()))
    rms = solution.rms_per_point_px
    if left_out > limits.outlier_share:
        remedy = (
            f"{left_out:.0%} of the corners were left out, the worst of them "
            f"{calibration.rejected_corners[0]}; check focus and light of these views"
        )
        return Verdict(Gate.RESIDUALS, left_out, limits.outlier_share, False, True, remedy)
    per_view = np.sqrt(np.nanmean(np.sum(solution.residuals_px**2, axis=-1), axis=(1, 2, 3)))
    worst = solution.names[int(np.argmax(per_view))]
    return _verdict(
        Gate.RESIDUALS,
        rms,
        limits.residual_px,
        f"corners are {rms:.2f} px off, most of all in {worst}; record it again, or choose a "
        "richer lens model",
    )


def _views(calibration: ProcamCalibration) -> Verdict:
    rejected = calibration.rejected_views
    total = len(rejected) + len(calibration.views)
    remedy = "; ".join(f"{view.name} was left out: {view.why}" for view in rejected)
    few = len(rejected) > 0.25 * total
    return Verdict(Gate.VIEWS, len(rejected), 0.0, not rejected, few, remedy)


def _warp(calibration: ProcamCalibration, limits: GateLimits) -> Verdict:
    bow = float(np.abs(calibration.solution.warp_mm).sum())
    if calibration.shape is not None:
        bow = max(bow, float(np.linalg.norm(calibration.shape.rms_mm)))
    return _verdict(
        Gate.WARP,
        bow / calibration.board.square_mm,
        limits.warp_over_square,
        f"the board is warped by {bow:.2f} mm; it was solved for, but take a stiffer board",
        refuses=False,
    )


def _heldout(
    calibration: ProcamCalibration, poses: Sequence[FittedPose], limits: GateLimits
) -> list[Verdict]:
    left = {f"pose {n + 1}": pose.weighted_rms for n, pose in enumerate(poses)}
    if calibration.models is not None:
        ratios = calibration.models.score.heldout_over_noise
        left |= {v.name: float(r) for v, r in zip(calibration.views, ratios, strict=True)}
    if not left:
        return []
    worst = max(left, key=lambda name: left[name])
    remedy = (
        f"{worst}, held out, leaves {left[worst]:.1f} times the noise of the views solved from; "
        "record more poses, over the depth and the tilts in which the painting will stand"
    )
    return [_verdict(Gate.HELDOUT, left[worst], limits.heldout_ratio, remedy)]


def _drift(drift: Drift, limits: GateLimits) -> Verdict:
    return _verdict(
        Gate.DRIFT,
        drift.over_predicted,
        limits.drift_over_predicted,
        f"the rig is not what it was: shapes measured with the earlier calibration change by "
        f"{drift.shape_rms_mm * 1000:.0f} µm, {drift.over_predicted:.1f} times what both leave "
        "uncertain; use this calibration from now on, and look for what became loose or warm",
        refuses=False,
    )


def _scale(calibration: ProcamCalibration, distance: KnownDistance, limits: GateLimits) -> Verdict:
    error = abs(distance.measured_mm / distance.known_mm - 1)
    bound = limits.scale_error + 2 * distance.sigma_mm / distance.known_mm
    square = calibration.board.square_mm * distance.known_mm / distance.measured_mm
    return _verdict(
        Gate.SCALE,
        error,
        bound,
        f"a known length of {distance.known_mm:.2f} mm measures {distance.measured_mm:.2f} mm; "
        f"squares of {square:.3f} mm would explain it, {calibration.board.square_mm:.3f} mm were "
        "given: measure the board",
    )
