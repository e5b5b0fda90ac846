"""Gray codes of a plan: which frames are its bits, and the cell that every pixel sees.

Beside a fringe the cell only tells the order, and a bit is held against its inverse or against the
fringe's mean level. A code without a fringe is decoded by itself: the coordinate is the middle of
the pixel's cell, its variance that of a uniform distribution over the cell.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.errors import DecodingError
from acquisition.frame_files import Samples
from acquisition.frame_stream import FrameStream
from acquisition.gray_kernels import cell_centres, judge_words, light_of_bit, read_bits, weigh_bits
from acquisition.patterns import BLACK, WHITE, Axis, Gray
from acquisition.plan import Plan, PlannedFrame
from acquisition.sample_noise import QUANTISATION_VARIANCE, SampleNoise, fit_sample_noise

# Takes an exposure to the (pixels,) level above which a bit is 1.
LevelAt = Callable[[float | None], NDArray[np.float32]]
_Picture = Samples | NDArray[np.float32]
_LEAST_SAMPLES = 100
_SAMPLES = 8192


@dataclass(frozen=True)
class GrayCode:
    """The Gray code of one axis among the frames of a plan.

    Attributes
    ----------
    axis : Axis
    length : int
        Bits.
    step_px : float
        Width of a cell.
    offset : float
    bits, inverses : dict
        Frames by bit, 0 being the most significant; several where it was taken at several
        exposures, by rising exposure.
    """

    axis: Axis
    length: int
    step_px: float
    offset: float
    bits: dict[int, list[PlannedFrame]]
    inverses: dict[int, list[PlannedFrame]]

    @property
    def first_centre(self) -> float:
        """Coordinate of the middle of cell 0, as continuous patterns have it."""
        return (0.5 - self.offset) * self.step_px

    @property
    def first_lit_centre(self) -> float:
        """Coordinate of the middle of the pixels that show cell 0.

        Cells that begin at a pixel's centre light that pixel from its edge on.
        """
        begins = self.step_px * self.offset
        whole = float(self.step_px).is_integer() and float(begins).is_integer()
        return self.first_centre - (0.5 if whole else 0.0)


def find_gray_code(plan: Plan, axis: Axis) -> GrayCode | None:
    """The Gray code of one axis; None where the plan has none.

    Raises
    ------
    DecodingError
        Several codes of one axis, bits that are missing, or too few to number the panel's cells.
    """
    bits: dict[int, list[PlannedFrame]] = {}
    inverses: dict[int, list[PlannedFrame]] = {}
    codes = set()
    for frame in sorted(plan.frames, key=lambda frame: frame.exposure_s or 0.0):
        pattern = frame.pattern
        if isinstance(pattern, Gray) and pattern.axis is axis:
            (inverses if pattern.inverse else bits).setdefault(pattern.bit, []).append(frame)
            codes.add(pattern.code)
    if not codes:
        return None
    if len(codes) > 1:
        raise DecodingError(f"the plan has {len(codes)} different Gray codes of the {axis}s")
    _, length, step_px, offset = codes.pop()
    missing = sorted(set(range(length)) - set(bits))
    if missing:
        raise DecodingError(f"bits {missing} of the Gray code of the {axis}s are missing")
    panel = plan.projector.width if axis is Axis.COLUMN else plan.projector.height
    first, last = math.floor(offset), math.floor((panel - 1) / step_px + offset)
    if last - first >= 2**length:
        raise DecodingError(
            f"the {length} bits of the {axis}s' Gray code number {2**length} cells of {step_px:g} "
            f"px, and the panel has {last - first + 1}: different places show the same code; add "
            "bits, or check the width of a cell and the size of the panel"
        )
    return GrayCode(axis, length, step_px, offset, bits, inverses)


def read_words(
    code: GrayCode, stream: FrameStream, level_at: LevelAt | None = None
) -> NDArray[np.int32]:
    """Gray word of every pixel.

    Parameters
    ----------
    code : GrayCode
    stream : FrameStream
    level_at : callable, optional
        What bits without an inverse are held against.

    Returns
    -------
    (pixels,) int32 array
    """
    words = np.empty(stream.shape[0] * stream.shape[1], np.int32)
    for bit in range(0, code.length, 2):
        pair = _against(code, bit, stream, level_at)
        both = bit + 1 < code.length
        other = _against(code, bit + 1, stream, level_at) if both else pair
        read_bits(words, bit == 0, *pair, *other, both)
    return words


def needs_level(code: GrayCode) -> bool:
    """Whether some bit has no inverse to be held against."""
    return any(bit not in code.inverses for bit in range(code.length))


def cell_coordinates(
    code: GrayCode, words: NDArray[np.int32], out: NDArray[np.float32] | NDArray[np.float64]
) -> None:
    """Middle of every pixel's cell, into ``out`` (pixels,), for the order of a fringe."""
    cell_centres(words, code.first_centre, code.step_px, out)


