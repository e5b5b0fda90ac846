"""A sheared, blistered board seen by a rig whose projector moves once: the truth, by formulas."""

from __future__ import annotations

import cv2
import numpy as np

from calibration.boards import Chessboard
from calibration.lens import Lens, compose, rt_from_matrix, transform
from calibration.rig_geometry import RigGeometry
from calibration.surface_samples import SurfaceSamples

BOARD = Chessboard(columns=8, rows=6, square_mm=10.0)
SHEAR = 1e-3
TURN = np.array([3e-4, 0.0, 1e-4, 0.0, 0.0, 0.0])
NOISE_PX = 0.02
RIG = RigGeometry(
    Lens("LENSMODEL_OPENCV4", np.array([2000.0, 2000, 800, 600, -0.08, 0.1, 0, 0]), 1600, 1200),
    Lens("LENSMODEL_OPENCV4", np.array([1900.0, 1900, 640, 850, -0.03, 0.02, 0, 0]), 1280, 800),
    np.array([0.2, 0.25, 0.0, -140.0, -40.0, 70.0]),
)
TILTS = ((0.4, 0.1, 0.0), (-0.3, 0.35, 0.1), (0.1, -0.4, -0.1), (-0.1, 0.05, 1.5))


def relief(places):
    x, y = places.T
    return 0.3 * np.exp(-(((x - 25) / 9) ** 2) - ((y - 30) / 7) ** 2) - 0.2 * np.exp(
        -(((x - 60) / 8) ** 2) - ((y - 20) / 12) ** 2
    )


def poses():
    middle = BOARD.points.reshape(-1, 3).mean(axis=0)
    found = []
    for number, tilt in enumerate(TILTS):
        turn = np.asarray(cv2.Rodrigues(np.array(tilt))[0], np.float64)
        found.append(rt_from_matrix(turn, np.array([0, 0, 330.0 + 25 * number]) - turn @ middle))
    return np.array(found)


def printed_corners():
    """(rows, columns, 3) where the corners are: sheared, and on the relief."""
    printed = BOARD.points.copy()
    printed[..., 0] += SHEAR * printed[..., 1]
    printed[..., 2] = relief(printed[..., :2].reshape(-1, 2)).reshape(printed.shape[:2])
    return printed


def aligned_poses():
    """Of the grid laid onto the printed corners (Kabsch), as a solve has them."""
    grid, printed = (p.reshape(-1, 3) for p in (BOARD.points, printed_corners()))
    centres = grid.mean(axis=0), printed.mean(axis=0)
    left, _, right = np.linalg.svd((printed - centres[1]).T @ (grid - centres[0]))
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    onto = rt_from_matrix(turn, centres[1] - turn @ centres[0])
    return np.array([compose(pose, onto) for pose in poses()])


def simulated(rng, *, drift):
    """Corners and samples of a sheared, blistered board; the projector turned at one pose.

    Of several drifts each pose has its own.
    """
    drifts = drift if np.ndim(drift) == 2 else np.outer(np.arange(len(TILTS)) == 1, drift)
    corners, samples = [], []
    x, y = np.meshgrid(np.linspace(-6, 76, 30), np.linspace(-6, 56, 23))
    places = np.column_stack([x.ravel(), y.ravel()])
    surface = np.column_stack([places, relief(places)])
    printed = printed_corners().reshape(-1, 3)
    for number, pose in enumerate(poses()):
        moved = compose(drifts[number], RIG.rt_proj_cam)
        seen = RIG.camera.project(transform(pose, printed))
        corners.append((seen + rng.normal(0, NOISE_PX, seen.shape)).reshape(6, 8, 2))
        here = transform(pose, surface)
        lit = RIG.projector.project(transform(moved, here))
        lit = lit + rng.normal(0, NOISE_PX, lit.shape)
        tile = (places // 20 + 1).astype(int) @ [1, 100]
        samples.append(
            SurfaceSamples(RIG.camera.project(here), lit, np.full(lit.shape, NOISE_PX**2), tile)
        )
    return corners, samples


def started(rng):
    step = np.zeros(len(RIG.parameters))
    step[[0, 1, 2, 3, 8, 9, 10, 11]] = rng.normal(0, 4, 8)
    step[-6:] = rng.normal(0, [1e-3] * 3 + [0.3] * 3)
    return RIG.moved(step), poses() + rng.normal(0, [1e-3] * 3 + [0.2] * 3, (4, 6))
