"""From sessions of board poses to a calibrated rig, with everything that says how good it is.

Each session holds one pose of the board, recorded by ``impasto scan`` or imported from another
program's capture. One pose is held out once more to reconstruct its board densely: a plane that the
calibration has not seen.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from acquisition.decoding import decode
from acquisition.errors import DecodingError, SessionError
from acquisition.plan import Imager, Purpose
from acquisition.session import PLAN_FILE, Session
from calibration.board_relief import BoardRelief, reconstruct_board
from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.cross_validation import CalibrationDifference, split_difference
from calibration.drift import Drift, compare_with_earlier, working_volume
from calibration.errors import CalibrationError
from calibration.gates import GateReport, KnownDistance, check_calibration
from calibration.lens import rotation
from calibration.mrcal_solve import solve_without
from calibration.procam import (
    LENS_NAMES,
    MeasuredView,
    ProcamCalibration,
    ProcamOptions,
    calibrate_procam,
    measure_view,
)
from calibration.rig_geometry import RigGeometry
from calibration.uncertainty import UncertaintyMap, uncertainty_map
from workstation.interruption import interruption_held

_LEAST_POSES = 3
_POSES_TO_SPLIT = 6
# Poses tried for the plane, which takes a board seen whole.
_TRIES = 3


@dataclass(frozen=True)
class UnreadPose:
    """A session in which no board could be measured."""

    name: str
    why: str


@dataclass(frozen=True)
class BoardPoses:
    """Measured poses of the board.

    Attributes
    ----------
    views : tuple of BoardView
    sessions : dict of str to Path
        Session of each pose by its name, so that one can be decoded again: the correspondence maps
        of forty poses would fill the memory. Without them no plane is held out.
    board : Chessboard
    compensate_phases : bool
    unread : tuple of UnreadPose
    camera, projector : Imager
    digests : dict of str to str
        Digest of each session by the pose's name.
    """

    views: tuple[BoardView, ...]
    sessions: dict[str, Path]
    board: Chessboard
    compensate_phases: bool
    unread: tuple[UnreadPose, ...]
    camera: Imager
    projector: Imager
    digests: dict[str, str]


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
    plane : HeldoutPlane or None
    earlier : tuple of EarlierRig
    seconds : dict of str to float
    """

    calibration: ProcamCalibration
    poses: BoardPoses
    gates: GateReport
    uncertainty: tuple[UncertaintyMap, ...]
    heights: HeightUncertainty | None
    differences: tuple[CalibrationDifference, ...]
    plane: HeldoutPlane | None
    earlier: tuple[EarlierRig, ...]
    seconds: dict[str, float] = field(default_factory=dict)


def find_sessions(folders: Sequence[Path]) -> tuple[Path, ...]:
    """Sessions among folders: those that are sessions themselves, and those directly inside others.

    Raises
    ------
    SessionError
        A folder neither is a session nor holds one.
    """
    found: list[Path] = []
    for folder in folders:
        if (folder / PLAN_FILE).is_file():
            found.append(folder)
            continue
        inside = sorted(plan.parent for plan in folder.glob(f"*/{PLAN_FILE}"))
        if not inside:
            raise SessionError(f"{folder} is no session, nor does it hold any")
        found += inside
    return tuple(dict.fromkeys(found))


def measure_poses(
    sessions: Sequence[Path],
    board: Chessboard,
    *,
    compensate_phases: bool = True,
    begin: Callable[[str], None] = lambda stage: None,
) -> BoardPoses:
    """Measure the board in every session.

    Parameters
    ----------
    sessions : sequence of Path
        One pose of the board each.
    board : Chessboard or CharucoBoard
    compensate_phases : bool
        As in :func:`~calibration.procam.measure_view`.
    begin : callable, optional
        Called with the name of each pose as it is begun.

    Raises
    ------
    CalibrationError
        Sessions of different rigs, or the board found in too few.
    SessionError
        A session is damaged.
    """
    views: list[BoardView] = []
    unread: list[UnreadPose] = []
    digests: dict[str, str] = {}
    first: Session | None = None
    for name, path in _names(sessions).items():
        begin(name)
        session = Session.open(path)
        first = first or session
        _check_same_rig(first, session)
        try:
            measured = measure_pose(name, session, board, compensate_phases=compensate_phases)
            views.append(measured.view)
            digests[name] = session.digest
        except (CalibrationError, DecodingError) as error:
            unread.append(UnreadPose(name, str(error).removeprefix(f"{name}: ")))
    if first is None or len(views) < _LEAST_POSES:
        reasons = "; ".join(f"{pose.name}: {pose.why}" for pose in unread)
        raise CalibrationError(
            f"the board was measured in {len(views)} of {len(sessions)} sessions; a calibration "
            f"takes three at least, better ten{'. ' + reasons if reasons else ''}"
        )
    return BoardPoses(
        tuple(views),
        _names(sessions),
        board,
        compensate_phases,
        tuple(unread),
        first.plan.camera,
        first.plan.projector,
        digests,
    )


