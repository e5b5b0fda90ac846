from __future__ import annotations

import numpy as np
import pytest
from synthetic_scan import expose, fringe_patterns, gray_patterns, make_plan

from acquisition.correspondence import Rejection
from acquisition.decoding import DecodingOptions, decode
from acquisition.errors import DecodingError
from acquisition.patterns import Axis
from acquisition.unwrapping import (
    UnwrappedAxis,
    certainty_sigmas,
    check_orders,
    wrong_order_probability,
)

PERIOD = 32.0


def ramp(width=320, height=240):
    col, row = np.meshgrid(np.arange(width), np.arange(height))
    return 20 + 1.4 * col + 0.11 * row


def axis_of(coordinate, *, sigma=0.1, period=PERIOD, extent=512):
    variance = np.full(coordinate.shape, sigma**2, np.float32)
    return UnwrappedAxis(coordinate, variance, period, extent)


def noisy(coordinate, *, sigma=0.1, seed=0):
    return coordinate + np.random.default_rng(seed).normal(0, sigma, coordinate.shape)


def test_the_probability_of_a_wrong_order_is_that_of_sampling():
    random = np.random.default_rng(0)
    ratio, sigma, pixels = 6.0, 0.2, 400_000
    coarse, fine = random.normal(0, sigma, (2, pixels)) / (2 * np.pi)
    wrong = np.round(ratio * coarse - fine) != 0
    expected = wrong_order_probability(sigma, ratio)
    assert np.mean(wrong) == pytest.approx(expected, abs=5 * np.sqrt(expected / pixels))
    spread = sigma / (2 * np.pi) * np.sqrt(1 + ratio**2)
    assert certainty_sigmas(expected) == pytest.approx(0.5 / spread)


def test_smooth_coordinates_are_left_alone():
    truth = noisy(ramp())
    truth[50:60, 70:90] = np.nan
    before = truth.copy()
    check = check_orders({Axis.COLUMN: axis_of(truth)})
    np.testing.assert_array_equal(check.coordinates[Axis.COLUMN], before)
    assert not check.wrong.any()
    assert check.repaired_pixels == 0


def test_orders_that_all_neighbours_contradict_are_repaired():
    truth = noisy(ramp())
    wrong = truth.copy()
    wrong[100:120, 150:170] -= 2 * PERIOD  # a patch
    wrong[30, 40] += PERIOD  # a pixel
    wrong[200:203, 10:12] += 3 * PERIOD
    before = wrong.copy()
    check = check_orders({Axis.COLUMN: axis_of(wrong)})
    np.testing.assert_allclose(check.coordinates[Axis.COLUMN], truth, atol=1e-9)
    assert check.repaired_pixels == 20 * 20 + 1 + 6
    assert not check.wrong.any()
    np.testing.assert_array_equal(wrong, before)  # the input is not touched


def test_a_patch_behind_a_gap_of_rejected_pixels_is_repaired():
    truth = noisy(ramp())
    wrong = truth.copy()
    wrong[100:120, 150:170] += PERIOD
    for edge in (99, 120):
        wrong[edge, 149:171] = np.nan
    wrong[99:121, [149, 170]] = np.nan
    check = check_orders({Axis.COLUMN: axis_of(wrong)})
    there = np.isfinite(wrong)
    np.testing.assert_allclose(check.coordinates[Axis.COLUMN][there], truth[there], atol=1e-9)


def test_a_steep_surface_seen_through_gaps_is_not_moved_by_its_own_slope():
    """Three pixels on, the coordinate is half a period further: that is no wrong order."""
    truth = noisy(50 + 1.9 / 1.4 * ramp(), sigma=0.3)
    truth[np.random.default_rng(4).random(truth.shape) < 0.75] = np.nan
    check = check_orders({Axis.COLUMN: axis_of(truth, sigma=0.3, period=10.24, extent=1280)})
    np.testing.assert_array_equal(check.coordinates[Axis.COLUMN], truth)
    assert check.repaired_pixels == 0


def test_both_axes_must_go_on_across_a_repair():
    column, row = noisy(ramp()), noisy(ramp().T[:240, :240] @ np.eye(240, 320), seed=1)
    row = np.linspace(0, 300, 240)[:, np.newaxis] + np.zeros((240, 320))
    stepped = column.copy()
    stepped[100:120, 150:170] += PERIOD
    other = row.copy()
    other[100:120, 150:170] += 9.0  # the row jumps too, by no whole period: a real step
    check = check_orders({Axis.COLUMN: axis_of(stepped), Axis.ROW: axis_of(other, extent=320)})
    np.testing.assert_array_equal(check.coordinates[Axis.COLUMN], stepped)
    check = check_orders({Axis.COLUMN: axis_of(stepped), Axis.ROW: axis_of(row, extent=320)})
    np.testing.assert_allclose(check.coordinates[Axis.COLUMN], column, atol=1e-9)


def test_a_real_step_is_no_wrong_order():
    truth = noisy(ramp())
    truth[100:140, 150:200] += 1.4 * PERIOD
    check = check_orders({Axis.COLUMN: axis_of(truth)})
    assert check.repaired_pixels == 0
    assert not check.wrong.any()


