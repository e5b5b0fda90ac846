"""Which pictures of a VideoCapture are raw samples, and how they come out of it.

Four-letter codes of raw formats: ``linux/videodev2.h``. Formats that OpenCV does not know it hands
out as one long row of bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from devices.bayer import BayerPattern
from devices.errors import DeviceError
from devices.opencv.settings import Channel


@dataclass(frozen=True)
class RawFormat:
    """One sample per pixel, each in bytes of its own, least significant first."""

    bits: int
    bayer: BayerPattern | None = None


_MOSAICS = {
    BayerPattern.BGGR: ("BA81", "BG10", "BG12", "BYR2"),
    BayerPattern.GBRG: ("GBRG", "GB10", "GB12", "GB16"),
    BayerPattern.GRBG: ("GRBG", "BA10", "BA12", "GR16"),
    BayerPattern.RGGB: ("RGGB", "RG10", "RG12", "RG16"),
}
RAW_FORMATS = {
    "GREY": RawFormat(8),
    "Y10": RawFormat(10),
    "Y12": RawFormat(12),
    "Y14": RawFormat(14),
    "Y16": RawFormat(16),
} | {
    name: RawFormat(bits, bayer)
    for bayer, names in _MOSAICS.items()
    for bits, name in zip((8, 10, 12, 16), names, strict=True)
}
"""By their four letters, less spaces at the end."""

# Codecs and files that give back what went in.
_LOSSLESS_CODECS = {"FFV1", "HFYU", "FFVH", "MPNG", "Y800", "Y8", "RAW", ""}
_LOSSLESS_SUFFIXES = {".png", ".tif", ".tiff", ".pgm", ".ppm", ".pnm", ".bmp"}
# Converted by the camera, but not compressed.
_CONVERTED = {"YUYV", "UYVY", "YUY2", "NV12", "NV21", "YU12", "I420", "YV12", "BGR3", "RGB3"}
# Grey of 8 and of 16 bits, as FFmpeg tags raw video.
_GREY_PIXELS = {"Y800", "Y8", "GREY", "Y1\0\x10"}
_CHANNELS = {Channel.BLUE: 0, Channel.GREEN: 1, Channel.RED: 2}


def code_name(code: float) -> str:
    """Four letters of ``CAP_PROP_FOURCC``, less zeros and spaces at the end."""
    number = int(code) & 0xFFFFFFFF if code > 0 else 0
    return number.to_bytes(4, "little").decode("ascii", errors="replace").rstrip("\0 ")


def check_lossless(source: int | str, code: str, *, numbered_pictures: bool) -> None:
    """Refuse pictures that went through a compression with losses.

    Parameters
    ----------
    source : int or str
    code : str
        Of :func:`code_name`.
    numbered_pictures : bool
        Whether the source is a series of picture files.

    Raises
    ------
    DeviceError
        It does, or it is not known whether it does; the format is named.
    """
    if numbered_pictures:
        name = Path(str(source)).suffix.casefold()
        fine = name in _LOSSLESS_SUFFIXES
    else:
        name = code
        fine = code.upper() in {*_LOSSLESS_CODECS, *_CONVERTED, *RAW_FORMATS}
    if not fine:
        raise DeviceError(
            f"{source} delivers {name}, which is compressed with losses or unknown; set a raw "
            f"pixel_format ({', '.join(list(RAW_FORMATS)[:6])}, …), or allow_lossy = true if you "
            "want it nevertheless"
        )


def check_grey(source: int | str, pixels: str) -> None:
    """Refuse a video in colours, of which FFmpeg would hand out the brightness and no more.

    Parameters
    ----------
    source : int or str
    pixels : str
        :func:`code_name` of ``CAP_PROP_CODEC_PIXEL_FORMAT``.

    Raises
    ------
    DeviceError
        Its pixels are not 8 or 16 bits of grey.
    """
    if pixels not in _GREY_PIXELS:
        raise DeviceError(
            f"the pixels of {source} are in the colours of {pixels or 'an unknown format'}, not "
            'grey of 8 or 16 bits; set channel = "green" to take one colour nevertheless'
        )


def raw_samples(
    picture: NDArray, code: str, *, size: tuple[int, int], channel: Channel | None
) -> NDArray:
    """Samples of a picture as VideoCapture hands it out.

    Parameters
    ----------
    picture : array
    code : str
        Four letters of its format.
    size : (int, int)
        Width and height that the source tells.
    channel : Channel or None
        Which colour to take of a picture in colours.

    Returns
    -------
    (rows, cols) uint8 or uint16 array

    Raises
    ------
    DeviceError
        It is in colours and no channel was asked for, or not of its size or depth.
    """
    if picture.ndim == 3 and picture.shape[2] == 1:
        picture = picture[..., 0]
    if picture.ndim == 3:
        if channel is None or picture.shape[2] < 3:
            raise DeviceError(
                f"pictures of format {code or 'unknown'} come converted to {picture.shape[2]} "
                'colours, interpolated; set a raw pixel_format, or channel = "green" to take one '
                "colour nevertheless"
            )
        picture = picture[..., _CHANNELS[channel]]
    width, height = size
    raw = RAW_FORMATS.get(code)
    if picture.shape[0] == 1 and height > 1:
        picture = _from_row(picture, code, raw, size)
    if picture.dtype not in (np.uint8, np.uint16):
        raise DeviceError(f"samples of type {picture.dtype} are none of a sensor")
    if width > 0 and height > 0 and picture.shape != (height, width):
        raise DeviceError(
            f"a picture of {picture.shape[1]}×{picture.shape[0]} came where the source tells "
            f"{width}×{height}"
        )
    return np.ascontiguousarray(picture).copy()


def _from_row(picture: NDArray, code: str, raw: RawFormat | None, size: tuple[int, int]) -> NDArray:
    width, height = size
    octets = np.ascontiguousarray(picture).view(np.uint8).ravel()
    depth = np.dtype("<u2" if raw is not None and raw.bits > 8 else "u1")
    if raw is None or octets.size != width * height * depth.itemsize:
        raise DeviceError(
            f"{octets.size} bytes came where {width}×{height} pixels of format "
            f"{code or 'unknown'} were expected; the picture is compressed or cut off"
        )
    return octets.view(depth).astype(depth.newbyteorder("=")).reshape(height, width)