@dataclass(frozen=True)
class DecodedCode:
    """A Gray code decoded by itself; arrays of (pixels,).

    Attributes
    ----------
    coordinate : float64 array
        Middle of the pixel's cell.
    modulation : float32 array
        Half the second smallest difference of a bit and its inverse.
    ambient : float32 array
    """

    coordinate: NDArray[np.float64]
    modulation: NDArray[np.float32]
    ambient: NDArray[np.float32]


def decode_gray_alone(
    code: GrayCode,
    stream: FrameStream,
    rejection: NDArray[np.uint16],
    *,
    noise: SampleNoise | None,
    contrast: float,
    least: float,
) -> tuple[DecodedCode, SampleNoise]:
    """Decode a Gray code that no fringe refines.

    Parameters
    ----------
    code : GrayCode
    stream : FrameStream
    rejection : (pixels,) uint16 array
        Rejection bits are added.
    noise : SampleNoise or None
        None estimates it from what bits and inverses add up to, which is the same for every bit.
    contrast, least : float
        Standard deviations, and sensor numbers, that the modulation must exceed.

    Raises
    ------
    DecodingError
        Bits without an inverse, and no white and black frame to stand in for it.
    """
    opposed = _opposed(code, stream)
    read = _read_alone(code, stream, opposed, rejection)
    sampled = _sample(stream.shape)
    lit = rejection[sampled] == 0
    noise = noise or _noise_of_differences(
        read.differences[:, lit], read.ambient[sampled][lit], opposed.own_samples
    )
    modulation = np.empty(len(rejection), np.float32)
    # Half a difference has a quarter of its variance.
    share = (opposed.own_samples + opposed.shared_samples) / 4
    judge_words(
        read.contrast,
        read.ambient,
        share * noise.read_variance,
        share * noise.gain,
        noise.black_level,
        contrast,
        least,
        modulation,
        rejection,
    )
    coordinate = np.empty(len(rejection))
    cell_centres(read.words, code.first_lit_centre, code.step_px, coordinate)
    return DecodedCode(coordinate, modulation, read.ambient), noise


@dataclass(frozen=True)
class _ReadCode:
    """A code's pictures, read.

    Words; the contrast to judge them by, the second smallest or that of a single bit; mean levels;
    and (bits, n) differences of bits and inverses of sampled pixels.
    """

    words: NDArray[np.int32]
    contrast: _Picture
    ambient: NDArray[np.float32]
    differences: NDArray[np.float64]


def _read_alone(
    code: GrayCode, stream: FrameStream, opposed: _Opposed, rejection: NDArray[np.uint16]
) -> _ReadCode:
    words = np.empty(len(rejection), np.int32)
    second = opposed.largest_contrast
    smallest = second.copy()
    ambient = np.empty(len(rejection), np.float32)
    sampled, differences = _sample(stream.shape), []
    for bit in range(0, code.length, 2):
        pair = opposed.pair(bit)
        both = bit + 1 < code.length
        other = opposed.pair(bit + 1) if both else pair
        read_bits(words, bit == 0, *pair, *other, both)
        weigh_bits(smallest, second, *pair, *other, both)
        if bit == 0:
            light = pair if len(code.bits[0]) == 1 else _shortest(code, stream)
            light_of_bit(*light, stream.plan.saturation_level, ambient, rejection)
        for picture, opposite in (pair, other)[: 1 + both]:
            two = (plane[sampled].astype(np.float64) for plane in (picture, opposite))
            differences.append(np.subtract(*two))
    contrast = second if code.length > 1 else smallest
    return _ReadCode(words, contrast, ambient, np.stack(differences))


