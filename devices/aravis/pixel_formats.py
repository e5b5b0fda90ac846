"""Pixel formats of GenICam cameras: how samples lie in a buffer, how deep they are, what mosaic.

Names and codes: Pixel Format Naming Convention of the EMVA (PFNC 2.3) and its list of values;
``…Packed`` formats: GigE Vision 2.0, appendix on pixel layouts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from devices.bayer import BayerPattern
from devices.errors import DeviceError


class Packing(Enum):
    """How samples follow one another."""

    NONE = "each in bytes of its own, least significant first"
    GIGE_VISION = "two in three bytes, the low bits of both in the middle one"
    PFNC = "bit after bit, least significant first"


@dataclass(frozen=True)
class PixelFormat:
    """One sample per pixel, as it came from the sensor.

    Attributes
    ----------
    name : str
        As the camera's ``PixelFormat`` has it.
    code : int
        As a buffer has it.
    bits : int
        Of a sample.
    packing : Packing
    bayer : BayerPattern or None
    """

    name: str
    code: int
    bits: int
    packing: Packing = Packing.NONE
    bayer: BayerPattern | None = None

    @property
    def saturation_level(self) -> int:
        """Largest number that a sample can be."""
        return (1 << self.bits) - 1

    @property
    def bits_in_buffer(self) -> int:
        """Bits that a pixel takes up."""
        if self.packing is Packing.NONE:
            return 8 if self.bits <= 8 else 16
        return 12 if self.packing is Packing.GIGE_VISION else self.bits

    def bytes_of(self, pixels: int) -> int:
        """Bytes that so many pixels take up."""
        return -(-pixels * self.bits_in_buffer // 8)

    def decode(self, data: bytes, *, width: int, height: int, row_padding: int = 0) -> NDArray:
        """Samples of a buffer.

        Parameters
        ----------
        data : bytes
        width, height : int
        row_padding : int
            Bytes after each row.

        Returns
        -------
        (height, width) uint8 or uint16 array

        Raises
        ------
        DeviceError
            Too few or too many bytes for the size, padding between packed rows, or a sample above
            the format's largest number.
        """
        if row_padding and self.packing is not Packing.NONE:
            raise DeviceError(
                f"{self.name} with {row_padding} bytes of padding between rows is not understood; "
                "set an unpacked pixel_format"
            )
        row = self.bytes_of(width) if row_padding else 0
        expected = (row + row_padding) * height if row else self.bytes_of(width * height)
        if len(data) != expected:
            raise DeviceError(
                f"the camera sent {len(data)} bytes where {width}×{height} pixels of {self.name} "
                f"take {expected}; the frame is incomplete or of another format"
            )
        octets = np.frombuffer(data, np.uint8)
        if row_padding:
            octets = octets.reshape(height, row + row_padding)[:, :row].ravel()
        image = self._samples(octets, width * height).reshape(height, width)
        # Bits above the depth are left empty, but some cameras shift their samples up.
        if self.bits not in (8, 16) and image.max() > self.saturation_level:
            raise DeviceError(
                f"the camera sends numbers up to {image.max()} as {self.name}, whose largest is "
                f"{self.saturation_level}: it aligns samples to the high bits; set another "
                "pixel_format in rig.toml, such as the 16-bit one"
            )
        return image

    def _samples(self, octets: NDArray[np.uint8], count: int) -> NDArray:
        if self.packing is Packing.GIGE_VISION:
            return _unpack_gige_vision(octets, count, self.bits)
        if self.packing is Packing.PFNC:
            return _unpack_pfnc(octets, count, self.bits)
        if self.bits <= 8:
            return octets.copy()
        return octets.view("<u2").astype(np.uint16)


def _unpack_gige_vision(octets: NDArray[np.uint8], count: int, bits: int) -> NDArray[np.uint16]:
    """High bits in the outer bytes, low bits of the first in the low nibble between them."""
    first, low, second = (part.astype(np.uint16) for part in _columns(octets, 3))
    shift = bits - 8
    mask = (1 << shift) - 1
    pairs = np.stack((first << shift | (low & mask), second << shift | (low >> 4 & mask)), axis=1)
    return pairs.ravel()[:count]


def _unpack_pfnc(octets: NDArray[np.uint8], count: int, bits: int) -> NDArray[np.uint16]:
    """Sample k begins at bit k·bits of the buffer, counted from the low end of each byte."""
    samples_in_group = {10: 4, 12: 2, 14: 4}[bits]
    columns = [part.astype(np.uint64) for part in _columns(octets, samples_in_group * bits // 8)]
    group = sum((c << np.uint64(8 * k) for k, c in enumerate(columns)), np.uint64(0))
    mask = np.uint64((1 << bits) - 1)
    samples = [(group >> np.uint64(bits * k)) & mask for k in range(samples_in_group)]
    return np.stack(samples, axis=1).astype(np.uint16).ravel()[:count]


def _columns(octets: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Byte k of every group of ``size`` bytes; an incomplete last group is filled with zeros."""
    missing = -len(octets) % size
    return np.pad(octets, (0, missing)).reshape(-1, size).T


