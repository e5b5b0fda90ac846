"""Lens models, which are mrcal's.

A lens maps directions to pixels. Directions are points in the camera frame (x right, y down,
z forward), pixels are (column, row) with (0, 0) at the centre of the first pixel. A projector is a
camera that emits: the same model, with the panel as the sensor.

Lenses of OpenCV's family go through the kernels of :mod:`calibration.lens_kernels`, all others
through mrcal, whose models are the reference for both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import mrcal
import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.lens_kernels import PARAMETERS, project_points, unproject_grid, unproject_pixels

OPENCV_MODELS = {
    0: "LENSMODEL_PINHOLE",
    4: "LENSMODEL_OPENCV4",
    5: "LENSMODEL_OPENCV5",
    8: "LENSMODEL_OPENCV8",
    12: "LENSMODEL_OPENCV12",
}


def check_lens_model(model: str) -> None:
    """Refuse a name that is none of a lens model that can be solved for.

    Raises
    ------
    CalibrationError
    """
    try:
        usable = mrcal.lensmodel_metadata_and_config(model)["has_gradients"]
    except RuntimeError:
        usable = False
    if not usable:
        names = [name.removeprefix("LENSMODEL_") for name in mrcal.supported_lensmodels()]
        raise CalibrationError(
            f"{model} is no lens model that can be solved for; there are {', '.join(names)}"
        )


@dataclass(frozen=True)
class Lens:
    """A lens model with its parameters.

    Attributes
    ----------
    model : str
        mrcal's name of the model, ``LENSMODEL_OPENCV5`` say.
    intrinsics : (n,) float64 array
        f_x, f_y, c_x, c_y in pixels, then the distortion.
    width, height : int
        Imager size in pixels.
    """

    model: str
    intrinsics: NDArray[np.float64]
    width: int
    height: int

    def __post_init__(self) -> None:
        expected = mrcal.lensmodel_num_params(self.model)
        if self.intrinsics.shape != (expected,):
            raise CalibrationError(
                f"{self.model} takes {expected} parameters, not {self.intrinsics.shape}"
            )
        if not np.isfinite(self.intrinsics).all():
            raise CalibrationError(f"{self.model} has parameters that are not finite")
        if (self.intrinsics[:2] <= 0).any():
            raise CalibrationError(
                f"focal lengths must be positive, not {self.intrinsics[:2].tolist()} px"
            )

    @classmethod
    def from_opencv(
        cls,
        camera_matrix: NDArray[np.float64],
        distortion: NDArray[np.float64],
        *,
        width: int,
        height: int,
    ) -> Lens:
        """Make a lens from OpenCV's matrix and distortion vector.

        Parameters
        ----------
        camera_matrix : (3, 3) array
            OpenCV's camera matrix; skew must be zero.
        distortion : (n,) array
            k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4]]]; n is 0, 4, 5, 8 or 12.

        Raises
        ------
        CalibrationError
            A shape that OpenCV does not know, or a skewed matrix.
        """
        matrix = np.asarray(camera_matrix, dtype=np.float64)
        coefficients = np.asarray(distortion, dtype=np.float64).ravel()
        if matrix.shape != (3, 3):
            raise CalibrationError(f"a camera matrix is 3×3, not {matrix.shape}")
        if abs(matrix[0, 1]) > 1e-9 * abs(matrix[0, 0]):
            raise CalibrationError("camera matrices with skew are not supported")
        if coefficients.size not in OPENCV_MODELS:
            raise CalibrationError(
                f"{coefficients.size} distortion coefficients; OpenCV's models have "
                f"{sorted(OPENCV_MODELS)}"
            )
        core = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        return cls(
            OPENCV_MODELS[coefficients.size],
            np.concatenate([core, coefficients]),
            width=int(width),
            height=int(height),
        )

    @property
    def focal_px(self) -> NDArray[np.float64]:
        """f_x and f_y in pixels, (2,)."""
        return self.intrinsics[:2]

    @property
    def opencv_parameters(self) -> NDArray[np.float64] | None:
        """The lens as :mod:`calibration.lens_kernels` takes it; None for another family.

        Returns
        -------
        (16,) float64 array or None
        """
        return _opencv_parameters(self.model, self.intrinsics)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels at which points in the camera frame are seen.

        Parameters
        ----------
        points : (..., 3) array
            Points in the lens's frame, z > 0.

        Returns
        -------
        (..., 2) float64 array
        """
        return self.project_with_gradient(points)[0]

    def project_with_gradient(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels of points, and their derivative by the point.

        Returns
        -------
        pixels : (..., 2) float64 array
        gradient : (..., 2, 3) float64 array
            ``d pixel / d point``.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        lens = self.opencv_parameters
        if lens is None:
            pixels, gradient, _ = mrcal.project(points, *self._mrcal_lens, get_gradients=True)
            return pixels, gradient
        shape = points.shape[:-1]
        pixels, gradient = project_points(lens, points.reshape(-1, 3))
        return pixels.reshape(*shape, 2), gradient.reshape(*shape, 2, 3)

    def unproject(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Viewing rays of pixels.

        Parameters
        ----------
        pixels : (..., 2) array
            Pixels.

        Returns
        -------
        (..., 3) float64 array
            Directions scaled to z = 1; NaN where the model has no inverse.
        """
        pixels = np.ascontiguousarray(pixels, dtype=np.float64)
        lens = self.opencv_parameters
        if lens is None:
            rays = np.asarray(mrcal.unproject(pixels, *self._mrcal_lens))
            return rays / rays[..., 2:]
        rays = np.ones((*pixels.shape[:-1], 3))
        rays[..., :2] = unproject_pixels(lens, pixels.reshape(-1, 2)).reshape(pixels.shape)
        return rays

    def pixel_slopes(
        self, *, origin: tuple[int, int], shape: tuple[int, int]
    ) -> NDArray[np.float64]:
        """Viewing rays of every pixel of a crop; those of the last crop asked for are kept.

        Parameters
        ----------
        origin : (int, int)
            Column and row of the crop's first pixel in the full frame.
        shape : (int, int)
            Rows and columns of the crop.

        Returns
        -------
        (rows, cols, 2) float64 array
            x/z and y/z of the rays; read-only.
        """
        column, row = origin
        return _pixel_slopes(self.model, self.intrinsics.tobytes(), (column, row), shape)

    def save(self, path: Path, *, rt_this_ref: NDArray[np.float64] | None = None) -> None:
        """Write a mrcal ``.cameramodel`` file; ``rt_this_ref`` is the lens's pose."""
        pose = np.zeros(6) if rt_this_ref is None else np.array(rt_this_ref, dtype=np.float64)
        model = mrcal.cameramodel(
            intrinsics=self._mrcal_lens, imagersize=np.array([self.width, self.height])
        )
        _pose_accessor(model)(pose)
        model.write(str(path))

    @classmethod
    def load(cls, path: Path) -> tuple[Lens, NDArray[np.float64]]:
        """Read a mrcal ``.cameramodel`` file.

        Returns
        -------
        lens : Lens
        rt_this_ref : (6,) float64 array
            The pose stored with it.

        Raises
        ------
        CalibrationError
            The file is missing or not a camera model.
        """
        try:
            model = mrcal.cameramodel(str(path))
            name, intrinsics = model.intrinsics()
            width, height = model.imagersize()
            pose = _pose_accessor(model)()
        except Exception as error:  # mrcal raises bare Exceptions of its own
            raise CalibrationError(f"{path}: not a readable camera model ({error})") from error
        lens = cls(name, np.array(intrinsics, dtype=np.float64), int(width), int(height))
        return lens, np.array(pose, dtype=np.float64)

    @property
    def _mrcal_lens(self) -> tuple[str, NDArray[np.float64]]:
        return self.model, self.intrinsics


def _opencv_parameters(model: str, intrinsics: NDArray[np.float64]) -> NDArray[np.float64] | None:
    if model not in OPENCV_MODELS.values():
        return None
    parameters = np.zeros(PARAMETERS)
    parameters[: len(intrinsics)] = intrinsics
    return parameters


@lru_cache(maxsize=1)
def _pixel_slopes(
    model: str, intrinsics: bytes, origin: tuple[int, int], shape: tuple[int, int]
) -> NDArray[np.float64]:
    rows, cols = shape
    numbers = np.frombuffer(intrinsics)
    lens = _opencv_parameters(model, numbers)
    if lens is None:
        col, row = np.meshgrid(np.arange(cols) + origin[0], np.arange(rows) + origin[1])
        rays = mrcal.unproject(np.stack([col, row], axis=-1).astype(np.float64), model, numbers)
        slopes = np.ascontiguousarray(rays[..., :2] / rays[..., 2:])
    else:
        slopes = unproject_grid(lens, origin[0], origin[1], cols, rows)
    slopes.setflags(write=False)
    return slopes


def _pose_accessor(model: mrcal.cameramodel) -> Callable[..., NDArray[np.float64]]:
    """The method that reads or sets a model's pose; mrcal 2.5 renamed it."""
    return getattr(model, "rt_cam_ref", None) or model.extrinsics_rt_fromref


def rt_from_matrix(
    rotation: NDArray[np.float64], translation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rodrigues pose (6,) of a rotation matrix (3, 3) and a translation (3,).

    By way of the quaternion (Shepperd, J. Guidance and Control 1, 1978), which is exact for half
    turns too: a canvas that faces the camera is one, and ``mrcal.r_from_R`` takes it for none.
    """
    matrix = np.asarray(rotation, dtype=np.float64)
    trace = np.trace(matrix)
    # Four times the products of the quaternion (w, x, y, z) with each of its elements in turn.
    products = np.empty((4, 4))
    products[0, 0] = 1 + trace
    products[1:, 1:] = matrix + matrix.T + (1 - trace) * np.eye(3)
    odd = matrix - matrix.T
    products[0, 1:] = products[1:, 0] = odd[2, 1], odd[0, 2], odd[1, 0]
    quaternion = products[np.argmax(np.diagonal(products))]
    quaternion = quaternion / np.linalg.norm(quaternion)
    if quaternion[0] < 0:
        quaternion = -quaternion
    sine = np.linalg.norm(quaternion[1:])
    angle = 2 * np.arctan2(sine, quaternion[0])
    scale = angle / sine if sine > 0 else 2.0
    return np.concatenate([scale * quaternion[1:], np.ravel(translation)])


def compose(rt_a_b: NDArray[np.float64], rt_b_c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pose ``rt_a_c`` of ``rt_a_b`` after ``rt_b_c``, (6,) each; never more than half a turn."""
    composed = np.array(mrcal.compose_rt(rt_a_b, rt_b_c))
    # Between cameras that stand head down to one another mrcal goes the long way round: their
    # difference, however small, would be nearly a whole turn.
    angle = np.linalg.norm(composed[:3])
    if angle > np.pi:
        composed[:3] *= 1 - 2 * np.pi / angle
    return composed


def invert(rt_a_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pose ``rt_b_a`` of ``rt_a_b``, (6,)."""
    return np.asarray(mrcal.invert_rt(rt_a_b))


def rotation(rt_a_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) of a pose (6,)."""
    return np.asarray(mrcal.R_from_r(rt_a_b[:3]))


def transform(rt_a_b: NDArray[np.float64], points_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (..., 3) of frame b in frame a."""
    return np.asarray(points_b @ rotation(rt_a_b).T + rt_a_b[3:])
