"""Metering and the choice of frames, on a scene whose light is known pixel by pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from acquisition.decoding import decode
from acquisition.errors import SessionError
from acquisition.even_steps import even_steps, metering_steps, step_counts
from acquisition.frame_choice import choose_frames
from acquisition.fringes import find_fringes
from acquisition.journal import SkipReason
from acquisition.metering import measure_light, metering_exposure
from acquisition.patterns import Axis, Gray, PhaseShift, pattern_profile
from acquisition.plan import Metering, Plan
from acquisition.scan_plan import plan_structured_light

WIDTH, HEIGHT = 320, 64
BLACK, GAIN, READ, CEILING = 40.0, 0.4, 2.0, 4095
EXPOSURES = (0.01, 0.03, 0.09)


class Scene:
    """Every pixel sees the panel's column of its own number; light per second by column."""

    def __init__(self, white, ambient=200.0, gamma=1.0, seed=0):
        self.white = np.broadcast_to(np.asarray(white, float), (HEIGHT, WIDTH))
        self.ambient, self.gamma = ambient, gamma
        self.random = np.random.default_rng(seed)

    def radiance(self, pattern):
        rows, cols = np.mgrid[:HEIGHT, :WIDTH]
        along = rows if getattr(pattern, "axis", None) is Axis.ROW else cols
        shown = pattern_profile(pattern, along.astype(float)) ** self.gamma
        return self.ambient + self.white * shown

    def take(self, frame, true_s=None):
        mean = self.radiance(frame.pattern) * (true_s or frame.exposure_s)
        noise = self.random.normal(0, np.sqrt(READ**2 + GAIN * mean))
        return np.clip(np.round(BLACK + mean + noise), 0, CEILING).astype(np.uint16)


def plan_of(exposures=EXPOSURES, axes=(Axis.COLUMN,), periods=(16.3,), steps=8, **rule):
    return plan_structured_light(
        camera_size=(WIDTH, HEIGHT),
        projector_size=(WIDTH, HEIGHT),
        saturation_level=CEILING,
        exposure_s=exposures,
        axes=axes,
        periods_px=periods,
        steps=steps,
        metering=Metering(**rule),
    )


def metered(plan, scene):
    frames = {}

    def read(name):
        if name not in frames:
            frames[name] = scene.take(next(f for f in plan.frames if f.id == name))
        return frames[name]

    exposure = metering_exposure(plan, read)
    light = measure_light(plan, read, exposure_s=exposure)
    chosen = choose_frames(plan, light, exposure_s=exposure)
    return light, chosen, read, exposure


def taken(plan, chosen):
    return plan.model_copy(
        update={
            "frames": tuple(f for f in plan.frames if f.id not in chosen or chosen[f.id].needed)
        }
    )


def counts(plan, chosen, kind=PhaseShift):
    kept = [f for f in taken(plan, chosen).frames if isinstance(f.pattern, kind)]
    return tuple(sum(f.exposure_s == e for f in kept) for e in EXPOSURES)


def test_light_is_measured_as_it_is():
    white = np.geomspace(1e3, 6e5, WIDTH)
    light, _, _, exposure = metered(plan_of(), scene=Scene(white))
    # White saturates less than half of the pixels there.
    assert exposure == 0.09
    assert light.black_level == pytest.approx(BLACK, abs=0.2)
    assert light.noise.gain == pytest.approx(GAIN, rel=0.1)
    dark = light.black.reshape(HEIGHT, WIDTH)
    assert np.median(dark) == pytest.approx(200.0, rel=0.02)
    bright = light.white.reshape(HEIGHT, WIDTH).mean(axis=0)
    seen = 0.01 * (white + 200) + BLACK < 0.98 * CEILING
    assert 0.9 < seen.mean() < 1
    assert bright[seen] == pytest.approx(white[seen] + 200, rel=0.02)
    modulation = light.fringes[0].modulation.reshape(HEIGHT, WIDTH).mean(axis=0)
    # Also where the metered fringe was saturated itself: by white less black.
    clear = seen & (white > 5e3)
    assert modulation[clear] == pytest.approx(white[clear] / 2, rel=0.03)


def test_lying_exposures_are_seen_through():
    scene = Scene(np.geomspace(3e3, 8e4, WIDTH))
    plan = plan_of(exposures=(0.01, 0.03))
    lies = {0.01: 0.0087, 0.03: 0.03}
    frames = {f.id: scene.take(f, lies[f.exposure_s]) for f in plan.frames}
    light = measure_light(plan, frames.__getitem__, exposure_s=0.03)
    assert light.exposures_s[0.01] == pytest.approx(0.0087, rel=0.005)


