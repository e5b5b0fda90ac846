"""What a calibration by a board's surface was solved from, on disk, to be solved again."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

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
        names, board, corners, poses, samples = _held(held)
    # A zip file that is cut off or damaged raises errors of its own.
    except (OSError, ValueError, KeyError, EOFError, TypeError, BadZipFile, zlib.error) as error:
        raise CalibrationError(
            f"{path}: no surface of a board to solve again from ({error}); calibrate with "
            "--board-shape"
        ) from error
    return solve_densely(RigGeometry.load(folder), poses, board, corners, samples), names


def _held(
    held: Mapping[str, NDArray[Any]],
) -> tuple[
    tuple[str, ...],
    Chessboard,
    list[NDArray[np.float64]],
    NDArray[np.float64],
    list[SurfaceSamples],
]:
    """Names, board, corners, poses and samples that arrays stand for.

    Raises
    ------
    ValueError, KeyError, TypeError
        They do not fit together.
    """
    names, poses, blocks = tuple(map(str, held["names"])), held["rt_cam_board"], held["blocks"]
    columns, rows = map(int, held["grid"])
    square, sigma = map(float, held["square_mm"])
    board = Chessboard(columns=columns, rows=rows, square_mm=square, square_sigma_mm=sigma)
    count, total = len(names), int(blocks.sum())
    shapes = {
        "rt_cam_board": (count, 6),
        "corners": (count, rows, columns, 2),
        "blocks": (count,),
        "pixels": (total, 2),
        "coordinates": (total, 2),
        "variance": (total, 2),
        "tile": (total,),
    }
    for name, shape in shapes.items():
        if held[name].shape != shape:
            raise ValueError(f"{name} is of {held[name].shape}, not {shape}")
    cuts = np.cumsum(blocks)[:-1]
    fields = ("pixels", "coordinates", "variance", "tile")
    parts = zip(*(np.split(held[name], cuts) for name in fields), strict=True)
    return names, board, list(held["corners"]), poses, [SurfaceSamples(*part) for part in parts]