def test_single_pixels_that_fit_nowhere_are_rejected():
    truth = noisy(ramp())
    truth[30, 40] += 0.6 * PERIOD
    truth[0, 0] += PERIOD  # two neighbours are too few to repair by
    check = check_orders({Axis.COLUMN: axis_of(truth)})
    assert check.wrong[30, 40]
    assert check.wrong[0, 0]
    assert check.rejected_pixels == 2


def test_repairs_off_the_panel_are_rejected():
    truth = noisy(ramp())
    wrong = truth.copy()
    wrong[:, 312:] -= PERIOD  # belongs at coordinates beyond 457
    check = check_orders({Axis.COLUMN: axis_of(wrong, extent=470)})
    moved = truth[:, 312:] > 469.5
    assert 0.1 < moved.mean() < 0.9
    np.testing.assert_array_equal(check.wrong[:, 312:], moved)
    assert not check.wrong[:, :312].any()


@pytest.mark.parametrize("periods", [-2, 1])
@pytest.mark.parametrize("both_axes", [False, True])
def test_a_frame_that_stands_whole_periods_before_its_wall_is_kept(periods, both_axes):
    """The step of a surface may be worth whole periods by chance, all along the frame."""
    column = noisy(ramp())
    column[40:200, 60:260] += periods * PERIOD
    axes = {Axis.COLUMN: axis_of(column)}
    if both_axes:
        axes[Axis.ROW] = axis_of(noisy(20 + 1.1 * np.indices((240, 320))[0].astype(float), seed=1))
    check = check_orders(axes)
    np.testing.assert_array_equal(check.coordinates[Axis.COLUMN], column)
    assert not check.wrong.any()


@pytest.mark.parametrize("periods", [-2, 1])
def test_an_upright_frame_that_stands_whole_periods_before_its_wall_is_kept(periods):
    """Most of its border runs along the fringes, as that of a wrong code does."""
    column = noisy(60 + 1.1 * np.indices((240, 320))[1].astype(float))
    column[10:230, 120:180] += periods * PERIOD
    row = noisy(20 + 1.1 * np.indices((240, 320))[0].astype(float), seed=1)
    check = check_orders({Axis.COLUMN: axis_of(column), Axis.ROW: axis_of(row, extent=320)})
    np.testing.assert_array_equal(check.coordinates[Axis.COLUMN], column)
    assert not check.wrong.any()


def test_an_upright_frame_in_a_larger_picture_is_kept():
    """Only some of its lines are looked at."""
    column = noisy(60 + 0.5 * np.indices((900, 600))[1].astype(float))
    column[60:840, 150:450] += PERIOD
    check = check_orders({Axis.COLUMN: axis_of(column)})
    np.testing.assert_array_equal(check.coordinates[Axis.COLUMN], column)


def test_a_board_that_stands_whole_periods_before_its_wall_in_both_axes_is_kept():
    """Its edges run along the fringes, as those of a wrong code do; but no code makes both jump."""
    column = noisy(60 + 1.1 * np.indices((240, 320))[1].astype(float))
    row = noisy(20 + 1.1 * np.indices((240, 320))[0].astype(float), seed=1)
    column[100:140, 20:300] -= 2 * PERIOD
    row[100:140, 20:300] += PERIOD
    check = check_orders({Axis.COLUMN: axis_of(column), Axis.ROW: axis_of(row, extent=320)})
    np.testing.assert_array_equal(check.coordinates[Axis.COLUMN], column)
    np.testing.assert_array_equal(check.coordinates[Axis.ROW], row)
    assert not check.wrong.any()


def test_uncertain_orders_need_neighbours():
    truth = noisy(ramp())
    truth[:, 100:110] = np.nan
    truth[50:52, 104:106] = ramp()[50:52, 104:106]  # four pixels on their own
    uncertain = np.zeros(truth.shape, np.uint16)
    uncertain[40:60] = 1
    check = check_orders({Axis.COLUMN: axis_of(truth)}, uncertain=uncertain)
    expected = np.zeros(truth.shape, bool)
    expected[50:52, 104:106] = True
    np.testing.assert_array_equal(check.wrong, expected)


def swapped(frames, plan, axis, first, second):
    ids = {f.pattern.bit: f.id for f in plan.frames if f.pattern.kind == "gray"}
    exchanged = dict(frames)
    exchanged[ids[first]], exchanged[ids[second]] = frames[ids[second]], frames[ids[first]]
    return exchanged


@pytest.mark.parametrize("axis", list(Axis))
@pytest.mark.parametrize("pair", [(0, 1), (1, 2), (0, 3), (2, 4)])
def test_swapped_gray_files_are_refused_by_name(axis, pair):
    extent = 512 if axis is Axis.COLUMN else 320
    patterns = fringe_patterns(axis, period=32.0, steps=4)
    patterns += gray_patterns(axis, step=16.0, bits=6)
    plan = make_plan(patterns)
    frames = expose(plan, {axis: ramp() * (extent / 512)}, sigma=3)
    assert decode(plan, frames.__getitem__).valid.mean() > 0.99
    with pytest.raises(DecodingError, match=f"{axis}s.*taken for one another"):
        decode(plan, swapped(frames, plan, axis, *pair).__getitem__)


