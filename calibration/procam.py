"""Calibration of a camera and a projector together, from poses of a board.

The projector is a camera that sees the board through decoded coordinates. Both are solved in one
problem, so that the pose between them and its covariance come from all observations at once:

1. :func:`measure_view` finds the board's corners in a view's picture, and their projector
   coordinates in its correspondence map.
2. :func:`calibrate_procam` leaves out views that contradict the rest, chooses the lens model by
   cross-validation, solves, takes the noise of each lens from its own residuals, and, where asked,
   solves for the shape of the board.

The result names every view and corner that was left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from acquisition.patterns import Axis
from acquisition.plan import Imager
from calibration.board_coordinates import projector_coordinates
from calibration.board_shape import BoardShape, align_turned_views, solve_with_shape
from calibration.board_views import BoardView
from calibration.boards import Chessboard, detect_corners
from calibration.cross_validation import ModelChoice, choose_model, fit_board_pose
from calibration.errors import CalibrationError
from calibration.lens import rotation
from calibration.mrcal_solution import LensSolution, save_lens, stored_views
from calibration.mrcal_solve import resolve, solve_lenses, with_noise_of
from calibration.opencv_files import write_matrices
from calibration.phase_errors import PhaseErrors, compensate_phase_errors
from calibration.rig_geometry import CAMERA_FILE, PROJECTOR_FILE, RigGeometry
from calibration.uncertainty import RigCovariance, rig_covariance
from calibration.view_seeds import discord_of_views

OPENCV_MODELS = ("LENSMODEL_OPENCV4", "LENSMODEL_OPENCV5", "LENSMODEL_OPENCV8")
LENS_NAMES = ("camera", "projector")
_LEAST_VIEWS = 3
# Without one of them three must remain.
LEAST_VIEWS_TO_CHOOSE = 4
# A view is out of line when, held out, it leaves this many times what the others leave.
_CONTRADICTION = 4.0
_LEAST_GAIN = 1.5
_NOISE_ROUNDS = 2
# First guesses of a view that is counted wrongly are off by half the board, of others by a few
# hundredths of it.
_DISCORD = 0.25


@dataclass(frozen=True, kw_only=True)
class ProcamOptions:
    """How camera and projector are calibrated.

    Attributes
    ----------
    models : tuple of str
        Lens models to be compared, from the simplest to the richest. Of one, it is measured how
        well it explains views that it has not seen; of three views, the simplest is taken.
    outlier_sigmas : float
        Residual over the root mean square beyond which a corner is left out.
    board_warp : bool
        Whether the board's bow is solved for.
    board_shape : bool
        Whether the place of every corner is: for boards of paper or cardboard, from views that
        show the same end of the board first or are told apart by its shape.
    """

    models: tuple[str, ...] = OPENCV_MODELS
    outlier_sigmas: float = 5.0
    board_warp: bool = True
    board_shape: bool = False

    def __post_init__(self) -> None:
        if not self.models:
            raise CalibrationError("no lens model to calibrate is named")
        if not self.outlier_sigmas > 1:
            raise CalibrationError("outlier_sigmas must be above 1")


@dataclass(frozen=True)
class MeasuredView:
    """A board's view, measured.

    Attributes
    ----------
    view : BoardView
        Camera first, projector second.
    correspondence : CorrespondenceMap
        With phase errors compensated, if asked.
    phase_errors : dict
        :class:`~calibration.phase_errors.PhaseErrors` by axis; empty if not asked for.
    """

    view: BoardView
    correspondence: CorrespondenceMap
    phase_errors: dict[Axis, PhaseErrors]


@dataclass(frozen=True)
class RejectedView:
    """A view that was left out.

    Attributes
    ----------
    name : str
    rms_px : float
        What it leaves against the calibration by the others, per point.
    why : str
    """

    name: str
    rms_px: float
    why: str


@dataclass(frozen=True)
class RejectedCorner:
    """A corner that was left out.

    Attributes
    ----------
    view, lens : str
    row, column : int
        On the board.
    residual_px : float
        Distance of solved and observed corner.
    """

    view: str
    lens: str
    row: int
    column: int
    residual_px: float

    def __str__(self) -> str:
        return (
            f"{self.view}, {self.lens}: corner at row {self.row}, column {self.column}, "
            f"{self.residual_px:.2f} px"
        )


@dataclass(frozen=True)
class ProcamCalibration:
    """Camera and projector, calibrated.

    Attributes
    ----------
    rig : RigGeometry
    solution : LensSolution
        Lenses, poses and residuals; camera first.
    views : tuple of BoardView
        What took part, with the noise found; corners as observed.
    board : Chessboard
    models : ModelChoice or None
        None where there are too few views to hold any out.
    shape : BoardShape or None
        Of the board, if it was solved for.
    rejected_views : tuple of RejectedView
    rejected_corners : tuple of RejectedCorner
    working_distance_mm : float
        Median distance of the boards along the camera's axis.
    """

    rig: RigGeometry
    solution: LensSolution
    views: tuple[BoardView, ...]
    board: Chessboard
    models: ModelChoice | None
    shape: BoardShape | None
    rejected_views: tuple[RejectedView, ...]
    rejected_corners: tuple[RejectedCorner, ...]
    working_distance_mm: float

    def covariance(self) -> RigCovariance:
        """Joint covariance of the rig, with the scale error of the board's squares."""
        sigma = self.board.square_sigma_mm / self.board.square_mm
        return rig_covariance(self.solution, scale_sigma=sigma)

    def rig_with_covariance(self) -> RigGeometry:
        """The rig with its covariance, the scale error of the board's squares in it."""
        found = self.covariance()
        covariance = found.covariance.copy()
        # Whatever scales the baseline scales everything that is triangulated.
        baseline = self.rig.rt_proj_cam[3:]
        covariance[-3:, -3:] += found.scale_sigma**2 * np.outer(baseline, baseline)
        return replace(self.rig, covariance=covariance)

    def save(self, folder: Path) -> None:
        """Write the rig: both ``.cameramodel`` files, and the covariance.

        The models carry what they were solved from, so that they can be solved again.
        """
        folder = Path(folder)
        self.rig_with_covariance().save(folder)
        for number, name in enumerate((CAMERA_FILE, PROJECTOR_FILE)):
            save_lens(self.solution, number, folder / name)

    def save_opencv(self, path: Path) -> None:
        """Write matrices and distortion of both lenses and the pose in between as OpenCV does.

        Parameters
        ----------
        path : Path
            ``.yml`` or ``.xml``.

        Raises
        ------
        CalibrationError
            The lens model is none of OpenCV's.
        """
        if any(lens.opencv_parameters is None for lens in self.solution.lenses):
            raise CalibrationError(
                f"{path}: OpenCV has no lens like {self.rig.camera.model}; calibrate with one of "
                f"{', '.join(OPENCV_MODELS)}"
            )
        write_matrices(Path(path), _opencv_matrices(self.rig))