@pytest.mark.parametrize("white", [4e3, 2e4, 8e4])
def test_the_predicted_variance_is_that_of_decoding(white):
    plan = plan_of()
    light, chosen, read, _ = metered(plan, Scene(white))
    part = taken(plan, chosen)
    found = decode(part, read)
    error = found.axes[Axis.COLUMN].coordinate - np.arange(WIDTH)
    total = 0
    for fringe in find_fringes(part):
        own, _ = light.information_per_step(light.fringes[0], fringe.exposure_s)
        total = total + fringe.steps * own
    predicted = np.sqrt(1 / np.median(total))
    inside = error[:, 8:-8]
    # How noise grows with light is hardly told by a single grey.
    assert np.nanstd(inside) == pytest.approx(predicted, rel=0.05)


@pytest.mark.parametrize("white", [2e3, 2e4, 9e4, np.geomspace(2e3, 2e5, WIDTH)])
@pytest.mark.parametrize("sigma", [0.02, 0.1])
def test_pixels_get_their_target_or_nearly_what_they_can_have(white, sigma):
    plan = plan_of(column_sigma_px=sigma)
    _, chosen, read, _ = metered(plan, Scene(white))
    kept, full = decode(taken(plan, chosen), read), decode(plan, read)
    both = kept.valid & full.valid
    assert both.sum() > 0.999 * full.valid.sum()
    got, could = (np.sqrt(m.axes[Axis.COLUMN].variance[both].astype(float)) for m in (kept, full))
    # Variances of decoding follow the noise of the samples by some percent.
    enough = (got < 1.1 * sigma) | (got < 1.1 * could)
    assert enough.mean() > 0.98


def test_bright_pixels_want_short_exposures_and_dark_ones_long_ones():
    # The longest is metered if it does not saturate, and no more than that is needed then.
    plan = plan_of(column_sigma_px=0.1)
    _, dim, _, _ = metered(plan, Scene(2e4))
    assert counts(plan, dim) == (0, 0, 4)
    _, bright, _, exposure = metered(plan, Scene(2.5e5))
    assert exposure == 0.01
    assert counts(plan, bright) == (4, 0, 0)
    assert {bright[f.id].reason for f in plan.frames[-8:] if not bright[f.id].needed} <= {
        SkipReason.ORDER_KNOWN
    }
    fringes = [f for f in plan.frames if isinstance(f.pattern, PhaseShift) and f.exposure_s == 0.09]
    for frame in fringes:
        assert bright[frame.id].reason is SkipReason.SATURATED
        assert bright[frame.id].saturating == WIDTH * HEIGHT
        assert bright[frame.id].pixels == 0
    mixed = np.where(np.arange(WIDTH) < 30, 2.5e5, 4e3)
    _, both, _, _ = metered(plan_of(column_sigma_px=0.1), Scene(mixed))
    short, _, long = counts(plan, both)
    assert short >= 4
    assert long >= 4
    needed = [both[f.id].pixels for f in fringes if both[f.id].needed]
    assert max(needed) == 290 * HEIGHT
    assert min(needed) > 0


def test_nothing_that_is_taken_could_be_left_out_too():
    plan = plan_of(column_sigma_px=0.03)
    light, chosen, _, exposure = metered(plan, Scene(np.geomspace(2e3, 2e5, WIDTH)))
    pixels = {}
    for frame in plan.frames:
        if isinstance(frame.pattern, PhaseShift) and chosen[frame.id].needed:
            pixels[frame.exposure_s, chosen[frame.id].pixels] = frame.exposure_s
    least = Metering().least_share * WIDTH * HEIGHT
    assert all(count > least or held == exposure for (held, count) in pixels)
    assert light.exposures_s


def test_few_pixels_want_no_exposure_of_their_own():
    few = np.full(WIDTH, 4e3)
    glint = np.broadcast_to(few, (HEIGHT, WIDTH)).copy()
    glint[5, 100:108] = 2.5e5
    plan = plan_of(column_sigma_px=0.1)
    _, chosen, _, _ = metered(plan, Scene(glint))
    assert counts(plan, chosen)[0] == 0
    skipped = next(f for f in plan.frames if f.exposure_s == 0.01 and f.id in chosen)
    assert chosen[skipped.id].pixels == 8


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("white", "ambient"), [(0.0, 200.0), (1e9, 200.0), (2e4, 1e9), (0.0, 0.0)])
@pytest.mark.parametrize("periods", [(16.3,), (320.0, 40.0)])
def test_a_scene_without_any_light_or_with_too_much_is_no_reason_to_fail(white, ambient, periods):
    """What cannot be decoded needs nothing; decoding will say why nothing was."""
    plan = plan_of(periods=periods)
    light, chosen, _, _ = metered(plan, Scene(white, ambient=ambient))
    assert not np.isnan(light.white).any()
    assert not np.isnan(light.fringes[0].modulation).any()
    steps = [f for f in taken(plan, chosen).frames if isinstance(f.pattern, PhaseShift)]
    assert len(steps) == 4 * len(periods)
    # Noise alone may look like a fringe to a few of them.
    assert all(chosen[f.id].pixels <= 5e-4 * WIDTH * HEIGHT for f in steps)


