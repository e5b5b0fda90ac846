"""Foreign captures: fringe scans made by other software, described by a short ``capture.toml``.

The description says which file is which pattern, so nobody has to rename files; see
``docs/file-formats.md`` and the examples in ``fixtures/captures``.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from acquisition.errors import CaptureError
from acquisition.frame_files import Samples
from acquisition.patterns import BLACK, WHITE, Axis, Gray, PhaseShift, Uniform
from acquisition.plan import Crop, Imager, Plan, PlannedFrame
from acquisition.session_writer import SessionWriter


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Direction(StrEnum):
    """Which way the stored pose goes."""

    CAMERA_TO_PROJECTOR = "camera to projector"
    PROJECTOR_TO_CAMERA = "projector to camera"


class CalibrationDescription(_Part):
    """Where a foreign calibration lies, and the names of its matrices.

    ``file`` is relative to the capture's folder. ``pose`` says which frame's points rotation and
    translation take to which.
    """

    file: str
    camera_matrix: str
    camera_distortion: str
    projector_matrix: str
    projector_distortion: str
    rotation: str
    translation: str
    pose: Direction = Direction.CAMERA_TO_PROJECTOR


class CropDescription(_Part):
    """Where cropped files lie in the full frame.

    Either ``column`` and ``row`` of their first pixel, or ``file``: a JSON file with
    ``[x0, y0, x1, y1]``, or with one such list per folder of captures.
    """

    column: int = Field(default=0, ge=0)
    row: int = Field(default=0, ge=0)
    file: str | None = None


class PhaseShiftGroup(_Part):
    """Files of one phase-shifted fringe, in the order of ``shifts_rad``.

    Without ``shifts_rad`` the steps are spread evenly over a period, rising or (``falling``)
    falling. One of ``periods`` (over the whole panel) and ``period_px`` is given.
    """

    axis: Axis
    files: tuple[str, ...] = Field(min_length=3)
    periods: float | None = Field(default=None, gt=0)
    period_px: float | None = Field(default=None, gt=0)
    shifts_rad: tuple[float, ...] | None = None
    falling: bool = False
    origin_rad: float = 0.0
    gamma: float = Field(default=1.0, gt=0)

    @model_validator(mode="after")
    def _consistent(self) -> PhaseShiftGroup:
        if (self.periods is None) == (self.period_px is None):
            raise ValueError("give either periods or period_px")
        if self.shifts_rad is not None and len(self.shifts_rad) != len(self.files):
            raise ValueError(f"{len(self.files)} files but {len(self.shifts_rad)} shifts_rad")
        return self


class GrayGroup(_Part):
    """Files of one Gray code, most significant bit first, and of its inverse if there is one."""

    axis: Axis
    files: tuple[str, ...] = Field(min_length=1)
    step_px: float = Field(gt=0)
    offset: float = 0.0
    threshold: Literal["phase-shift mean", "inverse"] = "phase-shift mean"
    inverse_files: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> GrayGroup:
        if (self.threshold == "inverse") != bool(self.inverse_files):
            raise ValueError('inverse_files go with threshold = "inverse"')
        if self.inverse_files and len(self.inverse_files) != len(self.files):
            raise ValueError(f"{len(self.files)} files, {len(self.inverse_files)} inverse_files")
        return self


class CaptureDescription(_Part):
    """Everything a ``capture.toml`` says."""

    name: str
    camera: Imager
    projector: Imager
    saturation_level: int = Field(gt=0, le=65535)
    crop: CropDescription = CropDescription()
    phase_shift: tuple[PhaseShiftGroup, ...] = ()
    gray: tuple[GrayGroup, ...] = ()
    white: str | None = None
    black: str | None = None
    calibration: CalibrationDescription | None = None


@dataclass(frozen=True)
class ForeignCapture:
    """A capture found on disk, ready to be recorded as a session.

    Attributes
    ----------
    folder : Path
        Where its files are.
    description : CaptureDescription
    plan : Plan
    files : dict
        File by frame id.
    """

    folder: Path
    description: CaptureDescription
    plan: Plan
    files: dict[str, Path]


def read_description(path: Path) -> CaptureDescription:
    """Read a ``capture.toml``.

    Raises
    ------
    CaptureError
        The file is missing or not TOML, or a key is missing, unknown or wrong; it is named.
    """
    try:
        content = tomllib.loads(Path(path).read_text())
    except FileNotFoundError:
        raise CaptureError(f"{path}: no such capture description") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path}: not TOML ({error})") from None
    try:
        return CaptureDescription.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "the file"
        raise CaptureError(f"{path}: {key}: {first['msg']}") from None


def find_capture(folder: Path, description: CaptureDescription) -> ForeignCapture:
    """Find the files of a capture and plan its session.

    Raises
    ------
    CaptureError
        A file is missing or unreadable, or the crop does not fit.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder of captured files")
    patterns = _patterns(description)
    missing = [name for _, name in patterns if not (folder / name).is_file()]
    if missing:
        raise CaptureError(
            f"{folder / missing[0]} is missing ({len(missing)} of {len(patterns)} files); check "
            "the folder, and the names in the capture description"
        )
    if not patterns:
        raise CaptureError("the capture description names no files")
    frames = tuple(
        PlannedFrame(id=f"{number:04d}", pattern=pattern)
        for number, (pattern, _) in enumerate(patterns)
    )
    files = {f.id: folder / name for f, (_, name) in zip(frames, patterns, strict=True)}
    height, width = read_picture(files[frames[0].id]).shape
    column, row = _crop_corner(folder, description, width=width, height=height)
    try:
        plan = Plan(
            camera=description.camera,
            projector=description.projector,
            crop=Crop(column=column, row=row, width=width, height=height),
            saturation_level=description.saturation_level,
            frames=frames,
            source=description.name,
        )
    except ValidationError as error:
        raise CaptureError(
            f"{folder}: files of {width}×{height} at column {column}, row {row} of a "
            f"{description.camera.width}×{description.camera.height} camera: "
            f"{error.errors()[0]['msg']}"
        ) from None
    return ForeignCapture(folder, description, plan, files)


