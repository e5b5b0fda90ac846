"""Boards seen by a simulated camera and projector, through OpenCV: independent of mrcal.

The truth for tests and benchmarks of calibration: lenses, poses and corners are made by
``cv2.projectPoints``, noise is Gaussian.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from acquisition.plan import Imager
from calibration.board_views import BoardView
from calibration.boards import Chessboard
from calibration.lens import compose, invert, rt_from_matrix, transform
from calibration.mrcal_solution import LensSolution
from calibration.uncertainty import uncertainty_map

CAMERA = Imager(width=1600, height=1200)
PROJECTOR = Imager(width=1280, height=800)
BOARD = Chessboard(columns=12, rows=9, square_mm=20.0)
NOISE_PX = 0.1


@dataclass(frozen=True)
class TrueLens:
    """A lens of OpenCV's family.

    Attributes
    ----------
    matrix : (3, 3) float64 array
    distortion : (n,) float64 array
    rt_lens_ref : (6,) float64 array
    """

    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    rt_lens_ref: NDArray[np.float64]

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (..., 2) of points (..., 3) in the reference frame."""
        rotation, translation = self.rt_lens_ref[:3], self.rt_lens_ref[3:]
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        pixels, _ = cv2.projectPoints(flat, rotation, translation, self.matrix, self.distortion)
        return np.asarray(pixels, np.float64).reshape(*points.shape[:-1], 2)


def true_rig() -> tuple[TrueLens, TrueLens]:
    """A camera, and a projector with its principal point below the panel."""
    camera = TrueLens(
        np.array([[2000.0, 0, 805], [0, 2004, 592], [0, 0, 1]]),
        np.array([-0.08, 0.06, 4e-4, -3e-4]),
        np.zeros(6),
    )
    projector = TrueLens(
        np.array([[1900.0, 0, 640], [0, 1902, 850], [0, 0, 1]]),
        np.array([-0.03, 0.02, 3e-4, 2e-4]),
        np.array([0.25, 0.28, 0.01, -170.0, 20.0, 40.0]),
    )
    return camera, projector


@dataclass(frozen=True)
class SimulatedBoards:
    """Views with their truth.

    Attributes
    ----------
    views : list of BoardView
    rt_ref_board : (views, 6) float64 array
    lenses : tuple of TrueLens
    """

    views: list[BoardView]
    rt_ref_board: NDArray[np.float64]
    lenses: tuple[TrueLens, ...]


def board_poses(
    count: int, *, rng: np.random.Generator, tilt: float = 0.5, region: float = 1.0
) -> NDArray[np.float64]:
    """Poses of a board about 700 mm before the camera.

    Parameters
    ----------
    count : int
    rng : numpy Generator
    tilt : float
        Largest tilt in radians; 0 holds all boards parallel.
    region : float
        Share of the image's width, from its left, in which the boards stay.
    """
    middle = BOARD.points.reshape(-1, 3).mean(axis=0)
    poses = []
    for _ in range(count):
        axis = rng.uniform(-tilt, tilt, 2) if tilt else np.zeros(2)
        turning = np.array([axis[0], axis[1], rng.uniform(-0.3, 0.3)])
        turn = np.asarray(cv2.Rodrigues(turning)[0], np.float64)
        depth = rng.uniform(600, 850)
        x = (rng.uniform(-0.36, -0.36 + 0.72 * region)) * depth * CAMERA.width / 2000
        y = rng.uniform(-0.33, 0.33) * depth * CAMERA.height / 2000
        poses.append(rt_from_matrix(turn, np.array([x, y, depth]) - turn @ middle))
    return np.array(poses)


def simulate_boards(
    count: int = 20,
    *,
    seed: int = 0,
    tilt: float = 0.5,
    region: float = 1.0,
    noise_px: float = NOISE_PX,
    board_points: NDArray[np.float64] | None = None,
) -> SimulatedBoards:
    """Views of a board by camera and projector, corners outside either image missing.

    Parameters
    ----------
    count : int
    seed : int
    tilt, region
        As for :func:`board_poses`.
    noise_px : float
        Standard deviation of a corner in camera and projector.
    board_points : (rows, columns, 3) array, optional
        Corners of a board that is not flat.
    """
    rng = np.random.default_rng(seed)
    points = BOARD.points if board_points is None else board_points
    lenses = true_rig()
    views: list[BoardView] = []
    kept: list[NDArray[np.float64]] = []
    while len(views) < count:
        pose = board_poses(1, rng=rng, tilt=tilt, region=region)[0]
        pixels = []
        for lens, imager in zip(lenses, (CAMERA, PROJECTOR), strict=True):
            seen = lens.project(transform(pose, points))
            seen = seen + rng.normal(0, noise_px, seen.shape)
            inside = (seen > -0.5) & (seen < np.array([imager.width, imager.height]) - 0.5)
            pixels.append(np.where(inside.all(axis=-1, keepdims=True), seen, np.nan))
        # What the projector does not light, the camera sees all the same.
        if all(np.isfinite(p[..., 0]).sum() >= 40 for p in pixels):
            views.append(BoardView.of(f"pose {len(views) + 1}", pixels, sigma_px=noise_px))
            kept.append(pose)
    return SimulatedBoards(views, np.array(kept), lenses)


def projection_errors(
    solution: LensSolution, truth: SimulatedBoards, number: int, *, distance_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """True errors of projection, and their predicted standard deviations.

    A point is fixed to the boards; each board carries it to the true lens, and the mean over the
    boards is what the lens should have seen (the definition of mrcal's projection uncertainty).

    Returns
    -------
    errors_px : (rows, cols, 2) float64 array
    whitened : (rows, cols, 2) float64 array
        Errors over the square root of their predicted covariance.
    """
    predicted = uncertainty_map(solution, number, distance_mm=distance_mm, columns=12)
    rays = solution.lenses[number].unproject(predicted.pixels)
    points = rays * (distance_mm / np.linalg.norm(rays, axis=-1, keepdims=True))
    in_ref = transform(invert(solution.rt_lens_ref[number]), points)
    carried = np.mean(
        [
            transform(compose(true, invert(solved)), in_ref)
            for true, solved in zip(truth.rt_ref_board, solution.rt_ref_board, strict=True)
        ],
        axis=0,
    )
    errors = predicted.pixels - truth.lenses[number].project(carried)
    root = np.linalg.cholesky(predicted.covariance)
    return errors, np.linalg.solve(root, errors[..., np.newaxis])[..., 0]