def test_a_mosaic_is_metered_pixel_by_pixel():
    rows, cols = np.mgrid[:HEIGHT, :WIDTH]
    white = np.where((rows + cols) % 2, 3e4, 5e3)
    light, chosen, read, _ = metered(plan_of(column_sigma_px=0.1), Scene(white))
    assert light.noise.gain == pytest.approx(GAIN, rel=0.1)
    assert light.white.reshape(white.shape)[0, :2] == pytest.approx([5.2e3, 3.02e4], rel=0.05)
    found = decode(taken(plan_of(column_sigma_px=0.1), chosen), read)
    assert found.valid.mean() > 0.95


def test_gray_code_is_taken_at_as_few_exposures_as_its_bits_can_be_read_at():
    plan = plan_of()
    for white in (2e3, 2e4, 2.5e5, np.geomspace(1e3, 2.5e5, WIDTH)):
        _, chosen, read, _ = metered(plan, Scene(white))
        bits = counts(plan, chosen, Gray)
        assert sum(bits) == max(bits)
        part = decode(taken(plan, chosen), read)
        error = np.abs(part.axes[Axis.COLUMN].coordinate - np.arange(WIDTH))
        assert (error[part.valid] < 4).all()


def test_a_fringe_that_no_order_needs_is_left_out_and_one_that_it_needs_is_not():
    bright = plan_of(axes=(Axis.COLUMN,), periods=(320.0, 80.0, 20.0), column_sigma_px=0.05)

    def periods(scene):
        _, chosen, read, _ = metered(bright, scene)
        found = decode(taken(bright, chosen), read)
        error = np.abs(found.axes[Axis.COLUMN].coordinate - np.arange(WIDTH))[:, 4:-4]
        assert np.nanmax(error) < 10
        steps = {}
        for f in taken(bright, chosen).frames:
            if isinstance(f.pattern, PhaseShift):
                steps[f.pattern.period_px] = steps.get(f.pattern.period_px, 0) + 1
        return steps, chosen

    steps, chosen = periods(Scene(3e4))
    assert steps[320.0] == 4
    assert sum(steps.values()) < 0.35 * 3 * 24
    assert SkipReason.ORDER_KNOWN in {c.reason for c in chosen.values() if not c.needed}
    faint, _ = periods(Scene(600.0))
    assert sum(faint.values()) > sum(steps.values())


def test_steps_are_left_alone_where_fewer_let_harmonics_in():
    """A response of power 3 leaves some hundredths of a pixel with four steps."""
    for gamma, least in ((1.0, 4), (3.0, 8)):
        plan = plan_of(exposures=(0.09,), column_sigma_px=0.08, periods=(32.6,))
        light, chosen, _, _ = metered(plan, Scene(3e4, gamma=gamma))
        assert (light.fringes[0].systematic_px > 0.1) == (gamma == 3.0)
        needed = [f for f in plan.frames if f.id in chosen and chosen[f.id].needed]
        assert sum(isinstance(f.pattern, PhaseShift) for f in needed) == least


@pytest.mark.parametrize(
    ("steps", "allowed"),
    [(3, (3,)), (4, (4,)), (6, (6,)), (8, (4, 8)), (10, (5, 10)), (12, (4, 12)), (16, (4, 8, 16))],
)
def test_steps_are_chosen_so_that_they_stay_even(steps, allowed):
    fringe = find_fringes(plan_of(steps=steps))[0]
    rule = Metering()
    assert step_counts(fringe, rule) == allowed
    assert len(metering_steps(fringe, rule)) == allowed[0]
    for count in allowed:
        names = even_steps(fringe, count)
        assert set(metering_steps(fringe, rule)) <= set(names)
        shifts = np.sort(fringe.shifts_rad[[fringe.frame_ids.index(n) for n in names]])
        assert np.diff(shifts) == pytest.approx(2 * np.pi / count)
    uneven = replace(fringe, shifts_rad=fringe.shifts_rad**1.1)
    assert step_counts(uneven, rule) == (steps,)


def test_a_plan_that_cannot_be_metered_is_refused():
    plan = plan_of()
    for frames, message in (
        (plan.frames[1:], "takes white and black"),
        (plan.frames[::-1], "takes white and black"),
        (plan.frames[:6], "there are none"),
        (plan.frames[:-1], "the same exposures of every pattern"),
    ):
        with pytest.raises(ValidationError, match=message):
            Plan.model_validate(plan.model_dump() | {"frames": [f.model_dump() for f in frames]})
    with pytest.raises(SessionError, match="only once"):
        plan_of(exposures=(0.1, 0.1))


def test_a_metered_plan_reads_as_it_was_written():
    plan = plan_of(column_sigma_px=0.02, row_sigma_px=0.3)
    assert Plan.model_validate_json(plan.model_dump_json()) == plan
    assert plan.optional_frames == {f.id for f in plan.frames[6:]}
    assert "metering" not in plan.model_copy(update={"metering": None}).model_dump()