def record_capture(
    capture: ForeignCapture,
    out: Path,
    *,
    calibration: Path | None = None,
    advance: Callable[[str], None] | None = None,
) -> None:
    """Write a foreign capture as a finished session.

    Parameters
    ----------
    capture : ForeignCapture
        From :func:`find_capture`.
    out : Path
        Session folder to make.
    calibration : Path, optional
        Folder of the rig's calibration, copied into the session.
    advance : callable, optional
        Called with each frame id once it is recorded.

    Raises
    ------
    CaptureError
        A file cannot be read or has another size than the first.
    """
    expected = (capture.plan.crop.height, capture.plan.crop.width)
    with SessionWriter.create(out, capture.plan, calibration=calibration) as writer:
        for number, (frame_id, file) in enumerate(capture.files.items()):
            image = read_picture(file)
            if image.shape != expected:
                raise CaptureError(
                    f"{file} is {image.shape[1]}×{image.shape[0]}, the first file is "
                    f"{expected[1]}×{expected[0]}: all files of a capture have one size"
                )
            writer.record(frame_id, image, sequence=number)
            if advance is not None:
                advance(frame_id)
        writer.finish()


def read_picture(path: Path) -> Samples:
    """Sensor numbers of a grey picture of any format that OpenCV reads losslessly.

    Raises
    ------
    CaptureError
        The file cannot be read, is in colour, or is neither 8 nor 16 bit.
    """
    try:
        content = np.fromfile(path, np.uint8)
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}") from None
    image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    if image is None:
        raise CaptureError(f"{path}: truncated, or not a picture")
    if image.ndim == 3:
        if not (image[..., :1] == image[..., :3]).all():
            raise CaptureError(f"{path}: a colour picture; fringes are decoded from grey ones")
        image = np.ascontiguousarray(image[..., 0])
    if image.dtype not in (np.uint8, np.uint16):
        raise CaptureError(f"{path}: {image.dtype} samples; 8 or 16 bit are read")
    return image  # type: ignore[return-value]


def _patterns(
    description: CaptureDescription,
) -> list[tuple[PhaseShift | Gray | Uniform, str]]:
    patterns: list[tuple[PhaseShift | Gray | Uniform, str]] = []
    panel = {Axis.COLUMN: description.projector.width, Axis.ROW: description.projector.height}
    for group in description.phase_shift:
        period = group.period_px or panel[group.axis] / float(group.periods or 1)
        sign = -1 if group.falling else 1
        even = [sign * 2 * math.pi * k / len(group.files) for k in range(len(group.files))]
        for name, shift in zip(group.files, group.shifts_rad or even, strict=True):
            step = PhaseShift(
                axis=group.axis,
                period_px=period,
                shift_rad=shift,
                origin_rad=group.origin_rad,
                gamma=group.gamma,
            )
            patterns.append((step, name))
    for code in description.gray:
        for inverse, names in ((False, code.files), (True, code.inverse_files)):
            for bit, name in enumerate(names):
                pattern = Gray(
                    axis=code.axis,
                    bit=bit,
                    bits=len(code.files),
                    step_px=code.step_px,
                    offset=code.offset,
                    inverse=inverse,
                )
                patterns.append((pattern, name))
    flats = ((WHITE, description.white), (BLACK, description.black))
    patterns.extend((pattern, name) for pattern, name in flats if name is not None)
    return patterns


def _crop_corner(
    folder: Path, description: CaptureDescription, *, width: int, height: int
) -> tuple[int, int]:
    crop = description.crop
    if crop.file is None:
        return crop.column, crop.row
    path = folder / crop.file
    try:
        content = json.loads(path.read_text())
        box = content[folder.resolve().name] if isinstance(content, dict) else content
        x0, y0, x1, y1 = (int(value) for value in box)
    except FileNotFoundError:
        raise CaptureError(f"{path}: no such crop file") from None
    except KeyError:
        raise CaptureError(f"{path}: no crop for {folder.resolve().name}") from None
    except (ValueError, TypeError):
        raise CaptureError(f"{path}: a crop is four numbers x0, y0, x1, y1") from None
    if (x1 - x0, y1 - y0) != (width, height):
        raise CaptureError(
            f"{path}: the crop is {x1 - x0}×{y1 - y0}, the files are {width}×{height}"
        )
    return x0, y0
