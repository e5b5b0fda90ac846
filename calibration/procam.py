"""Calibration of a camera and a projector together, from poses of a board.

The projector is a camera that sees the board through decoded coordinates. Both are solved in one
problem, so that the pose between them and its covariance come from all observations at once:

1. :func:`~calibration.measured_views.measure_view` finds the board's corners in a view's picture,
   and their projector coordinates in its correspondence map.
2. :func:`calibrate_procam` leaves out views that contradict the rest, chooses the lens model by
   cross-validation, solves, takes the noise of each lens from its own residuals, and, where asked,
   solves for the shape of the board.
3. :func:`~calibration.surface_calibration.calibrate_by_surface` goes on from there with all of the
   board's surface.

The result names every view and corner that was left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.plan import Imager
from calibration.board_shape import BoardShape, align_turned_views, solve_with_shape
from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.contradictory_views import RejectedView, without_contradictions
from calibration.cross_validation import ModelChoice, choose_model
from calibration.dense_solution import DenseSolution
from calibration.errors import CalibrationError
from calibration.lens import rotation
from calibration.mrcal_solution import LensSolution, save_lens, stored_views
from calibration.mrcal_solve import resolve, solve_lenses, with_noise_of
from calibration.opencv_files import write_matrices
from calibration.rig_geometry import CAMERA_FILE, PROJECTOR_FILE, RigGeometry
from calibration.surface_files import SURFACE_FILE, save_surface
from calibration.uncertainty import (
    RigCovariance,
    UncertaintyMap,
    covariance_map,
    rig_covariance,
    uncertainty_map,
)

OPENCV_MODELS = ("LENSMODEL_OPENCV4", "LENSMODEL_OPENCV5", "LENSMODEL_OPENCV8")
LENS_NAMES = ("camera", "projector")
# Without one of them three must remain.
LEAST_VIEWS_TO_CHOOSE = 4
_NOISE_ROUNDS = 2


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
        Lenses, poses and residuals; camera first. With a surface, as the surface leaves them: what
        mrcal solved is where that started.
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
    surface : DenseSolution or None
        If all of the board's surface was solved from.
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
    surface: DenseSolution | None = None

    def covariance(self) -> RigCovariance:
        """Joint covariance of the rig, with the scale error of the board's squares."""
        sigma = self.board.square_sigma_mm / self.board.square_mm
        if self.surface is not None:
            assert self.surface.rig.covariance is not None  # by the solve
            return RigCovariance(self.rig, self.surface.rig.covariance, sigma)
        return rig_covariance(self.solution, scale_sigma=sigma)

    def rig_with_covariance(self) -> RigGeometry:
        """The rig with its covariance, the scale error of the board's squares in it."""
        found = self.covariance()
        covariance = found.covariance.copy()
        # Whatever scales the baseline scales everything that is triangulated.
        baseline = self.rig.rt_proj_cam[3:]
        covariance[-3:, -3:] += found.scale_sigma**2 * np.outer(baseline, baseline)
        return replace(self.rig, covariance=covariance)

    def uncertainty_map(self, number: int) -> UncertaintyMap:
        """Uncertainty of a lens's projection at the working distance."""
        distance, surface = self.working_distance_mm, self.surface
        if surface is None:
            return uncertainty_map(self.solution, number, distance_mm=distance)
        return covariance_map(
            surface.lenses[number],
            lambda points: surface.projection_covariance(number, points),
            distance_mm=distance,
        )

    def save(self, folder: Path) -> None:
        """Write the rig: both ``.cameramodel`` files, and the covariance.

        With them goes what they were solved from, so that they can be solved again: corners inside
        of the models, the surface of a board in a file of its own.
        """
        folder = Path(folder)
        self.rig_with_covariance().save(folder)
        if self.surface is not None:
            save_surface(self.surface, self.solution.names, folder / SURFACE_FILE)
            return
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
    kept, rejected = without_contradictions(views, board, imagers, model=options.models[0])
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
        rejected_corners(solution),
        working_distance(solution),
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


def _as_solved(solution: LensSolution, views: list[BoardView]) -> list[BoardView]:
    """The pixels that a solution was solved from, with the views' noise."""
    stored = stored_views(solution)
    return [replace(s, sigma_px=v.sigma_px) for s, v in zip(stored, views, strict=True)]


def rejected_corners(solution: LensSolution) -> tuple[RejectedCorner, ...]:
    """Corners that were left out, by name."""
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


def working_distance(solution: LensSolution) -> float:
    """Median distance of the boards' middles along the camera's axis, mm."""
    middle = solution.board_points.reshape(-1, 3).mean(axis=0)
    return float(np.median([(rotation(rt) @ middle + rt[3:])[2] for rt in solution.rt_ref_board]))


def _opencv_matrices(rig: RigGeometry) -> dict[str, NDArray[np.float64]]:
    matrices = {}
    for name, lens in (("camera", rig.camera), ("projector", rig.projector)):
        f_x, f_y, c_x, c_y = lens.intrinsics[:4]
        matrices[f"{name}_matrix"] = np.array([[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1.0]])
        matrices[f"{name}_distortion"] = lens.intrinsics[4:]
    matrices["rotation"] = rotation(rig.rt_proj_cam)
    matrices["translation"] = rig.rt_proj_cam[3:].reshape(3, 1)
    return matrices
