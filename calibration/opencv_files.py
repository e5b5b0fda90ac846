"""OpenCV's own calibration files, YAML or XML: named matrices, read and written."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from acquisition.atomic_files import file_in_progress
from acquisition.capture_description import CalibrationDescription, Direction
from acquisition.plan import Imager
from calibration.errors import CalibrationError
from calibration.lens import Lens, invert, rt_from_matrix
from calibration.rig_geometry import RigGeometry


def read_matrices(path: Path, names: list[str]) -> dict[str, NDArray[np.float64]]:
    """Read matrices by name.

    Parameters
    ----------
    path : Path
        OpenCV YAML, XML or JSON file.
    names : list of str
        Matrices wanted.

    Returns
    -------
    dict of (rows, cols) float64 arrays

    Raises
    ------
    CalibrationError
        The file is missing or malformed, or has no matrix of a name; it says which it has.
    """
    path = Path(path)
    if not path.is_file():
        raise CalibrationError(f"{path}: no such calibration file")
    with _opened(path) as storage:
        keys = storage.root().keys() if not storage.root().empty() else []
        for name in names:
            if name not in keys:
                raise CalibrationError(
                    f"{path}: no matrix {name!r}; the file has {', '.join(keys) or 'nothing'}"
                )
        return {name: _matrix(storage, name, path) for name in names}


@contextmanager
def _opened(path: Path) -> Iterator[cv2.FileStorage]:
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        storage.root().keys()
    except (cv2.error, SystemError, UnicodeDecodeError):
        # OpenCV's binding turns errors of its constructor into a bare SystemError.
        raise CalibrationError(f"{path}: not an OpenCV YAML, XML or JSON file") from None
    try:
        yield storage
    finally:
        storage.release()


def _matrix(storage: cv2.FileStorage, name: str, path: Path) -> NDArray[np.float64]:
    try:
        matrix = storage.getNode(name).mat()
    except cv2.error as error:
        raise CalibrationError(f"{path}: {name!r} is not a whole matrix ({error.err})") from None
    if matrix is None or matrix.ndim != 2 or not np.isfinite(matrix).all():
        raise CalibrationError(f"{path}: {name!r} is not a matrix of finite numbers")
    return np.asarray(matrix, dtype=np.float64)


def write_matrices(path: Path, matrices: dict[str, NDArray[np.float64]]) -> None:
    """Write matrices by name; YAML or XML by the file's suffix."""
    with file_in_progress(Path(path)) as temporary:
        storage = cv2.FileStorage(str(temporary), cv2.FILE_STORAGE_WRITE)
        for name, matrix in matrices.items():
            storage.write(name, np.atleast_2d(np.asarray(matrix, dtype=np.float64)))
        storage.release()


def read_rig_geometry(
    path: Path, names: CalibrationDescription, *, camera: Imager, projector: Imager
) -> RigGeometry:
    """Read camera, projector and their pose from an OpenCV file.

    Parameters
    ----------
    path : Path
        The file.
    names : CalibrationDescription
        What its matrices are called, and which way the pose goes.
    camera, projector : Imager
        Sizes of sensor and panel.

    Raises
    ------
    CalibrationError
        The file is unreadable, a matrix is missing or has the wrong shape, or the rotation is
        none.
    """
    fields = ("camera_matrix", "camera_distortion", "projector_matrix", "projector_distortion")
    wanted = [getattr(names, field) for field in (*fields, "rotation", "translation")]
    matrices = read_matrices(path, wanted)
    rotation = matrices[names.rotation]
    translation = matrices[names.translation]
    if rotation.size == 3:
        rotation = np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64)
    if rotation.shape != (3, 3) or translation.size != 3:
        raise CalibrationError(f"{path}: rotation and translation are {rotation.shape} and "
                               f"{translation.shape}, not 3×3 and 3×1")  # fmt: skip
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4 or np.linalg.det(rotation) < 0:
        raise CalibrationError(f"{path}: {names.rotation!r} is not a rotation")
    # Files in single precision hold rotations that are orthogonal to seven digits only.
    left, _, right = np.linalg.svd(rotation)
    pose = rt_from_matrix(left @ right, translation.ravel())
    if names.pose is Direction.PROJECTOR_TO_CAMERA:
        pose = invert(pose)
    try:
        lenses = [
            Lens.from_opencv(
                matrices[matrix], matrices[distortion], width=size.width, height=size.height
            )
            for matrix, distortion, size in (
                (names.camera_matrix, names.camera_distortion, camera),
                (names.projector_matrix, names.projector_distortion, projector),
            )
        ]
        return RigGeometry(lenses[0], lenses[1], pose)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None
