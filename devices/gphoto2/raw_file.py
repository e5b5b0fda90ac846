"""Raw files of cameras as the sensor's numbers, through LibRaw."""

from __future__ import annotations

import io
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from devices.bayer import BayerPattern
from devices.errors import DeviceError
from devices.optional_packages import import_optional

_JPEG = b"\xff\xd8\xff"


@dataclass(frozen=True)
class RawPicture:
    """What a raw file holds.

    Attributes
    ----------
    image : (rows, cols) uint16 array
        The visible part of the sensor; nothing is subtracted, scaled or interpolated.
    bayer : BayerPattern or None
        None for a monochrome sensor.
    black_levels : tuple of int
        Number of a sample without light, for red, green, blue and the second green.
    white_level : int
        Number at which samples are saturated, as LibRaw knows the model.
    """

    image: NDArray[np.uint16] = field(repr=False)
    bayer: BayerPattern | None
    black_levels: tuple[int, ...]
    white_level: int


def is_jpeg(data: bytes) -> bool:
    """Whether a file is a JPEG, whatever its name says."""
    return data.startswith(_JPEG)


def decode_raw(data: bytes, *, name: str) -> RawPicture:
    """Sensor numbers of a raw file.

    Parameters
    ----------
    data : bytes
        The file.
    name : str
        What to call it in messages.

    Raises
    ------
    MissingPackageError
        ``rawpy`` is not installed.
    DeviceError
        It is a JPEG, cut off, of an unknown camera, or holds no mosaic of two by two colours.
    """
    rawpy = import_optional(
        "rawpy", needed_by="a tethered camera", install=".venv/bin/pip install rawpy"
    )
    if is_jpeg(data):
        raise DeviceError(f"{name} is a JPEG, which cannot be measured with; set the camera to raw")
    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            flat = raw.raw_type == rawpy.RawType.Flat
            # Arrays point into the file, which is closed on the way out.
            image = np.array(raw.raw_image_visible, np.uint16) if flat else None
            colours = np.array(raw.raw_colors_visible[:2, :2]) if flat else None
            pattern = raw.raw_pattern
            names = raw.color_desc.decode()
            colour_count = raw.num_colors
            blacks = tuple(int(level) for level in raw.black_level_per_channel)
            white = int(raw.white_level)
    except rawpy.LibRawError as error:
        text = error.args[0] if error.args else error
        text = text.decode(errors="replace") if isinstance(text, bytes) else text
        raise DeviceError(
            f"{name} ({len(data)} bytes) cannot be decoded: {text}; the file is cut off, or this "
            "version of LibRaw does not know the camera"
        ) from None
    if image is None or colours is None:
        raise DeviceError(
            f"{name} holds processed pixels instead of the sensor's; set full raw, not sRAW or mRAW"
        )
    bayer = None
    if colour_count > 1:
        letters = "".join(names[colour] for colour in colours.ravel())
        if pattern is None or pattern.shape != (2, 2) or letters not in list(BayerPattern):
            raise DeviceError(
                f"{name}: the sensor's mosaic is no Bayer pattern (first colours {letters}), which "
                "is not understood; use another camera"
            )
        bayer = BayerPattern(letters)
    return RawPicture(image, bayer, blacks, white)