def sample_rows(shape: tuple[int, int], samples: int = 16_384) -> NDArray[np.intp]:
    """Rows, spread over a picture, that hold some number of pixels together."""
    rows, cols = shape
    return np.unique(np.linspace(0, rows - 1, max(1, min(rows, samples // cols))).astype(np.intp))


def _sample(shape: tuple[int, int]) -> NDArray[np.intp]:
    """Indices of some pixels, spread over a flat picture."""
    rows = sample_rows(shape)
    every = max(1, len(rows) * shape[1] // _SAMPLES)
    return (rows[:, np.newaxis] * shape[1] + np.arange(0, shape[1], every)).ravel()


def _noise_of_differences(
    differences: NDArray[np.float64], level: NDArray[np.float32], samples: float
) -> SampleNoise:
    """Noise of a sample from (bits, n) differences of bits and inverses.

    Those of lit bits are alike, and those of dark ones. ``samples`` of independent noise are in
    each difference.
    """
    lit = differences > 0
    counts = lit.sum(axis=0)
    both = (counts > 0) & (counts < len(differences))
    if len(differences) < 3 or both.sum() < _LEAST_SAMPLES:
        return SampleNoise(QUANTISATION_VARIANCE, 0.0, "quantisation: too little to tell more from")
    squares = np.zeros(int(both.sum()))
    for group in (lit[:, both], ~lit[:, both]):
        mean = (differences[:, both] * group).sum(axis=0) / group.sum(axis=0)
        squares += (group * (differences[:, both] - mean) ** 2).sum(axis=0)
    return fit_sample_noise(
        level[both],
        squares / samples,
        degrees_of_freedom=len(differences) - 2,
        origin=f"differences of {len(differences)} Gray bits and their inverses",
    )


def _against(
    code: GrayCode, bit: int, stream: FrameStream, level_at: LevelAt | None
) -> tuple[_Picture, _Picture]:
    """Picture of a bit, and what it is held against."""
    frames, inverses = code.bits[bit], code.inverses.get(bit, [])
    if not inverses and level_at is None:
        raise DecodingError(f"bit {bit} of the {code.axis}s' Gray code has no inverse")
    if len(frames) == 1:
        frame = frames[0]
        if inverses:
            return stream.take(frame.id), stream.take(inverses[-1].id)
        assert level_at is not None  # checked above
        return stream.take(frame.id), level_at(frame.exposure_s)
    if inverses and len(inverses) != len(frames):
        raise DecodingError(
            f"bit {bit} of the {code.axis}s' Gray code has {len(frames)} exposures, its inverse "
            f"{len(inverses)}"
        )
    # Exposures at which both are saturated, or both dark, add nothing.
    margin = np.zeros(stream.shape[0] * stream.shape[1], np.float32)
    for number, frame in enumerate(frames):
        margin += stream.take(frame.id)
        if inverses:
            margin -= stream.take(inverses[number].id)
        elif level_at is not None:
            margin -= level_at(frame.exposure_s)
    return margin, np.zeros_like(margin)


@dataclass(frozen=True)
class _Opposed:
    """Bits and their inverses, as taken or made of white and black.

    ``pair`` takes a bit to its picture and its inverse. The difference of the two holds
    ``own_samples`` of independent noise, and ``shared_samples`` that are the same for all bits.
    ``largest_contrast`` (pixels,) is what a difference can be at most, in the samples' type or in
    float32.
    """

    pair: Callable[[int], tuple[_Picture, _Picture]]
    own_samples: float
    shared_samples: float
    largest_contrast: _Picture


def _shortest(code: GrayCode, stream: FrameStream) -> tuple[_Picture, _Picture]:
    """First bit and its inverse at the shortest exposure: what saturates there does so in all."""
    return stream.take(code.bits[0][0].id), stream.take(code.inverses[0][0].id)


def _opposed(code: GrayCode, stream: FrameStream) -> _Opposed:
    pixels = stream.shape[0] * stream.shape[1]
    if needs_level(code) and any(len(frames) > 1 for frames in code.bits.values()):
        raise DecodingError(
            f"the {code.axis}s' Gray code was taken at several exposures without its inverse, and "
            "no fringe tells its bits' levels; take the inverse too, or one exposure"
        )
    if not needs_level(code):
        exposures = max(len(frames) for frames in code.bits.values())
        whole = exposures == 1
        kind = np.dtype(stream.sample_type(code.bits[0][0].id) if whole else np.float32)
        unbounded = np.full(pixels, np.iinfo(kind).max if whole else np.inf, kind)
        return _Opposed(
            lambda bit: _against(code, bit, stream, None), 2.0 * exposures, 0.0, unbounded
        )
    flats = {frame.pattern: frame.id for frame in stream.plan.frames}
    if WHITE not in flats or BLACK not in flats:
        raise DecodingError(
            f"the plan has no fringes of the {code.axis}s, and its Gray code neither inverse "
            "frames nor a white and a black one to tell its bits by"
        )
    white = stream.take(flats[WHITE]).astype(np.float32)
    black = stream.take(flats[BLACK]).astype(np.float32)

    def against_rest(bit: int) -> tuple[_Picture, _Picture]:
        picture = stream.take(code.bits[bit][0].id)
        return picture, white + black - picture

    return _Opposed(against_rest, 4.0, 2.0, np.maximum(white - black, 0))
