"""Photographs under distant lights of which only directions are known: ``.lp`` files.

The object is taken for flat, the camera for one far away before it, a pixel for a texel. Distant
lamps and a distant camera are lamps and cameras like others, so all else is the same code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from acquisition.png_chunks import readable_png
from calibration.lamp import Lamp
from calibration.lens import Lens, rt_from_matrix
from calibration.light_directions import read_lp
from fitting.digital_copy import DigitalCopy
from fitting.errors import FittingError
from fitting.height_field import HeightField
from fitting.reflectance.photographs import Photograph
from fitting.reflectance.scratch_pictures import ScratchPictures
from fitting.relief import Relief, ReliefBoxes

Singles = NDArray[np.float32]

_FAR_MM = 1e7
# Variance of pictures: of rounding, and of photons at some 20 000 per full scale.
_PHOTONS = 5e-5
_BLACK_SIGMA = 2e-4  # of what is black, full scale being 1
# Full scale, and the standard error of what is black.
_WHOLE_NUMBERS = {
    np.dtype(np.uint8): (255.0, 1 / 255),
    np.dtype(np.uint16): (65535.0, _BLACK_SIGMA),
}
# Pictures of floating point have no full scale: it is where the brightest of them is white.
_WHITE_PERCENTILE = 99.9
_SLOPE_SIGMA = 0.2  # of a relief that nobody measured


@dataclass(frozen=True)
class _Picture:
    """Linear RGB, NaN where a channel is saturated.

    Attributes
    ----------
    radiance : (rows, cols, 3) array
    variance : array of that shape, or None
        None of floating point: it goes by the scale of all pictures.
    grey : bool
        Whether the three channels are one.
    """

    radiance: Singles
    variance: Singles | None
    grey: bool


def read_light_only(
    path: Path, *, pitch_mm: float = 1.0, linear: bool = False
) -> tuple[DigitalCopy, list[Photograph]]:
    """Read an ``.lp`` file and its pictures, which lie beside it or below.

    Parameters
    ----------
    path : Path
    pitch_mm : float
        Size of a pixel on the object.
    linear : bool
        Whether 8-bit pictures hold linear values; by default they are sRGB's. Pictures of 16 bits
        and of floating point always do.

    Returns
    -------
    copy : DigitalCopy
        Flat, without reflectance; row 0 at the top of the pictures.
    photographs : list of Photograph

    Raises
    ------
    CalibrationError
        The file is malformed, or a picture is missing.
    FittingError
        A picture cannot be read, or they differ in size.
    """
    path = Path(path)
    lights = read_lp(path, pictures=path.parent)
    first: tuple[int, ...] = ()
    with TemporaryFile(prefix="impasto-pictures-") as file:
        pictures = ScratchPictures(file)
        planes: list[tuple[int, int]] = []
        floating: dict[int, bool] = {}
        white = 0.0
        for number, name in enumerate(lights.pictures):
            picture = _read_picture(path.parent / name, linear=linear)
            shape = picture.radiance.shape
            first = first or shape
            if shape != first:
                raise FittingError(
                    f"{path.parent / name} has {shape[1]} × {shape[0]} pixels, "
                    f"the first picture {first[1]} × {first[0]}: they must show the same"
                )
            own = pictures.append(picture.radiance)
            if picture.variance is not None:
                planes.append((own, pictures.append(picture.variance)))
            else:
                planes.append((own, own))
                floating[number] = picture.grey
                white = max(white, _white_of(picture.radiance))
        for number, grey in floating.items():
            own = planes[number][0]
            variance = _variance_of_floating(pictures.mapped()[own], white, grey=grey)
            planes[number] = (own, pictures.append(variance))
        every = pictures.mapped()
    photographs = [
        _distant(name, every[own], every[noise], direction, pitch_mm)
        for name, (own, noise), direction in zip(
            lights.pictures, planes, lights.directions, strict=True
        )
    ]
    return _flat_copy(first[0], first[1], pitch_mm), photographs


def _distant(
    name: str, radiance: Singles, variance: Singles, towards: NDArray[np.float64], pitch_mm: float
) -> Photograph:
    rows, cols = radiance.shape[:2]
    focal = _FAR_MM / pitch_mm
    intrinsics = np.array([focal, focal, (cols - 1) / 2, (rows - 1) / 2])
    facing = np.diag([1.0, -1.0, -1.0])
    # White that faces the light has radiance 1: pictures of this kind have no other scale.
    intensity = np.full(3, math.pi * _FAR_MM**2)
    return Photograph(
        name=name,
        radiance=radiance,
        variance=variance,
        lens=Lens("LENSMODEL_PINHOLE", intrinsics, cols, rows),
        rt_cam_canvas=rt_from_matrix(facing, np.array([0.0, 0.0, _FAR_MM])),
        lamp=Lamp(_FAR_MM * towards, -towards, intensity, 0.0),
    )


def _decoded(path: Path) -> NDArray[Any] | None:
    """The samples of a picture's file, in OpenCV's order of channels; None if it is not whole."""
    try:
        content = readable_png(path.read_bytes())
        coded = np.frombuffer(content or b"", np.uint8)
        return cv2.imdecode(coded, cv2.IMREAD_UNCHANGED) if content else None
    except OSError as error:
        raise FittingError(f"{path}: {error.strerror}") from None
    except cv2.error as error:  # of a size beyond all sense, for one
        raise FittingError(f"{path}: not a readable picture ({error.err})") from None


def _read_picture(path: Path, *, linear: bool) -> _Picture:
    """A picture and its variance.

    Grey pictures have three equal channels, whose variance is tripled: together they say no more
    than one.
    """
    picture = _decoded(path)
    if picture is None:
        raise FittingError(f"{path}: not a readable picture")
    grey = picture.ndim == 2
    if grey:
        picture = np.repeat(picture[..., np.newaxis], 3, axis=2)
    picture = picture[..., 2::-1]
    if picture.dtype == np.float32:
        radiance = picture.astype(np.float32)
        radiance[~np.isfinite(radiance).all(axis=2)] = np.nan
        return _Picture(radiance, None, grey)
    if picture.dtype not in _WHOLE_NUMBERS:
        raise FittingError(f"{path}: pictures of {picture.dtype} are not read")
    full, sigma = _WHOLE_NUMBERS[picture.dtype]
    radiance = picture.astype(np.float32) / np.float32(full)
    slope: Singles | float = 1.0
    if picture.dtype == np.uint8 and not linear:
        coded = radiance
        radiance = np.where(
            coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4
        ).astype(np.float32)
        slope = np.where(
            coded <= 0.04045, 1 / 12.92, 2.4 / 1.055 * ((coded + 0.055) / 1.055) ** 1.4
        ).astype(np.float32)
    variance = (sigma * slope) ** 2 + np.float32(_PHOTONS) * np.maximum(radiance, 0)
    radiance[(picture >= full).any(axis=2)] = np.nan
    return _Picture(radiance, (3.0 * variance if grey else variance).astype(np.float32), grey)


def _white_of(radiance: Singles) -> float:
    """Radiance that all but the brightest thousandth of a picture stay below."""
    finite = radiance[np.isfinite(radiance)]
    return float(np.percentile(finite, _WHITE_PERCENTILE)) if finite.size else 0.0


def _variance_of_floating(radiance: Singles, white: float, *, grey: bool) -> Singles:
    """Variance of what a picture of floating point holds, ``white`` being full scale."""
    unit = white if white > 0.0 else 1.0
    variance = (_BLACK_SIGMA * unit) ** 2 + _PHOTONS * unit * np.fmax(radiance, 0.0)
    return np.asarray(3.0 * variance if grey else variance, np.float32)


def _flat_copy(rows: int, cols: int, pitch_mm: float) -> DigitalCopy:
    shape = (rows, cols)
    origin = (-(cols - 1) / 2 * pitch_mm, (rows - 1) / 2 * pitch_mm)
    zeros = np.zeros(shape, np.float32)
    variance = np.full(shape, (0.01 * pitch_mm) ** 2, np.float32)
    pose = rt_from_matrix(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, _FAR_MM]))
    field = HeightField(zeros, np.ones(shape, np.bool_), variance, pitch_mm, origin, pose)
    none = np.zeros((0, 2), np.int32)
    boxes = ReliefBoxes(none, none, np.zeros(0, np.float32), none)
    return DigitalCopy(
        field,
        np.zeros((*shape, 2), np.float32),
        Relief(0.0, 20, np.zeros(shape, np.bool_), boxes),
        np.full(shape, _SLOPE_SIGMA, np.float32),
        provenance={"source": "pictures under distant lights; no relief was measured"},
    )