def _formats() -> Iterable[PixelFormat]:
    for bits, code in ((8, 0x01080001), (10, 0x01100003), (12, 0x01100005), (14, 0x01100025)):
        yield PixelFormat(f"Mono{bits}", code, bits)
    yield PixelFormat("Mono16", 0x01100007, 16)
    yield PixelFormat("Mono10Packed", 0x010C0004, 10, Packing.GIGE_VISION)
    yield PixelFormat("Mono12Packed", 0x010C0006, 12, Packing.GIGE_VISION)
    yield PixelFormat("Mono10p", 0x010A0046, 10, Packing.PFNC)
    yield PixelFormat("Mono12p", 0x010C0047, 12, Packing.PFNC)
    mosaics = {
        "GR": BayerPattern.GRBG,
        "RG": BayerPattern.RGGB,
        "GB": BayerPattern.GBRG,
        "BG": BayerPattern.BGGR,
    }
    first_codes = {8: 0x01080008, 10: 0x0110000C, 12: 0x01100010, 16: 0x0110002E}
    for bits, first in first_codes.items():
        for number, (letters, bayer) in enumerate(mosaics.items()):
            yield PixelFormat(f"Bayer{letters}{bits}", first + number, bits, bayer=bayer)
    for bits, first in ((10, 0x010C0026), (12, 0x010C002A)):
        for number, (letters, bayer) in enumerate(mosaics.items()):
            name = f"Bayer{letters}{bits}Packed"
            yield PixelFormat(name, first + number, bits, Packing.GIGE_VISION, bayer)
    # The bit-by-bit formats came later, in the order BG, GB, GR, RG, both depths in turn.
    for number, letters in enumerate(("BG", "GB", "GR", "RG")):
        for bits, first in ((10, 0x010A0052), (12, 0x010C0053)):
            yield PixelFormat(
                f"Bayer{letters}{bits}p", first + 2 * number, bits, Packing.PFNC, mosaics[letters]
            )


PIXEL_FORMATS = {pixel_format.name: pixel_format for pixel_format in _formats()}
"""Formats that are understood, by name."""


def choose_pixel_format(offered: Iterable[str], wanted: str | None) -> PixelFormat:
    """The format that a camera is set to.

    Parameters
    ----------
    offered : iterable of str
        Names that the camera lists.
    wanted : str, optional
        By default the deepest; an unpacked one before a packed one of the same depth.

    Raises
    ------
    DeviceError
        The camera has no such format, or none that is one raw sample per pixel.
    """
    names = list(offered)
    raw = [PIXEL_FORMATS[name] for name in names if name in PIXEL_FORMATS]
    listed = ", ".join(names) or "none"
    if wanted is not None:
        if wanted not in names:
            raise DeviceError(f"the camera has no pixel format {wanted!r}; it has {listed}")
        if wanted not in PIXEL_FORMATS:
            usable = ", ".join(pixel_format.name for pixel_format in raw) or "none of this camera"
            raise DeviceError(
                f"pixel format {wanted} is not one raw sample per pixel; usable: {usable}"
            )
        return PIXEL_FORMATS[wanted]
    if not raw:
        raise DeviceError(
            f"the camera offers no raw pixel format (it has {listed}); processed pictures cannot "
            "be measured with"
        )
    return max(raw, key=lambda f: (f.bits, f.packing is Packing.NONE))