def measure_view(
    name: str,
    picture: NDArray[np.generic],
    correspondence: CorrespondenceMap,
    board: Chessboard,
    *,
    camera_sigma_px: float = 0.1,
    compensate_phases: bool = True,
) -> MeasuredView:
    """Find a board's corners in camera and projector.

    Parameters
    ----------
    name : str
        What the view is called in reports.
    picture : (rows, cols) array
        The board in even light, of the same crop as the correspondence map.
    correspondence : CorrespondenceMap
        Decoded along both axes.
    board : Chessboard or CharucoBoard
    camera_sigma_px : float
        First guess of the noise of a corner in the picture.
    compensate_phases : bool
        Whether periodic errors and the bias at edges are estimated and subtracted.

    Raises
    ------
    CalibrationError
        The board is not found, or not decoded.
    """
    if picture.shape != correspondence.shape:
        raise CalibrationError(
            f"{name}: a picture of {picture.shape} with a correspondence map of "
            f"{correspondence.shape}"
        )
    corners = detect_corners(picture, board, name=name) + np.asarray(correspondence.origin, float)
    errors: dict[Axis, PhaseErrors] = {}
    if compensate_phases:
        correspondence, errors = compensate_phase_errors(correspondence, corners, name=name)
    found = projector_coordinates(correspondence, corners, name=name)
    view = BoardView(
        name,
        (corners, found.pixels),
        (
            np.full(corners.shape[:2], camera_sigma_px),
            found.sigma_px(camera_sigma_px=camera_sigma_px),
        ),
    )
    return MeasuredView(view, correspondence, errors)


def calibrate_procam(
    views: list[BoardView],
    board: Chessboard,
    *,
    camera: Imager,
    projector: Imager,
    options: ProcamOptions | None = None,
) -> ProcamCalibration:
    """Calibrate camera and projector from views of a board.

    Parameters
    ----------
    views : list of BoardView
        Camera first, projector second.
    board : Chessboard
    camera, projector : Imager
        Sizes of sensor and panel.
    options : ProcamOptions, optional

    Raises
    ------
    CalibrationError
        Too few views, or a solve that fails; it says what to record.
    """
    options = options or ProcamOptions()
    imagers = [camera, projector]
    names = [view.name for view in views]
    if len(set(names)) != len(names):
        raise CalibrationError("two views have one name; outliers could not be told apart")
    kept, rejected = _without_contradictions(views, board, imagers, options)
    choice = None
    if len(kept) >= LEAST_VIEWS_TO_CHOOSE:
        choice = choose_model(
            kept, board, imagers, options.models, outlier_sigmas=options.outlier_sigmas
        )
    model = choice.chosen if choice else options.models[0]
    solution = _solve(kept, board, imagers, model, options)
    shape = None
    if options.board_shape:
        kept = align_turned_views(solution, kept)
        solution = _solve(kept, board, imagers, model, options)
        solution, shape = solve_with_shape(solution, kept)
    for _ in range(_NOISE_ROUNDS):
        kept = with_noise_of(solution, kept)
        solution = resolve(solution, _as_solved(solution, kept))
        if options.board_shape:
            solution, shape = solve_with_shape(solution, kept)
    rig = RigGeometry(solution.lenses[0], solution.lenses[1], solution.rt_lens_ref[1])
    return ProcamCalibration(
        rig,
        solution,
        tuple(kept),
        board,
        choice,
        shape,
        rejected,
        _rejected_corners(solution),
        float(np.median(_centres(solution)[:, 2])),
    )


