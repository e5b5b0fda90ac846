from __future__ import annotations

import numpy as np
import pytest

from acquisition.correspondence import AxisCoordinate, CorrespondenceMap
from acquisition.patterns import Axis
from workstation.benchmarks import decode, decoding_captures


def relief_map(coordinate):
    there = np.isfinite(coordinate)
    axis = AxisCoordinate(
        coordinate,
        np.where(there, 0.01, np.inf).astype(np.float32),
        np.full(coordinate.shape, 50, np.float32),
        60.0,
        1.0,
    )
    rejection = np.where(there, 0, 2).astype(np.uint16)
    ambient = np.full(coordinate.shape, 100, np.float32)
    return CorrespondenceMap({Axis.COLUMN: axis}, ambient, rejection, (0, 0), 1.0)


def test_period_errors_on_a_relief_are_counted():
    col, row = np.meshgrid(np.arange(96.0), np.arange(72.0))
    smooth = 200 + 1.5 * col + 0.8 * row + 4 * np.sin(col / 9) * np.cos(row / 7)
    smooth += np.random.default_rng(0).normal(0, 0.2, smooth.shape)
    smooth[:24, :30] = np.nan
    assert decoding_captures._period_errors(relief_map(smooth))[0] == 0
    wrong = smooth.copy()
    wrong[50, 60] += 60
    wrong[30:33, 40:42] -= 120
    errors, checked = decoding_captures._period_errors(relief_map(wrong))
    assert errors == 7
    assert checked == np.isfinite(smooth).sum()


def test_a_smooth_surface_is_found_under_wrong_periods():
    col, row = np.meshgrid(np.linspace(-1, 1, 90), np.linspace(-1, 1, 70))
    board = 900 + 300 * col / (1 + 0.1 * row) + 5 * row**2
    wrong = board.copy()
    wrong[10:25, 30:60] += 114
    found = decoding_captures._smooth(wrong, np.ones(wrong.shape, bool))
    assert np.abs(found - board).max() < 3


def test_a_case_of_the_sweep_keeps_its_bounds():
    case = decode._Case(4, (1, 8, 64), 400.0, 8.0, 0.0)
    assert case.feasible
    assert case.phase_sigma == pytest.approx(np.sqrt(0.5 * (64 + 1 / 12)) / 400)
    outcome = decode._decode_case(case, 0)
    assert outcome is not None
    assert outcome.sigma_over_theory < 1.05
    assert outcome.sigma_over_predicted == pytest.approx(1, abs=0.05)
    assert outcome.gross == 0
    assert not decode._Case(3, (1, 16), 120.0, 20.0, 0.0).feasible


def test_times_are_the_best_of_what_was_run():
    calls = iter([0, 1, 2, 3])
    timer = decode._timer(lambda: next(calls))
    for _ in range(3):
        timer.run()
    assert timer.runs == 3
    assert timer.result == 3
    assert 0 < timer.best_s < 1


def test_real_captures_keep_their_bounds(real_data):
    records = decoding_captures.bench_captures(real_data)
    assert {record.name for record in records} == {
        "decode.accepted_wrong_period",
        "decode.relief_period_errors",
        "decode.swapped_files_accepted",
        "decode.gamma_phase_error",
    }
    assert [record.name for record in records if not record.holds] == []