@pytest.mark.parametrize(("pair", "periods"), [((0, 1), -2), ((0, 2), 2)])
def test_swapped_gray_files_are_refused_behind_an_upright_frame_too(pair, periods):
    """Its upper and lower sides run across the fringes, and may be worth whole periods as well."""
    column = 100 + 1.1 * np.indices((240, 320))[1].astype(float)
    column[66:, 100:250] += periods * PERIOD
    patterns = fringe_patterns(Axis.COLUMN, period=PERIOD, steps=4)
    plan = make_plan(patterns + gray_patterns(Axis.COLUMN, step=16.0, bits=5))
    frames = expose(plan, {Axis.COLUMN: column}, sigma=2)
    assert decode(plan, frames.__getitem__).valid.mean() > 0.99
    with pytest.raises(DecodingError, match=r"columns.*taken for one another"):
        decode(plan, swapped(frames, plan, Axis.COLUMN, *pair).__getitem__)


def test_wrong_periods_of_noisy_fringes_are_repaired_or_rejected():
    truth = ramp()
    patterns = fringe_patterns(Axis.COLUMN, period=16.0, steps=4)
    patterns += fringe_patterns(Axis.COLUMN, period=512.0, steps=4)
    plan = make_plan(patterns)
    # The coarse phase is so noisy that one order in fifty is wrong.
    frames = expose(plan, {Axis.COLUMN: truth}, sigma=14, modulation=250)
    free = decode(
        plan,
        frames.__getitem__,
        DecodingOptions(check_neighbours=False, wrong_order_probability=0.2),
    )
    gross = np.abs(free.axes[Axis.COLUMN].coordinate - truth)[free.valid] > 8
    assert 0.005 < gross.mean() < 0.1
    found = decode(plan, frames.__getitem__, DecodingOptions(borne_out_probability=0.2))
    error = np.abs(found.axes[Axis.COLUMN].coordinate - truth)[found.valid]
    assert found.valid.mean() > 0.97
    assert np.mean(error > 8) < 1e-4
    # By itself no pixel is certain enough.
    alone = decode_or_nothing(plan, frames, DecodingOptions(check_neighbours=False))
    assert alone < 0.2


def decode_or_nothing(plan, frames, options):
    try:
        return decode(plan, frames.__getitem__, options).valid.mean()
    except DecodingError:
        return 0.0


def test_the_limit_on_wrong_orders_is_kept():
    truth = ramp()
    patterns = fringe_patterns(Axis.COLUMN, period=32.0, steps=3)
    patterns += fringe_patterns(Axis.COLUMN, period=512.0, steps=3)
    plan = make_plan(patterns)
    for limit, modulations in ((0.03, (120, 130, 140)), (0.003, (165, 175, 190))):
        options = DecodingOptions(check_neighbours=False, wrong_order_probability=limit)
        wrong = accepted = 0
        for modulation in modulations:
            frames = expose(
                plan, {Axis.COLUMN: truth}, sigma=13, modulation=modulation, seed=modulation
            )
            found = decode(plan, frames.__getitem__, options)
            error = np.abs(found.axes[Axis.COLUMN].coordinate - truth)[found.valid]
            wrong, accepted = wrong + np.sum(error > 16), accepted + len(error)
        assert accepted > 10_000
        assert wrong / accepted <= limit
        assert wrong > 0  # the limit is near what is met


def test_repairs_are_told_from_rejections_in_the_map():
    truth = ramp()
    plan = make_plan(
        fringe_patterns(Axis.COLUMN, period=32.0, steps=8)
        + gray_patterns(Axis.COLUMN, step=16.0, bits=6)
    )
    frames = expose(plan, {Axis.COLUMN: truth}, sigma=3)
    # One patch shows the code of 12 periods on, off the panel, another that of 4 periods on.
    for rows, periods in ((slice(100, 110), 12), (slice(150, 160), 4)):
        elsewhere = expose(plan, {Axis.COLUMN: truth + 32.0 * periods}, sigma=3)
        for frame_id, frame in frames.items():
            frame[rows, 100:110] = elsewhere[frame_id][rows, 100:110]
    found = decode(plan, frames.__getitem__)
    error = np.abs(found.axes[Axis.COLUMN].coordinate - truth)
    assert np.nanmax(error) < 1
    assert found.valid.mean() > 0.999
    loose = decode(plan, frames.__getitem__, DecodingOptions(check_neighbours=False))
    assert (loose.rejection[100:110, 100:110] == Rejection.OUT_OF_RANGE).all()
    assert (np.abs(loose.axes[Axis.COLUMN].coordinate - truth)[150:160, 100:110] > 30).all()
    assert not (loose.rejection & Rejection.MIXED_LIGHT).any()
