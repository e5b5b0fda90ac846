"""Lenses and board poses as mrcal solved them, and on disk as ``.cameramodel``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mrcal
import numpy as np
from numpy.typing import NDArray

from acquisition.atomic_files import file_in_progress
from calibration.board_views import BoardView
from calibration.errors import CalibrationError
from calibration.lens import Lens, compose, transform
from calibration.mrcal_inputs import (
    BOARDS,
    POSES,
    SPLINED,
    copied,
    indices_of,
    key_in,
    seen_corners,
)


@dataclass(frozen=True)
class LensSolution:
    """Lenses and board poses, with what they were solved from.

    Attributes
    ----------
    lenses : tuple of Lens
    rt_lens_ref : (lenses, 6) float64 array
        Poses of the lenses; the first is the reference.
    names : tuple of str
        The views, in order.
    rt_ref_board : (views, 6) float64 array
        Poses of the board, mm.
    warp_mm : (2,) float64 array
        Bow of the board at its middle along columns and rows.
    square_mm : float
    residuals_px : (views, lenses, rows, columns, 2) float64 array
        Solved less observed pixels; NaN where a corner was not seen.
    outliers : (views, lenses, rows, columns) bool array
        Corners seen but left out.
    sigma0 : float
        Standard deviation of the weighted residuals: 1 where ``sigma_px`` of the views was right.
        Corrected for the parameters that were fitted.
    degrees : int
        Degrees of freedom behind ``sigma0``.
    optimization_inputs : dict
        mrcal's own, at the optimum.
    """

    lenses: tuple[Lens, ...]
    rt_lens_ref: NDArray[np.float64]
    names: tuple[str, ...]
    rt_ref_board: NDArray[np.float64]
    warp_mm: NDArray[np.float64]
    square_mm: float
    residuals_px: NDArray[np.float64]
    outliers: NDArray[np.bool_]
    sigma0: float
    degrees: int
    optimization_inputs: dict[str, Any] = field(repr=False)

    @property
    def inliers(self) -> NDArray[np.bool_]:
        """(views, lenses, rows, columns) bool array: corners that took part."""
        return np.isfinite(self.residuals_px[..., 0]) & ~self.outliers

    @property
    def rms_per_point_px(self) -> float:
        """Root mean square distance of solved and observed corners, all lenses."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px[self.inliers] ** 2, axis=-1))))

    @property
    def rms_per_coordinate_px(self) -> float:
        """Root mean square of the residuals' components, all lenses."""
        return float(np.sqrt(np.mean(self.residuals_px[self.inliers] ** 2)))

    @property
    def weighted_rms(self) -> float:
        """Root mean square of the residuals' components over their ``sigma_px``."""
        inputs = self.optimization_inputs
        kept = inputs["observations_board"][..., 2] > 0
        _, x, _, _ = mrcal.optimizer_callback(**inputs, no_jacobian=True, no_factorization=True)
        weighted = x[: 2 * kept.size].reshape(*kept.shape, 2)
        return float(np.sqrt(np.mean(weighted[kept] ** 2)))

    @property
    def board_points(self) -> NDArray[np.float64]:
        """(rows, columns, 3) corners of the board with its warp, mm."""
        rows, columns = self.residuals_px.shape[2:4]
        return np.asarray(
            mrcal.ref_calibration_object(columns, rows, self.square_mm, calobject_warp=self.warp_mm)
        )

    def project_board(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (views, lenses, ..., 2) of points (..., 3) in the board's frame."""
        views = []
        for rt_ref_board in self.rt_ref_board:
            poses = [compose(rt_lens_ref, rt_ref_board) for rt_lens_ref in self.rt_lens_ref]
            pairs = zip(self.lenses, poses, strict=True)
            views.append([lens.project(transform(pose, points)) for lens, pose in pairs])
        return np.array(views)


def solution_of(inputs: dict[str, Any], names: tuple[str, ...]) -> LensSolution:
    """What mrcal's inputs are at their optimum.

    Parameters
    ----------
    inputs : dict
        mrcal's; they are copied.
    names : tuple of str
        The views, in order.
    """
    observations, indices = inputs["observations_board"], indices_of(inputs)
    frames = np.array(inputs[key_in(inputs, BOARDS)])
    count, (rows, columns) = len(inputs["intrinsics"]), observations.shape[1:3]
    _, x, _, _ = mrcal.optimizer_callback(**inputs, no_jacobian=True, no_factorization=True)
    measured = x[: observations[..., :2].size].reshape(*observations.shape[:3], 2)
    weight = observations[..., 2]
    residuals = np.full((len(frames), count, rows, columns, 2), np.nan)
    outliers = np.zeros(residuals.shape[:-1], bool)
    lenses, poses = _lenses(inputs)
    for number, (frame, lens, _) in enumerate(indices):
        kept = weight[number] > 0
        residuals[frame, lens][kept] = measured[number][kept] / weight[number][kept][:, None]
        outliers[frame, lens] = (weight[number] < 0) & seen_corners(observations[number])
    degrees = 2 * int((weight > 0).sum()) - mrcal.num_states(**inputs)
    chi2 = float(np.sum(measured[weight > 0] ** 2))
    if inputs["lensmodel"].startswith(SPLINED):
        # Most knots of a spline are held by the regularisation, not by the corners.
        degrees = max(degrees, int((weight > 0).sum()))
    solution = LensSolution(
        lenses=lenses,
        rt_lens_ref=poses,
        names=names,
        rt_ref_board=frames,
        warp_mm=np.array(_warp(inputs)),
        square_mm=float(inputs["calibration_object_spacing"]),
        residuals_px=residuals,
        outliers=outliers,
        sigma0=float(np.sqrt(chi2 / max(1, degrees))),
        degrees=max(1, degrees),
        optimization_inputs=copied(inputs),
    )
    _fill_outliers(solution)
    return solution


def save_lens(solution: LensSolution, number: int, path: Path) -> None:
    """Write a lens as a ``.cameramodel`` that carries what it was solved from."""
    model = mrcal.cameramodel(
        optimization_inputs=copied(solution.optimization_inputs), icam_intrinsics=number
    )
    names = " ".join(solution.names)
    with file_in_progress(Path(path)) as temporary:
        model.write(str(temporary), note=f"views: {names}")


def load_solution(path: Path, *, names: tuple[str, ...] | None = None) -> LensSolution:
    """The solution that a ``.cameramodel`` carries.

    Raises
    ------
    CalibrationError
        The file is unreadable or carries none.
    """
    try:
        inputs = mrcal.cameramodel(str(path)).optimization_inputs()
    except Exception as error:  # mrcal raises bare Exceptions of its own
        raise CalibrationError(f"{path}: not a readable camera model ({error})") from error
    if inputs is None:
        raise CalibrationError(f"{path}: the model does not say what it was solved from")
    frames = len(inputs[key_in(inputs, BOARDS)])
    return solution_of(inputs, names or tuple(f"view {n + 1}" for n in range(frames)))


def stored_views(solution: LensSolution) -> list[BoardView]:
    """The observations of a solution as views, with its outliers back in place."""
    inputs = solution.optimization_inputs
    observations, indices = inputs["observations_board"], indices_of(inputs)
    rows, columns = observations.shape[1:3]
    lenses = len(inputs["intrinsics"])
    pixels = np.full((len(solution.names), lenses, rows, columns, 2), np.nan)
    sigma = np.ones(pixels.shape[:-1])
    for observed, (frame, lens, _) in zip(observations, indices, strict=True):
        seen = seen_corners(observed)
        pixels[frame, lens][seen] = observed[..., :2][seen]
        sigma[frame, lens][seen] = 1 / np.abs(observed[..., 2][seen])
    return [
        BoardView(name, tuple(pixels[n]), tuple(sigma[n])) for n, name in enumerate(solution.names)
    ]


def _fill_outliers(solution: LensSolution) -> None:
    """Residuals of the corners left out, into the array of a solution being made."""
    if not solution.outliers.any():
        return
    projected = solution.project_board(solution.board_points)
    observed = np.full(projected.shape, np.nan)
    inputs = solution.optimization_inputs
    for pixels, (frame, lens, _) in zip(
        inputs["observations_board"], indices_of(inputs), strict=True
    ):
        observed[frame, lens] = pixels[..., :2]
    left = solution.outliers
    solution.residuals_px[left] = (projected - observed)[left]


def _lenses(inputs: dict[str, Any]) -> tuple[tuple[Lens, ...], NDArray[np.float64]]:
    sizes, model = inputs["imagersizes"], inputs["lensmodel"]
    lenses = tuple(
        Lens(model, np.array(numbers, np.float64), int(size[0]), int(size[1]))
        for numbers, size in zip(inputs["intrinsics"], sizes, strict=True)
    )
    poses = np.zeros((len(lenses), 6))
    for _, lens, pose in indices_of(inputs):
        if pose >= 0:
            poses[lens] = inputs[key_in(inputs, POSES)][pose]
    return lenses, poses


def _warp(inputs: dict[str, Any]) -> NDArray[np.float64]:
    warp = inputs.get("calobject_warp")
    return np.zeros(2) if warp is None else np.asarray(warp, np.float64)[:2]
