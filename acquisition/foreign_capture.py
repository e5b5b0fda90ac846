"""Foreign captures: finding the files that a description names, and recording them as a session.

The description is a :class:`~acquisition.capture_description.CaptureDescription`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from acquisition.capture_description import CaptureDescription, Channel
from acquisition.errors import CaptureError
from acquisition.frame_files import Samples
from acquisition.patterns import BLACK, WHITE, Axis, Gray, PhaseShift, Uniform
from acquisition.plan import Crop, Plan, PlannedFrame
from acquisition.png_chunks import readable_png
from acquisition.session_writer import SessionWriter


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
    try:
        patterns = _patterns(description)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise CaptureError(
            f"{folder}: the capture's description makes patterns of no use ({key}: {first['msg']})"
        ) from None
    missing = [name for _, name in patterns if not (folder / name).is_file()]
    if missing:
        raise CaptureError(
            f"{folder / missing[0]} is missing ({len(missing)} of {len(patterns)} files); check "
            "the folder, and the names in the capture description"
        )
    frames = tuple(
        PlannedFrame(id=f"{number:04d}", pattern=pattern)
        for number, (pattern, _) in enumerate(patterns)
    )
    files = {f.id: folder / name for f, (_, name) in zip(frames, patterns, strict=True)}
    height, width = read_picture(files[frames[0].id], channel=description.channel).shape
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
            image = read_picture(file, channel=capture.description.channel)
            if image.shape != expected:
                raise CaptureError(
                    f"{file} is {image.shape[1]}×{image.shape[0]}, the first file is "
                    f"{expected[1]}×{expected[0]}: all files of a capture have one size"
                )
            writer.record(frame_id, image, sequence=number)
            if advance is not None:
                advance(frame_id)
        writer.finish()


def read_picture(path: Path, *, channel: Channel | None = None) -> Samples:
    """Sensor numbers of a picture of any format that OpenCV reads.

    Parameters
    ----------
    path : Path
        The file.
    channel : Channel, optional
        What to take from a picture in colour. Grey ones, also those stored as three equal
        channels, are taken as they are.

    Returns
    -------
    (rows, cols) uint8 or uint16 array

    Raises
    ------
    CaptureError
        The file cannot be read, is neither 8 nor 16 bit, or is in colour and no channel is named.
    """
    try:
        content = readable_png(path.read_bytes())
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}") from None
    try:
        coded = np.frombuffer(content or b"", np.uint8)
        image = cv2.imdecode(coded, cv2.IMREAD_UNCHANGED) if content else None
    except cv2.error as error:
        raise CaptureError(f"{path}: not a picture that can be read ({error.err})") from None
    if image is None:
        raise CaptureError(f"{path}: truncated, or not a picture")
    if image.dtype not in (np.uint8, np.uint16):
        raise CaptureError(f"{path}: {image.dtype} samples; 8 or 16 bit are read")
    if image.ndim == 3:
        image = _grey(image, path, channel)
    return image  # type: ignore[return-value]


def _grey(image: NDArray[Any], path: Path, channel: Channel | None) -> NDArray[Any]:
    """One channel of a picture with several, in OpenCV's order (blue, green, red, alpha)."""
    colours = image[..., :3]
    if (colours == colours[..., :1]).all():
        return np.ascontiguousarray(colours[..., 0])
    if channel is None:
        raise CaptureError(
            f"{path}: a colour picture; say in the capture description which channel = "
            '"red", "green", "blue" or "mean" to take'
        )
    if channel is Channel.MEAN:
        return np.round(colours.mean(axis=2)).astype(image.dtype)
    order = (Channel.BLUE, Channel.GREEN, Channel.RED)
    return np.ascontiguousarray(colours[..., order.index(channel)])


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
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}; it is the crop's file") from None
    except KeyError:
        raise CaptureError(f"{path}: no crop for {folder.resolve().name}") from None
    except (ValueError, TypeError):
        raise CaptureError(f"{path}: a crop is four numbers x0, y0, x1, y1") from None
    if (x1 - x0, y1 - y0) != (width, height):
        raise CaptureError(
            f"{path}: the crop is {x1 - x0}×{y1 - y0}, the files are {width}×{height}"
        )
    return x0, y0
