from __future__ import annotations

import numpy as np
import pytest
from synthetic_scan import expose, fringe_patterns, gray_patterns, make_plan

from acquisition.correspondence import Rejection
from acquisition.decoding import DecodingOptions, decode
from acquisition.errors import DecodingError
from acquisition.fringes import find_fringes
from acquisition.gray_kernels import gray_to_cell
from acquisition.patterns import Axis
from acquisition.sample_noise import SampleNoise, estimate_noise


def ramp(width: int = 320, height: int = 240) -> np.ndarray:
    col, row = np.meshgrid(np.arange(width), np.arange(height))
    return 20 + 1.4 * col + 0.11 * row


def decode_frames(plan, frames, **options):
    return decode(plan, frames.__getitem__, DecodingOptions(**options))


def reference_phase(stack: np.ndarray, shifts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Textbook N-step formula for evenly spread steps."""
    sine = np.tensordot(np.sin(shifts), stack, axes=1)
    cosine = np.tensordot(np.cos(shifts), stack, axes=1)
    return -np.arctan2(sine, cosine), 2 / len(shifts) * np.hypot(sine, cosine)


@pytest.mark.parametrize("steps", [3, 4, 7, 12])
def test_phase_agrees_with_the_textbook_formula(steps):
    patterns = fringe_patterns(Axis.COLUMN, period=600.0, steps=steps)
    plan = make_plan(patterns)
    frames = expose(plan, {Axis.COLUMN: ramp()}, sigma=3)
    found = decode_frames(plan, frames, noise=SampleNoise(9.0, 0.0, "known"))
    shifts = np.array([p.shift_rad for p in patterns])
    phase, modulation = reference_phase(np.stack(list(frames.values())).astype(float), shifts)
    expected = (phase / (2 * np.pi) % 1) * 600.0
    np.testing.assert_allclose(
        found.axes[Axis.COLUMN].coordinate[found.valid], expected[found.valid], atol=1e-3
    )
    np.testing.assert_allclose(found.modulation, modulation, rtol=1e-4)


@pytest.mark.parametrize("order", ["gray half period", "gray inverse", "frequencies"])
@pytest.mark.parametrize("axis", list(Axis))
def test_coordinates_and_their_variance_are_right(order, axis):
    extent = 512 if axis is Axis.COLUMN else 320
    truth = ramp() * (extent / 512)
    patterns = list(fringe_patterns(axis, period=32.0, steps=8, origin_rad=0.7))
    if order == "frequencies":
        patterns += fringe_patterns(axis, period=160.0, steps=8) + fringe_patterns(
            axis, period=640.0, steps=8
        )
    else:
        bits = gray_patterns(axis, step=16.0, bits=6)
        patterns += bits + (
            gray_patterns(axis, step=16.0, bits=6, inverse=True) if "inverse" in order else []
        )
    plan = make_plan(patterns)
    frames = expose(plan, {axis: truth}, sigma=12)
    found = decode_frames(plan, frames)
    decoded = found.axes[axis]
    error = (decoded.coordinate - truth)[found.valid]
    assert found.valid.mean() > 0.999
    assert np.abs(error).max() < 3  # no wrong period, which would be 32
    theory = np.sqrt(2 / 8) * 12 / 300 * 32 / (2 * np.pi)
    assert np.std(error) == pytest.approx(theory, rel=0.03)
    z = error / np.sqrt(decoded.variance[found.valid])
    assert np.std(z) == pytest.approx(1, abs=0.05)
    assert abs(np.mean(z)) < 0.1


def test_noise_is_recovered_from_the_residual_despite_harmonics():
    plan = make_plan(fringe_patterns(Axis.COLUMN, period=600.0, steps=8))
    truth = ramp()
    frames = expose(plan, {Axis.COLUMN: truth})
    random = np.random.default_rng(1)
    for number, frame_id in enumerate(frames):
        harmonic = 6 * np.cos(2 * (2 * np.pi * truth / 600 + 2 * np.pi * number / 8))
        noise = random.normal(0, np.sqrt(4 + 0.05 * frames[frame_id]))
        frames[frame_id] = np.round(frames[frame_id] + harmonic + noise).astype(np.uint16)
    fringes = find_fringes(plan)
    found = estimate_noise([(f, np.stack([frames[i] for i in f.frame_ids])) for f in fringes])
    # The mean level is 400 at every pixel, where the variance is 4 + 0.05 * 400 + 1/12.
    assert found.variance(np.array([400.0]))[0] == pytest.approx(24.1, rel=0.05)


def test_noise_of_three_steps_comes_from_the_means_of_several_fringes():
    patterns = fringe_patterns(Axis.COLUMN, period=32.0, steps=3) + fringe_patterns(
        Axis.COLUMN, period=640.0, steps=3
    )
    plan = make_plan(patterns)
    frames = expose(plan, {Axis.COLUMN: ramp()}, sigma=5)
    fringes = find_fringes(plan)
    found = estimate_noise([(f, np.stack([frames[i] for i in f.frame_ids])) for f in fringes])
    assert found.variance(np.array([400.0]))[0] == pytest.approx(25.1, rel=0.06)


def test_gray_words_become_cells():
    cells = np.arange(4096, dtype=np.int32).reshape(64, 64)
    np.testing.assert_array_equal(gray_to_cell(cells ^ (cells >> 1)), cells)


def test_reasons_of_rejection():
    plan = make_plan(fringe_patterns(Axis.COLUMN, period=600.0, steps=8))
    frames = expose(plan, {Axis.COLUMN: ramp()}, sigma=3)
    for number, frame in enumerate(frames.values()):
        frame[:50] = 200 + number % 2
        frame[60:100, :10] = 1023
    found = decode_frames(plan, frames)
    assert (found.rejection[:50] & Rejection.LOW_MODULATION).all()
    assert (found.rejection[60:100, :10] & Rejection.SATURATED).all()
    assert not found.rejection[100:].any()
    assert np.isnan(found.axes[Axis.COLUMN].coordinate[:50]).all()


def test_a_dark_capture_is_refused_with_advice():
    plan = make_plan(fringe_patterns(Axis.COLUMN, period=600.0, steps=4))
    frames = expose(plan, {Axis.COLUMN: ramp()}, mean=8, modulation=0, sigma=1.5)
    with pytest.raises(DecodingError, match="projector shows its patterns"):
        decode_frames(plan, frames, minimum_modulation=10.0)


def test_orders_that_nothing_tells_are_refused():
    plan = make_plan(fringe_patterns(Axis.COLUMN, period=32.0, steps=4))
    with pytest.raises(DecodingError, match="fringe order"):
        decode_frames(plan, expose(plan, {Axis.COLUMN: ramp()}))


def test_two_steps_are_refused():
    plan = make_plan(fringe_patterns(Axis.COLUMN, period=600.0, steps=4)[:2])
    with pytest.raises(DecodingError, match="do not determine a phase"):
        decode_frames(plan, expose(plan, {Axis.COLUMN: ramp()}))


def test_a_missing_gray_bit_is_refused():
    plan = make_plan(
        fringe_patterns(Axis.COLUMN, period=32.0, steps=4)
        + gray_patterns(Axis.COLUMN, step=16.0, bits=6)[:4]
    )
    with pytest.raises(DecodingError, match=r"bits \[4, 5\]"):
        decode_frames(plan, expose(plan, {Axis.COLUMN: ramp()}))


def test_two_gray_codes_of_one_axis_are_refused():
    codes = gray_patterns(Axis.COLUMN, step=16.0, bits=6) + gray_patterns(
        Axis.COLUMN, step=8.0, bits=7
    )
    plan = make_plan(fringe_patterns(Axis.COLUMN, period=32.0, steps=4) + codes)
    with pytest.raises(DecodingError, match="2 different Gray codes"):
        decode_frames(plan, expose(plan, {Axis.COLUMN: ramp()}))


def test_a_gray_bit_that_contradicts_the_phase_is_rejected():
    truth = ramp()
    plan = make_plan(
        fringe_patterns(Axis.COLUMN, period=32.0, steps=8)
        + gray_patterns(Axis.COLUMN, step=16.0, bits=6)
    )
    frames = expose(plan, {Axis.COLUMN: truth}, sigma=3)
    last = plan.frames[-1].id
    frames[last][:40] = 800 - frames[last][:40]
    found = decode_frames(plan, frames)
    flipped = found.rejection[:40] & Rejection.WRONG_ORDER != 0
    # The last bit moves the cell by one, which contradicts the phase but near the cell's edges.
    assert flipped.mean() > 0.4
    assert not (found.rejection[40:] & Rejection.WRONG_ORDER).any()
    error = np.abs(found.axes[Axis.COLUMN].coordinate - truth)
    assert np.nanmax(error[40:]) < 1
