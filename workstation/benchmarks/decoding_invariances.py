"""Changes that must not matter to decoding and to the merging of exposures."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from acquisition.correspondence import CorrespondenceMap
from acquisition.decoding import DecodingOptions, decode
from acquisition.frame_files import Samples
from acquisition.hdr import merge_bracket
from acquisition.plan import Plan
from acquisition.sample_noise import SampleNoise
from acquisition.session import Session
from devices.errors import ImpastoError
from workstation.benchmarks.invariances import SINGLE, Invariance, threads
from workstation.benchmarks.turned_cameras import turned_map, turned_picture

_FULL_SCALE = 65535
_BLACK, _CEILING, _GAIN, _READ = 32.0, 4095, 0.5, 4.0
_EXPOSURES = np.array([0.01, 0.04, 0.16])


def decoding_invariances(session: Session) -> Iterator[Invariance]:
    """What must not matter to decoding a small scan.

    Coordinates come of sums of numbers of up to 16 bits in single precision, and the panel is some
    thousand pixels wide: what another order of the sums, or a factor, leaves of 2⁻²⁴ is some 10⁻⁴
    px. Where the camera is turned the noise is given: its estimate compares neighbours along rows,
    which are others then.
    """
    plan = session.plan
    frames = {frame.id: session.read_frame(frame.id) for frame in plan.frames}
    reference = decode(plan, frames.__getitem__)

    def changed(
        name: str, plan: Plan, read: Callable[[str], Samples], tolerance: float
    ) -> Invariance:
        return Invariance(
            f"decode, {name}", _pixels(decode(plan, read), reference), tolerance, "px"
        )

    random = np.random.default_rng(0)
    for _ in range(3):
        order = tuple(plan.frames[i] for i in random.permutation(len(plan.frames)))
        permuted = plan.model_copy(update={"frames": order})
        yield changed("frames in another order", permuted, frames.__getitem__, 1e-4)
    with threads(1):
        yield changed("one thread", plan, frames.__getitem__, 0.0)
    gain = min(16, _FULL_SCALE // plan.saturation_level)
    brighter = plan.model_copy(update={"saturation_level": plan.saturation_level * gain})
    yield changed(
        f"{gain} times the sensor numbers",
        brighter,
        lambda frame: (
            (frames[frame].astype(np.uint32) * gain).clip(0, _FULL_SCALE).astype(np.uint16)
        ),
        1e-4,
    )
    known = DecodingOptions(noise=SampleNoise(_READ, _GAIN, "given"))
    upright = decode(plan, frames.__getitem__, known)
    for quarters in (1, 2):

        def turned(frame: str, quarters: int = quarters) -> Samples:
            return turned_picture(frames[frame], quarters)

        found = decode(_turned_plan(plan, quarters), turned, known)
        yield Invariance(
            f"decode, camera turned by {90 * quarters}°",
            _pixels(turned_map(found, -quarters), upright),
            1e-4,
            "px",
        )
    yield Invariance("decode, frames in single precision", _in_floats(plan, frames), 0.0, "")
    yield _of_next_to_no_light(plan, frames, reference)


def _turned_plan(plan: Plan, quarters: int) -> Plan:
    """The plan of a camera that is turned and records whole pictures of the same panel."""
    if quarters % 2 == 0:
        return plan
    sides = {"width": plan.camera.height, "height": plan.camera.width}
    camera, crop = (one.model_copy(update=sides) for one in (plan.camera, plan.crop))
    return plan.model_copy(update={"camera": camera, "crop": crop})


def _in_floats(plan: Plan, frames: dict[str, Samples]) -> float:
    """Frames are whole numbers as they came: floats are refused by name, not decoded otherwise."""
    try:
        decode(plan, lambda frame: frames[frame].astype(np.float32))  # type: ignore[arg-type, return-value]
    except ImpastoError:
        return 0.0
    return np.inf


def _of_next_to_no_light(
    plan: Plan, frames: dict[str, Samples], reference: CorrespondenceMap
) -> Invariance:
    """Of a thousandth of the light what is decoded is right within its stated error."""
    try:
        found = decode(plan, lambda frame: _dimmed(frames[frame]))
    except ImpastoError:
        return Invariance("decode, next to no light: wrong pixels", 0.0, 0.0, "")
    wrong = 0
    for axis, expected in reference.axes.items():
        a, b = found.axes[axis], expected
        both = np.isfinite(a.coordinate) & np.isfinite(b.coordinate)
        sigma = np.sqrt(a.variance[both] + b.variance[both])
        off = np.abs(a.coordinate[both] - b.coordinate[both])
        wrong += int((off > np.maximum(0.5 * b.period_px, 10 * sigma)).sum())
    return Invariance("decode, next to no light: wrong pixels", wrong, 0.0, "")


def _dimmed(frame: Samples) -> Samples:
    dark = int(np.percentile(frame, 1))
    dimmed = dark + (frame.astype(np.int32) - dark).clip(0) // 1000
    return dimmed.astype(np.uint8) if frame.dtype == np.uint8 else dimmed.astype(np.uint16)


def _pixels(found: CorrespondenceMap, reference: CorrespondenceMap) -> float:
    """Largest difference of coordinates, where nearly all pixels have one in both."""
    worst = 0.0
    for axis, expected in reference.axes.items():
        a, b = found.axes[axis].coordinate, expected.coordinate
        both = np.isfinite(a) & np.isfinite(b)
        if both.sum() < 0.999 * max(np.isfinite(a).sum(), np.isfinite(b).sum()):
            return np.inf
        worst = max(worst, float(np.abs(a - b)[both].max()))
    return worst


def merging_invariances() -> Iterator[Invariance]:
    """What must not matter to merging exposures; relative to the radiance.

    Radiance is kept in single precision, after some ten roundings.
    """
    random = np.random.default_rng(1)
    radiance = 10 ** random.uniform(1, 5, (64, 64))
    level = radiance[None] * _EXPOSURES[:, None, None]
    noisy = random.poisson(level / _GAIN) * _GAIN + _BLACK
    stack = np.clip(noisy, 0, _CEILING).astype(np.uint16)
    rising = np.arange(len(_EXPOSURES))
    reference = _merged(stack, rising, 1.0)
    with threads(1):
        alone = _merged(stack, rising, 1.0)
    for name, found in (
        ("exposures in another order", _merged(stack, rising[::-1], 1.0)),
        ("exposures in milliseconds", _merged(stack, rising, 1e3)),
        ("exposures in days", _merged(stack, rising, 1 / 86_400)),
        ("one thread", alone),
        ("camera turned by 90°", turned_picture(_merged_turned(stack), -1)),
    ):
        deviation = np.nanmax(np.abs(found - reference) / (np.abs(reference) + 1.0))
        same = np.array_equal(np.isnan(found), np.isnan(reference))
        yield Invariance(f"merge, {name}", float(deviation) if same else np.inf, 20 * SINGLE, "")


def _merged(stack: NDArray[np.uint16], order: NDArray[np.intp], unit: float) -> NDArray[np.float32]:
    merged = merge_bracket(
        [stack[i] for i in order],
        _EXPOSURES[order] * unit,
        noise=SampleNoise(_READ, _GAIN, "stated"),
        black_level=_BLACK,
        saturation_level=_CEILING,
    )
    return np.asarray(merged.radiance * unit, np.float32)


def _merged_turned(stack: NDArray[np.uint16]) -> NDArray[np.float32]:
    turned = np.stack([turned_picture(one, 1) for one in stack])
    return _merged(turned, np.arange(len(stack)), 1.0)