def measure_pose(
    name: str, session: Session, board: Chessboard, *, compensate_phases: bool = True
) -> MeasuredView:
    """Measure the board in one session.

    Raises
    ------
    CalibrationError
        The board is not found, or not decoded.
    """
    with interruption_held():
        correspondence = decode(session.plan_of(Purpose.CODE), session.read_frame)
    return measure_view(
        name,
        _evenly_lit(correspondence),
        correspondence,
        board,
        compensate_phases=compensate_phases,
    )


def calibrate_rig(
    poses: BoardPoses,
    *,
    options: ProcamOptions | None = None,
    distances: Callable[[RigGeometry], Sequence[KnownDistance]] = lambda rig: (),
    earlier: Sequence[Path] = (),
    begin: Callable[[str], None] = lambda stage: None,
) -> CalibratedRig:
    """Calibrate a rig from measured poses, and gather the evidence.

    Parameters
    ----------
    poses : BoardPoses
    options : ProcamOptions, optional
    distances : callable, optional
        Lengths known apart from the board, and what the rig measures of them.
    earlier : sequence of Path
        Folders of earlier calibrations, the latest first.
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
    done = timed("cross-validating")
    differences = _differences(calibration, poses)
    plane = _heldout_plane(calibration, poses)
    done()
    done = timed("propagating the uncertainty")
    distance = calibration.working_distance_mm
    maps = tuple(
        uncertainty_map(calibration.solution, number, distance_mm=distance)
        for number in range(len(LENS_NAMES))
    )
    heights = _height_uncertainty(calibration)
    drifts = _drifts(calibration, earlier)
    done()
    gates = check_calibration(
        calibration,
        differences=differences,
        distances=distances(calibration.rig),
        plane_over_noise=_roughness(plane),
        drift=drifts[0].drift if drifts else None,
    )
    return CalibratedRig(
        calibration, poses, gates, maps, heights, differences, plane, drifts, seconds
    )


def _names(sessions: Sequence[Path]) -> dict[str, Path]:
    """Sessions by the shortest names that tell them apart."""
    paths = [path.resolve() for path in sessions]
    if len({path.name for path in paths}) == len(paths):
        return {path.name: path for path in paths}
    return {str(path): path for path in paths}


def _check_same_rig(first: Session, other: Session) -> None:
    for name in ("camera", "projector"):
        here, there = getattr(first.plan, name), getattr(other.plan, name)
        if here != there:
            raise CalibrationError(
                f"{other.path}: its {name} has {there.width}×{there.height} pixels, that of "
                f"{first.path} {here.width}×{here.height}; poses of one rig are calibrated together"
            )


def _evenly_lit(correspondence: CorrespondenceMap) -> NDArray[np.float32]:
    """The board in even light: the steps of a fringe add up to it."""
    light = correspondence.ambient
    return np.nan_to_num(light, nan=float(np.nanmedian(light)))


def _differences(
    calibration: ProcamCalibration, poses: BoardPoses
) -> tuple[CalibrationDifference, ...]:
    if len(calibration.views) < _POSES_TO_SPLIT:
        return ()
    return split_difference(
        list(calibration.views),
        calibration.board,
        [poses.camera, poses.projector],
        model=calibration.rig.camera.model,
        distance_mm=calibration.working_distance_mm,
    )


def _heldout_plane(calibration: ProcamCalibration, poses: BoardPoses) -> HeldoutPlane | None:
    """The board of the pose that faces the camera most, by a calibration without it."""
    views = list(calibration.views)
    if len(views) <= _LEAST_POSES or not poses.sessions:
        return None
    facing = np.argsort([-abs(rotation(rt)[2, 2]) for rt in calibration.solution.rt_ref_board])
    for number in facing[:_TRIES]:
        view = views[number]
        solution = solve_without(calibration.solution, {view.name}, views, outlier_sigmas=np.inf)
        rig = RigGeometry(solution.lenses[0], solution.lenses[1], solution.rt_lens_ref[1])
        try:
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
        except CalibrationError:
            continue
        return HeldoutPlane(view.name, relief)
    return None


def _roughness(plane: HeldoutPlane | None) -> float | None:
    return None if plane is None else plane.relief.plane_rms_mm / plane.relief.predicted_noise_mm


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
