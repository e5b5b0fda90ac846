"""What a calibration by a board's surface was solved from, on disk, to be solved again."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from acquisition.atomic_files import file_in_progress
from calibration.boards import Chessboard
from calibration.dense_solution import DenseSolution
from calibration.dense_solve import solve_densely
from calibration.errors import CalibrationError
from calibration.rig_geometry import RigGeometry
from calibration.surface_samples import SurfaceSamples

SURFACE_FILE = "board_surface.npz"


def save_surface(dense: DenseSolution, names: tuple[str, ...], path: Path) -> None:
    """Write what a solution was solved from, and the board's poses, as NumPy's ``.npz``.

    Parameters
    ----------
    dense : DenseSolution
    names : tuple of str
        Of the views.
    path : Path
    """
    board, samples = dense.problem.board, dense.problem.samples
    arrays = {
        "names": np.array(names),
        "rt_cam_board": dense.rt_cam_board,
        "grid": np.array([board.columns, board.rows]),
        "square_mm": np.array([board.square_mm, board.square_sigma_mm]),
        "corners": np.stack(dense.problem.corners),
        "blocks": np.array([len(one.pixels) for one in samples]),
        "pixels": np.concatenate([one.pixels for one in samples]),
        "coordinates": np.concatenate([one.coordinates for one in samples]),
        "variance": np.concatenate([one.variance for one in samples]),
        "tile": np.concatenate([one.tile for one in samples]),
    }
    with file_in_progress(Path(path)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def solve_saved_surface(folder: Path) -> tuple[DenseSolution, tuple[str, ...]]:
    """Solve again from a calibration's folder.

    Parameters
    ----------
    folder : Path
        Where a calibration by a board's surface was saved; its rig is where the solve starts.

    Returns
    -------
    solution : DenseSolution
    names : tuple of str
        Of the views.

    Raises
    ------
    CalibrationError
        The folder holds no such calibration.
    """
    path = Path(folder) / SURFACE_FILE
    try:
        with np.load(path, allow_pickle=False) as stored:
            held = {name: stored[name] for name in stored.files}
        cuts = np.cumsum(held["blocks"])[:-1]
        fields = ("pixels", "coordinates", "variance", "tile")
        parts = zip(*(np.split(held[name], cuts) for name in fields), strict=True)
        columns, rows = map(int, held["grid"])
        square, sigma = map(float, held["square_mm"])
        board = Chessboard(columns=columns, rows=rows, square_mm=square, square_sigma_mm=sigma)
        corners, poses = list(held["corners"]), held["rt_cam_board"]
        names = tuple(map(str, held["names"]))
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise CalibrationError(
            f"{path}: no surface of a board to solve again from ({error}); calibrate with "
            "--board-shape"
        ) from error
    samples = [SurfaceSamples(*part) for part in parts]
    return solve_densely(RigGeometry.load(folder), poses, board, corners, samples), names