def _solve(
    views: list[BoardView],
    board: Chessboard,
    imagers: list[Imager],
    model: str,
    options: ProcamOptions,
) -> LensSolution:
    return solve_lenses(
        views,
        board,
        imagers,
        model=model,
        board_warp=options.board_warp,
        outlier_sigmas=options.outlier_sigmas,
    )


def _without_contradictions(
    views: list[BoardView], board: Chessboard, imagers: list[Imager], options: ProcamOptions
) -> tuple[list[BoardView], tuple[RejectedView, ...]]:
    """Views that agree, by leaving out the worst as long as the others fit much better for it."""
    kept, discordant = _without_discord(views, board, imagers)
    rejected: list[RejectedView] = []
    model = options.models[0]

    def solve(some: list[BoardView]) -> LensSolution:
        return solve_lenses(some, board, imagers, model=model, outlier_sigmas=np.inf)

    solution = solve(kept)
    while len(kept) > _LEAST_VIEWS:
        per_view = np.sqrt(np.nanmean(solution.residuals_px**2, axis=(1, 2, 3, 4)))
        worst = int(np.argmax(per_view))
        others = np.delete(per_view, worst)
        if per_view[worst] < 1.5 * np.median(others):
            break
        rest = kept[:worst] + kept[worst + 1 :]
        without = solve(rest)
        left = _left_by(without, kept[worst])
        usual = without.rms_per_point_px
        gain = solution.rms_per_point_px / usual
        if not (gain > _LEAST_GAIN and left > _CONTRADICTION * usual):
            break
        rejected.append(
            RejectedView(
                kept[worst].name,
                left,
                f"its corners are {left:.2f} px off the calibration by the other views, which "
                f"leave {usual:.2f} px themselves: corners counted from another end, another "
                "board, or a rig that was moved",
            )
        )
        kept, solution = rest, without
    for view in discordant:
        left = _left_by(solution, view)
        rejected.append(
            RejectedView(
                view.name,
                left,
                "camera and projector see its board at poses that contradict those of the other "
                "views: corners counted from another end in one of them, or a rig that was moved",
            )
        )
    return kept, tuple(rejected)


def _without_discord(
    views: list[BoardView], board: Chessboard, imagers: list[Imager]
) -> tuple[list[BoardView], list[BoardView]]:
    """Views whose first guesses agree, and those that would lead the solve astray."""
    discord = discord_of_views(views, board, imagers)
    limit = max(_DISCORD, 4 * float(np.nanmedian(discord)))
    kept = [v for v, apart in zip(views, discord, strict=True) if not apart > limit]
    # Where many disagree the guesses are bad, not the views.
    if len(kept) < max(_LEAST_VIEWS, 0.75 * len(views)):
        return list(views), []
    return kept, [v for v, apart in zip(views, discord, strict=True) if apart > limit]


def _left_by(solution: LensSolution, view: BoardView) -> float:
    try:
        return fit_board_pose(
            solution.lenses, solution.rt_lens_ref, view, solution.board_points
        ).rms_per_point_px
    except CalibrationError:
        return float("inf")


def _as_solved(solution: LensSolution, views: list[BoardView]) -> list[BoardView]:
    """The pixels that a solution was solved from, with the views' noise."""
    stored = stored_views(solution)
    return [replace(s, sigma_px=v.sigma_px) for s, v in zip(stored, views, strict=True)]


def _rejected_corners(solution: LensSolution) -> tuple[RejectedCorner, ...]:
    return tuple(
        RejectedCorner(
            solution.names[view],
            LENS_NAMES[lens],
            int(row),
            int(column),
            float(np.linalg.norm(solution.residuals_px[view, lens, row, column])),
        )
        for view, lens, row, column in np.argwhere(solution.outliers)
    )


def _centres(solution: LensSolution) -> NDArray[np.float64]:
    middle = solution.board_points.reshape(-1, 3).mean(axis=0)
    return np.array([rotation(rt) @ middle + rt[3:] for rt in solution.rt_ref_board])


def _opencv_matrices(rig: RigGeometry) -> dict[str, NDArray[np.float64]]:
    matrices = {}
    for name, lens in (("camera", rig.camera), ("projector", rig.projector)):
        f_x, f_y, c_x, c_y = lens.intrinsics[:4]
        matrices[f"{name}_matrix"] = np.array([[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1.0]])
        matrices[f"{name}_distortion"] = lens.intrinsics[4:]
    matrices["rotation"] = rotation(rig.rt_proj_cam)
    matrices["translation"] = rig.rt_proj_cam[3:].reshape(3, 1)
    return matrices
