"""Input that is ordinary in a laboratory: dark, saturated, tiny, masked, of the wrong kind."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_scan import expose, fringe_patterns, gray_patterns, make_plan

from acquisition.correspondence import Rejection
from acquisition.decoding import DecodingOptions, decode
from acquisition.errors import DecodingError
from acquisition.patterns import BLACK, WHITE, Axis, PhaseShift, pattern_profile
from acquisition.sample_noise import SampleNoise

BOTH = {Axis.COLUMN: 1.4, Axis.ROW: 1.2}


def patterns_of(axis, steps=4):
    extent = 512.0 if axis is Axis.COLUMN else 320.0
    return fringe_patterns(axis, period=32.0, steps=steps) + fringe_patterns(
        axis, period=extent, steps=steps
    )


def scene(width, height, *, steps=4, sigma=3.0, axes=tuple(Axis)):
    patterns = [pattern for axis in axes for pattern in patterns_of(axis, steps)]
    plan = make_plan(patterns, width=width, height=height)
    col, row = np.meshgrid(np.arange(width), np.arange(height))
    truth = {Axis.COLUMN: 30 + 1.4 * col + 0.1 * row, Axis.ROW: 25 + 1.2 * row + 0.05 * col}
    return plan, truth, expose(plan, truth, sigma=sigma)


def decode_frames(plan, frames, **options):
    return decode(plan, frames.__getitem__, DecodingOptions(**options))


def worst(found, truth):
    return max(
        np.nanmax(np.abs(axis.coordinate - truth[name])) for name, axis in found.axes.items()
    )


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 5), (3, 3), (300, 1), (1, 200)])
@pytest.mark.parametrize("steps", [3, 4])
def test_tiny_pictures_decode(shape, steps):
    plan, truth, frames = scene(*shape, steps=steps, sigma=0)
    found = decode_frames(plan, frames, noise=SampleNoise(1.0, 0.0, "known"))
    assert found.valid.mean() > 0.5
    assert worst(found, truth) < 0.5
    # And without a known noise: the right coordinates or a plain refusal.
    try:
        found = decode_frames(plan, frames)
    except DecodingError:
        return
    assert worst(found, truth) < 0.5


@pytest.mark.parametrize("level", [0, 1023])
def test_all_dark_and_all_saturated_are_refused_with_the_reason(level):
    plan, _, frames = scene(64, 48)
    frames = {name: np.full_like(frame, level) for name, frame in frames.items()}
    reason = "saturated" if level else "low modulation"
    with pytest.raises(DecodingError, match=f"100% {reason}.*exposure"):
        decode_frames(plan, frames)


def test_a_hundredth_of_the_picture_is_enough():
    plan, truth, frames = scene(320, 240)
    lit = np.zeros((240, 320), bool)
    lit[100:128, 140:168] = True
    random = np.random.default_rng(0)
    for name, frame in frames.items():
        dark = random.normal(30, 3, frame.shape).round().clip(0).astype(np.uint16)
        frames[name] = np.where(lit, frame, dark)
    found = decode_frames(plan, frames)
    assert found.valid[lit].mean() > 0.99
    # What is left by chance at a contrast of three is off by no more than noise allows to see.
    assert found.valid[~lit].mean() < 2e-3
    inside = {name: np.where(lit, coordinate, np.nan) for name, coordinate in truth.items()}
    assert worst(found, inside) < 0.6


def test_ten_pixels_decode():
    plan, truth, frames = scene(320, 240)
    lit = np.zeros((240, 320), bool)
    lit[100:102, 140:145] = True
    frames = {name: np.where(lit, frame, 5).astype(np.uint16) for name, frame in frames.items()}
    found = decode_frames(plan, frames, noise=SampleNoise(9.0, 0.0, "known"))
    np.testing.assert_array_equal(found.valid, lit)
    assert worst(found, truth) < 0.5


def test_every_second_row_saturated_leaves_the_rest():
    plan, truth, frames = scene(120, 80)
    for frame in frames.values():
        frame[::2] = 1023
    found = decode_frames(plan, frames)
    assert (found.rejection[::2] & Rejection.SATURATED).all()
    assert found.valid[1::2].mean() > 0.99
    assert worst(found, truth) < 1


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda frame: frame[:-1], r"frame 0002 is \(47, 64\), the plan says \(48, 64\)"),
        (lambda frame: np.stack([frame] * 3, axis=-1), r"frame 0002 is \(48, 64, 3\)"),
        (lambda frame: frame.astype(np.float32), "frame 0002 holds float32"),
        (lambda frame: frame.astype(np.int64), "frame 0002 holds int64"),
        (lambda frame: (frame // 4).astype(np.uint8), "frame 0002 holds uint8, those before"),
        (lambda frame: frame[0, 0], r"frame 0002 is \(\)"),
    ],
)
def test_frames_of_the_wrong_kind_are_named(damage, message):
    plan, _, frames = scene(64, 48)
    frames["0002"] = damage(frames["0002"])
    with pytest.raises(DecodingError, match=message):
        decode_frames(plan, frames)


@pytest.mark.parametrize(
    "view",
    [
        lambda frame: np.asfortranarray(frame),
        lambda frame: np.repeat(frame, 2, axis=1)[:, ::2],
        lambda frame: np.frombuffer(frame.tobytes(), frame.dtype).reshape(frame.shape),
    ],
)
def test_frames_in_any_memory_layout_decode_alike(view):
    plan, _, frames = scene(64, 48)
    plain = decode_frames(plan, frames)
    viewed = decode_frames(plan, {name: view(frame) for name, frame in frames.items()})
    for axis in Axis:
        np.testing.assert_array_equal(plain.axes[axis].coordinate, viewed.axes[axis].coordinate)


def test_frames_are_not_changed_and_read_once():
    plan, _, frames = scene(64, 48, steps=3)
    copies = {name: frame.copy() for name, frame in frames.items()}
    read = []

    def read_frame(name):
        read.append(name)
        return frames[name]

    decode(plan, read_frame)
    assert sorted(read) == sorted(frames)
    for name, frame in frames.items():
        np.testing.assert_array_equal(frame, copies[name])


@pytest.mark.parametrize(
    "options",
    [
        {"minimum_contrast": -1.0},
        {"minimum_modulation": float("nan")},
        {"false_alarm": 0.0},
        {"wrong_order_probability": 1.5},
        {"borne_out_probability": float("nan")},
        {"order_sigmas": float("inf")},
    ],
)
def test_options_out_of_bounds_are_named(options):
    with pytest.raises(DecodingError, match=next(iter(options))):
        DecodingOptions(**options)


def test_a_missing_step_is_refused_before_anything_is_decoded():
    step = PhaseShift(axis=Axis.ROW, period_px=32.0, shift_rad=0.0)
    plan = make_plan([*patterns_of(Axis.ROW), step.model_copy(update={"gamma": 2.0})])
    with pytest.raises(DecodingError, match=r"row fringe of period 32.*1 steps"):
        decode_frames(plan, {})


def panel_truth(width=320, height=240):
    """Whole panel pixels that the camera's pixels see, as a panel of pixels shows them."""
    col, row = np.meshgrid(np.arange(width), np.arange(height))
    return {Axis.COLUMN: np.floor(20 + 1.4 * col), Axis.ROW: np.floor(15 + 1.2 * row)}


