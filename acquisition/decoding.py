r"""Decoding: from frames of structured light to projector coordinates with their variance.

N phase steps give, per pixel, the mean A, the modulation B and the phase φ by linear least
squares; the fringe order comes from Gray code or from coarser fringes. For steps spread evenly
and noise σ the phase has :math:`\sigma_\varphi = \sqrt{2/N}\,\sigma/B`; here each sample's own
variance is propagated, so uneven steps and photon noise are covered.

Frames are taken one at a time and folded into sums. Where a fringe was taken at several exposures,
all steps of a pixel come from the same one: each exposure gives a phase of its own, saturated ones
drop out, and the rest are joined by inverse variance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acquisition.axis_decoding import DecodedAxis, FringeDecoder, SharedPictures
from acquisition.correspondence import AxisCoordinate, CorrespondenceMap, Rejection
from acquisition.decoding_options import DecodingOptions
from acquisition.errors import DecodingError
from acquisition.frame_stream import FrameStream, ReadFrame
from acquisition.fringe_sampling import FringeSampler
from acquisition.fringes import exposures_of_fringes, find_fringes
from acquisition.gray_decoding import GrayCode, decode_gray_alone, find_gray_code
from acquisition.patterns import Axis
from acquisition.plan import Plan
from acquisition.rejection_kernels import (
    PROVISIONAL,
    UNCERTAIN_ORDER,
    begin_pictures,
    flag_outside,
    mask_rejected,
    settle,
)
from acquisition.sample_noise import QUANTISATION_VARIANCE, SampleNoise
from acquisition.unwrapping import UnwrappedAxis, check_orders

__all__ = ["DecodingOptions", "ReadFrame", "decode"]

_SAMPLES = 65_536


def decode(
    plan: Plan, read_frame: ReadFrame, options: DecodingOptions | None = None
) -> CorrespondenceMap:
    """Decode the frames of a plan into a correspondence map.

    Parameters
    ----------
    plan : Plan
        What the frames are pictures of.
    read_frame : callable
        Takes a frame id to its (rows, cols) uint8 or uint16 array of sensor numbers, which is not
        changed afterwards. It is called once for each frame that is needed.
    options : DecodingOptions, optional
        Thresholds and noise.

    Returns
    -------
    CorrespondenceMap
        One coordinate for each axis that the plan has fringes or a Gray code for.

    Raises
    ------
    DecodingError
        Nothing to decode, frames of the wrong size or type, steps that do not determine a phase,
        orders that nothing resolves or that contradict the phase, or not one pixel decoded.
    """
    options = options or DecodingOptions()
    decoder = _decoder(plan, read_frame, options)
    shared = decoder.shared
    found: dict[Axis, DecodedAxis] = {}
    for axis in Axis:
        code = find_gray_code(plan, axis)
        groups = [group for group in decoder.sampler.groups if group[0].axis is axis]
        if groups:
            found[axis] = decoder.decode(groups, extent=_extent(plan, axis), code=code)
        elif code is not None:
            found[axis] = _decode_code(code, decoder)
    if not found:
        raise DecodingError(
            "the plan has no phase-shift frames and no Gray code, so there is nothing to decode"
        )
    ambient = shared.ambient
    ambient /= max(1, shared.terms)
    noise = decoder.sampler.noise or SampleNoise(QUANTISATION_VARIANCE, 0.0, "quantisation")
    if not _settle_orders(found, shared.rejection, decoder):
        raise DecodingError(_why_nothing(shared.rejection, found, ambient, noise))
    shape = (plan.crop.height, plan.crop.width)
    sample = slice(None, None, max(1, ambient.size // _SAMPLES))
    usual = ambient[sample][shared.rejection[sample] == 0]
    if not len(usual):
        usual = ambient[shared.rejection == 0]
    return CorrespondenceMap(
        {axis: _picture_of(decoded, shape) for axis, decoded in found.items()},
        ambient.reshape(shape),
        shared.rejection.reshape(shape),
        (plan.crop.column, plan.crop.row),
        float(np.sqrt(np.median(noise.variance(usual)))),
    )


def _decoder(plan: Plan, read_frame: ReadFrame, options: DecodingOptions) -> FringeDecoder:
    pixels = plan.crop.height * plan.crop.width
    # Not of zeros: what numpy sets aside empty it has in large pages, which are set up faster.
    shared = SharedPictures(np.empty(pixels, np.float32), np.empty(pixels, np.uint16))
    begin_pictures(shared.ambient, shared.rejection)
    groups = exposures_of_fringes(find_fringes(plan))
    sampler = FringeSampler(FrameStream(plan, read_frame), options, groups, options.noise)
    return FringeDecoder(sampler, shared)


def _extent(plan: Plan, axis: Axis) -> int:
    return plan.projector.width if axis is Axis.COLUMN else plan.projector.height


def _decode_code(code: GrayCode, decoder: FringeDecoder) -> DecodedAxis:
    """An axis that has a Gray code and no fringes."""
    options, shared = decoder.sampler.options, decoder.shared
    least = options.minimum_modulation
    decoded, noise = decode_gray_alone(
        code,
        decoder.sampler.stream,
        shared.rejection,
        noise=decoder.sampler.noise,
        contrast=options.minimum_contrast if least is None else 0.0,
        least=least or 0.0,
    )
    decoder.sampler.noise = noise
    shared.ambient += decoded.ambient
    shared.terms += 1
    extent = _extent(decoder.sampler.stream.plan, code.axis)
    flag_outside(decoded.coordinate, extent, shared.rejection)
    variance = np.full(len(decoded.ambient), code.step_px**2 / 12, np.float32)
    # A Gray word read wrongly is off by any number of cells; nothing repeats.
    return DecodedAxis(
        decoded.coordinate, variance, decoded.modulation, float(extent), float("nan")
    )


def _mask(
    found: dict[Axis, DecodedAxis], rejection: NDArray[np.uint16], provisional: int
) -> tuple[int, int]:
    """Mask rejected pixels in place; how many are left, and how many of those are unsettled."""
    counts = (0, 0)
    for decoded in found.values():
        counts = mask_rejected(rejection, decoded.coordinate, decoded.variance, provisional)
    return counts


def _settle_orders(
    found: dict[Axis, DecodedAxis], rejection: NDArray[np.uint16], decoder: FringeDecoder
) -> int:
    """Hold orders against their neighbours' and mask rejected pixels; how many are left."""
    accepted, unsettled = _mask(found, rejection, PROVISIONAL)
    uncertain = rejection & np.uint16(UNCERTAIN_ORDER) if unsettled else None
    wrong = np.zeros(1, np.bool_) if uncertain is None else uncertain != 0
    if accepted and decoder.sampler.options.check_neighbours:
        shape, plan = decoder.sampler.stream.shape, decoder.sampler.stream.plan
        axes = {
            axis: UnwrappedAxis(
                decoded.coordinate.reshape(shape),
                decoded.variance.reshape(shape),
                decoded.period_px,
                _extent(plan, axis),
            )
            for axis, decoded in found.items()
        }
        check = check_orders(
            axes, uncertain=None if uncertain is None else uncertain.reshape(shape)
        )
        wrong = check.wrong.reshape(-1)
        if check.repaired_pixels:
            for axis, decoded in found.items():
                np.copyto(decoded.coordinate, check.coordinates[axis].reshape(-1))
    if unsettled or wrong.any():
        settle(rejection, wrong)
        for axis, decoded in found.items():
            flag_outside(decoded.coordinate, _extent(decoder.sampler.stream.plan, axis), rejection)
        accepted, _ = _mask(found, rejection, 0)
    return accepted


def _picture_of(decoded: DecodedAxis, shape: tuple[int, int]) -> AxisCoordinate:
    return AxisCoordinate(
        decoded.coordinate.reshape(shape),
        decoded.variance.reshape(shape),
        decoded.modulation.reshape(shape),
        decoded.period_px,
        decoded.residual_rms,
        decoded.harmonics,
    )


def _why_nothing(
    rejection: NDArray[np.uint16],
    found: dict[Axis, DecodedAxis],
    ambient: NDArray[np.float32],
    noise: SampleNoise,
) -> str:
    shares = ", ".join(
        f"{np.mean(rejection & np.uint16(reason) != 0):.0%} {reason.name.lower().replace('_', ' ')}"
        for reason in Rejection
        if reason and reason.name and np.any(rejection & np.uint16(reason))
    )
    brightest = max(float(np.max(decoded.modulation)) for decoded in found.values())
    sigma = float(np.sqrt(np.median(noise.variance(ambient))))
    return (
        f"not one pixel could be decoded ({shares}); the strongest fringe has a modulation of "
        f"{brightest:.3g} sensor numbers over a noise of {sigma:.2g}: check that the projector "
        "shows its patterns, and the exposure"
    )
