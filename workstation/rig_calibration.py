"""From sessions of board poses to a calibrated rig, with everything that says how good it is.

Some poses are held out once more, one by one, to reconstruct their boards densely: surfaces that
the calibration has not seen, and the same in all of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.session import Session
from calibration.board_relief import (
    BoardRelief,
    Repeatability,
    compare_reliefs,
    reconstruct_board,
)
from calibration.cross_validation import CalibrationDifference, split_difference
from calibration.drift import Drift, compare_with_earlier, working_volume
from calibration.errors import CalibrationError
from calibration.gates import KnownDistance, check_calibration
from calibration.lens import rotation
from calibration.mrcal_solve import solve_without
from calibration.procam import (
    LENS_NAMES,
    ProcamCalibration,
    ProcamOptions,
    calibrate_procam,
)
from calibration.rig_geometry import RigGeometry
from calibration.surface_calibration import (
    calibrate_by_surface,
    solved_from_some,
    split_surface_difference,
)
from calibration.uncertainty import UncertaintyMap
from calibration.verdicts import GateReport
from workstation.board_poses import LEAST_POSES, BoardPoses, UnreadPose, measure_pose

_POSES_TO_SPLIT = 6
# Poses held out, each by itself; a board takes part that is seen whole.
_HELD_OUT = 3
_TRIES = 6


@dataclass(frozen=True)
class HeldoutPlane:
    """The board of a pose that took no part, reconstructed densely.

    Attributes
    ----------
    pose : str
    relief : BoardRelief
    """

    pose: str
    relief: BoardRelief


@dataclass(frozen=True)
class HeightUncertainty:
    """What the calibration leaves of heights at the working distance.

    Attributes
    ----------
    points : (n, 3) float64 array
        In the camera frame, on a plane across its axis.
    sigma_mm : (n,) float64 array
        Standard errors of height, once a plane is removed: it only moves and tilts a painting.
    scale_sigma : float
        Relative standard error of lengths, that of the board's squares included.
    """

    points: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]
    scale_sigma: float

    @property
    def rms_mm(self) -> float:
        """Root mean square over the plane."""
        return float(np.sqrt(np.mean(self.sigma_mm**2)))


@dataclass(frozen=True)
class EarlierRig:
    """An earlier calibration, and what has changed since."""

    name: str
    drift: Drift


@dataclass(frozen=True)
class CalibratedRig:
    """A calibrated rig with its evidence.

    Attributes
    ----------
    calibration : ProcamCalibration
    poses : BoardPoses
    gates : GateReport
    uncertainty : tuple of UncertaintyMap
        Of camera and projector, at the working distance.
    heights : HeightUncertainty or None
        None where camera and projector share too little of the field.
    differences : tuple of CalibrationDifference
        Of calibrations from every other view, camera and projector; empty with few views.
    planes : tuple of HeldoutPlane
        Of the poses that face the camera most, each held out by itself.
    unreconstructed : tuple of UnreadPose
        Poses that were held out and whose boards could not be reconstructed.
    earlier : tuple of EarlierRig
    seconds : dict of str to float
    """

    calibration: ProcamCalibration
    poses: BoardPoses
    gates: GateReport
    uncertainty: tuple[UncertaintyMap, ...]
    heights: HeightUncertainty | None
    differences: tuple[CalibrationDifference, ...]
    planes: tuple[HeldoutPlane, ...]
    unreconstructed: tuple[UnreadPose, ...]
    earlier: tuple[EarlierRig, ...]
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def repeatability(self) -> Repeatability | None:
        """How the boards that were held out agree; None with one of them."""
        return _repeatability(self.planes)

    @property
    def predicted_repeatability_mm(self) -> NDArray[np.float64]:
        """What noise and calibration predict (planes,) for it."""
        return _predicted_repeatability(self.planes, self.heights)


def calibrate_rig(
    poses: BoardPoses,
    *,
    options: ProcamOptions | None = None,
    distances: Callable[[RigGeometry], Sequence[KnownDistance]] = lambda rig: (),
    earlier: Sequence[Path] = (),
    held_out: int = _HELD_OUT,
    begin: Callable[[str], None] = lambda stage: None,
) -> CalibratedRig:
    """Calibrate a rig from measured poses, and gather the evidence.

    Parameters
    ----------
    poses : BoardPoses
    options : ProcamOptions, optional
        With ``board_shape``, and poses whose surfaces were sampled, all of the board's surface is
        solved from.
    distances : callable, optional
        Lengths known apart from the board, and what the rig measures of them.
    earlier : sequence of Path
        Folders of earlier calibrations, the latest first.
    held_out : int
        Poses that are held out, one by one, and reconstructed densely.
    begin : callable, optional
        Called with the name of each stage as it starts.

    Raises
    ------
    CalibrationError
        From any stage. A calibration that fails its gates is returned all the same.
    """
    seconds: dict[str, float] = {}

    def timed(name: str) -> Callable[[], None]:
        begin(name)
        started = time.perf_counter()
        return lambda: seconds.__setitem__(name, round(time.perf_counter() - started, 3))

    options = options or ProcamOptions()
    done = timed("solving")
    calibration = calibrate_procam(
        list(poses.views),
        poses.board,
        camera=poses.camera,
        projector=poses.projector,
        options=options,
    )
    done()
    if options.board_shape and poses.surfaces:
        done = timed("solving from the board's surface")
        calibration = calibrate_by_surface(calibration, poses.surfaces)
        done()
    done = timed("cross-validating")
    differences = _differences(calibration, poses)
    planes, unreconstructed = _heldout_planes(calibration, poses, held_out)
    done()
    done = timed("propagating the uncertainty")
    maps = tuple(calibration.uncertainty_map(number) for number in range(len(LENS_NAMES)))
    heights = _height_uncertainty(calibration)
    drifts = _drifts(calibration, earlier)
    done()
    gates = check_calibration(
        calibration,
        differences=differences,
        distances=distances(calibration.rig),
        planes={one.pose: one.relief.plane_over_noise for one in planes},
        repeatability=_repeatability_ratios(planes, heights),
        drift=drifts[0].drift if drifts else None,
        unread={pose.name: pose.why for pose in poses.unread},
    )
    return CalibratedRig(
        calibration,
        poses,
        gates,
        maps,
        heights,
        differences,
        planes,
        unreconstructed,
        drifts,
        seconds,
    )


def _differences(
    calibration: ProcamCalibration, poses: BoardPoses
) -> tuple[CalibrationDifference, ...]:
    if len(calibration.views) < _POSES_TO_SPLIT:
        return ()
    if calibration.surface is not None:
        return split_surface_difference(
            calibration.surface, distance_mm=calibration.working_distance_mm
        )
    return split_difference(
        list(calibration.views),
        calibration.board,
        [poses.camera, poses.projector],
        model=calibration.rig.camera.model,
        distance_mm=calibration.working_distance_mm,
    )


def _heldout_planes(
    calibration: ProcamCalibration, poses: BoardPoses, count: int
) -> tuple[tuple[HeldoutPlane, ...], tuple[UnreadPose, ...]]:
    """Boards of the poses that face the camera most, each by a calibration without it."""
    views = list(calibration.views)
    if len(views) <= LEAST_POSES or not poses.sessions:
        return (), ()
    facing = np.argsort([-abs(rotation(rt)[2, 2]) for rt in calibration.solution.rt_ref_board])
    found: list[HeldoutPlane] = []
    failed: list[UnreadPose] = []
    for number in facing[:_TRIES]:
        if len(found) == count:
            break
        view = views[number]
        try:
            rig = _rig_without(calibration, int(number))
            measured = measure_pose(
                view.name,
                Session.open(poses.sessions[view.name]),
                poses.board,
                compensate_phases=poses.compensate_phases,
            )
            relief = reconstruct_board(
                measured.correspondence,
                view.pixels[0],
                calibration.board,
                rig,
                start_mm=calibration.working_distance_mm,
            )
        except CalibrationError as error:
            failed.append(UnreadPose(view.name, str(error).removeprefix(f"{view.name}: ")))
            continue
        found.append(HeldoutPlane(view.name, relief))
    return tuple(found), tuple(failed)


def _rig_without(calibration: ProcamCalibration, number: int) -> RigGeometry:
    """The rig by all views but one."""
    views = list(calibration.views)
    if calibration.surface is not None:
        kept = [n for n in range(len(views)) if n != number]
        return solved_from_some(calibration.surface, kept).rig
    solution = solve_without(
        calibration.solution, {views[number].name}, views, outlier_sigmas=np.inf
    )
    return RigGeometry(solution.lenses[0], solution.lenses[1], solution.rt_lens_ref[1])


def _repeatability(planes: tuple[HeldoutPlane, ...]) -> Repeatability | None:
    if len(planes) < 2:
        return None
    return compare_reliefs([plane.relief for plane in planes])


def _predicted_repeatability(
    planes: tuple[HeldoutPlane, ...], heights: HeightUncertainty | None
) -> NDArray[np.float64]:
    """Of each relief against the mean of the others; errors of calibrations count in each anew."""
    noise = np.array([plane.relief.smoothed_noise_mm for plane in planes])
    variance = noise**2 + (0.0 if heights is None else heights.rms_mm**2)
    others = max(len(planes) - 1, 1)
    return np.asarray(np.sqrt(variance + (variance.sum() - variance) / others**2))


def _repeatability_ratios(
    planes: tuple[HeldoutPlane, ...], heights: HeightUncertainty | None
) -> dict[str, float]:
    found = _repeatability(planes)
    if found is None:
        return {}
    ratios = found.rms_mm / _predicted_repeatability(planes, heights)
    return {plane.pose: float(ratio) for plane, ratio in zip(planes, ratios, strict=True)}


def _height_uncertainty(calibration: ProcamCalibration) -> HeightUncertainty | None:
    distance = calibration.working_distance_mm
    points = working_volume(calibration.rig, distance_mm=distance)
    points = points[np.abs(points[:, 2] - distance) < 1e-6 * distance]
    if len(points) < 6:
        return None
    joint = calibration.covariance()
    up = np.array([0.0, 0.0, -1.0])
    covariance = joint.height_covariance(points, normal=up)
    return HeightUncertainty(
        points, np.sqrt(np.maximum(np.diag(covariance), 0.0)), _scale_sigma(calibration, points)
    )


def _scale_sigma(calibration: ProcamCalibration, points: NDArray[np.float64]) -> float:
    """Relative standard error of lengths across the field: of points' spread about their mean."""
    joint = calibration.covariance()
    offset = points - points.mean(axis=0)
    lever = np.einsum("ki,kin->n", offset, joint.point_jacobian(points)) / np.sum(offset**2)
    return float(np.sqrt(lever @ joint.covariance @ lever + joint.scale_sigma**2))


def _drifts(calibration: ProcamCalibration, earlier: Sequence[Path]) -> tuple[EarlierRig, ...]:
    if not earlier:
        return ()
    rig = calibration.rig_with_covariance()
    distance = calibration.working_distance_mm
    return tuple(
        EarlierRig(
            str(folder), compare_with_earlier(rig, RigGeometry.load(folder), distance_mm=distance)
        )
        for folder in earlier
    )