@pytest.mark.parametrize("step", [1, 4])
@pytest.mark.parametrize("thresholds", ["inverse", "white and black"])
def test_gray_codes_decode_by_themselves(step, thresholds):
    truth = panel_truth()
    patterns = [] if thresholds == "inverse" else [WHITE, BLACK]
    for axis in Axis:
        bits = 9 if step == 1 else 7
        patterns += gray_patterns(axis, step=float(step), bits=bits)
        if thresholds == "inverse":
            patterns += gray_patterns(axis, step=float(step), bits=bits, inverse=True)
    plan = make_plan(patterns)
    frames = expose(plan, truth, sigma=8)
    random = np.random.default_rng(5)
    for frame in frames.values():
        frame[:10] = random.normal(100, 8, (10, 320)).round()
        frame[20:25] = 1023
    found = decode_frames(plan, frames)
    for axis in Axis:
        decoded = found.axes[axis]
        middle = np.floor(truth[axis] / step) * step + (step - 1) / 2
        np.testing.assert_array_equal(decoded.coordinate[found.valid], middle[found.valid])
        assert decoded.variance[found.valid] == pytest.approx(step**2 / 12)
    assert found.valid[30:].mean() > 0.999
    assert (found.rejection[:10] & Rejection.LOW_MODULATION != 0).mean() > 0.95
    assert (found.rejection[20:25] & Rejection.SATURATED).all()
    assert found.noise_sigma == pytest.approx(8, rel=0.1)


def test_gray_codes_by_themselves_at_several_exposures():
    truth = panel_truth()
    bits = gray_patterns(Axis.COLUMN, step=4.0, bits=7)
    inverses = gray_patterns(Axis.COLUMN, step=4.0, bits=7, inverse=True)
    plan = make_plan([*bits, *inverses] * 2, saturation=1023)
    half = len(plan.frames) // 2
    frames = tuple(
        frame.model_copy(update={"exposure_s": 1.0 if number < half else 0.1})
        for number, frame in enumerate(plan.frames)
    )
    plan = plan.model_copy(update={"frames": frames})
    light = np.linspace(0.3, 8, 240)[:, np.newaxis]
    random = np.random.default_rng(0)
    captured = {}
    for frame in plan.frames:
        level = 20 + 900 * light * frame.exposure_s * pattern_profile(
            frame.pattern, truth[Axis.COLUMN]
        )
        noisy = level + random.normal(0, 6, level.shape)
        captured[frame.id] = np.clip(np.round(noisy), 0, 1023).astype(np.uint16)
    found = decode_frames(plan, captured)
    assert found.valid.mean() > 0.999
    middle = np.floor(truth[Axis.COLUMN] / 4) * 4 + 1.5
    decoded = found.axes[Axis.COLUMN].coordinate
    np.testing.assert_array_equal(decoded[found.valid], middle[found.valid])


def test_a_gray_code_with_nothing_to_tell_its_bits_by_is_refused():
    plan = make_plan(gray_patterns(Axis.COLUMN, step=4.0, bits=7))
    frames = expose(plan, panel_truth())
    with pytest.raises(DecodingError, match=r"neither inverse frames nor a white and a black"):
        decode_frames(plan, frames)


def test_one_axis_by_gray_code_and_one_by_fringes():
    truth = panel_truth()
    patterns = patterns_of(Axis.COLUMN) + gray_patterns(Axis.ROW, step=4.0, bits=7)
    patterns += gray_patterns(Axis.ROW, step=4.0, bits=7, inverse=True)
    plan = make_plan(patterns)
    found = decode_frames(plan, expose(plan, truth, sigma=3))
    assert found.valid.mean() > 0.99
    assert np.nanmax(np.abs(found.axes[Axis.COLUMN].coordinate - truth[Axis.COLUMN])) < 1
    assert np.nanmax(np.abs(found.axes[Axis.ROW].coordinate - truth[Axis.ROW])) <= 1.5


def test_a_plan_with_nothing_to_decode_is_refused():
    plan = make_plan([WHITE])
    with pytest.raises(DecodingError, match="nothing to decode"):
        decode_frames(plan, {})
