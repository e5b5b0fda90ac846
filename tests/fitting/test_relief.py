from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from synthetic_copy import make_copy, strokes

from fitting.copy_files import read_copy, write_copy
from fitting.errors import FittingError
from fitting.relief_classification import ReliefOptions, classify_relief, propose_threshold
from fitting.relief_picture import draw_relief


def test_the_histogram_parts_ground_and_relief():
    random = np.random.default_rng(0)
    ground = random.normal(0, 0.05, 90_000)
    relief = random.normal(1.5, 0.2, 10_000)
    proposed = propose_threshold(np.concatenate([ground, relief]), (0.0, 1.0))
    assert 0.3 < proposed < 1.0
    # Otsu's threshold by brute force.
    heights = np.concatenate([ground, relief])
    at = np.linspace(-0.1, 2.0, 300)
    within = [
        np.var(heights[heights <= t]) * np.mean(heights <= t)
        + np.var(heights[heights > t]) * np.mean(heights > t)
        for t in at
    ]
    spread = np.var(heights[heights <= proposed]) * np.mean(heights <= proposed)
    spread += np.var(heights[heights > proposed]) * np.mean(heights > proposed)
    assert spread < min(within) * 1.001


def test_proposals_keep_to_the_papers_shares_of_the_height():
    random = np.random.default_rng(1)
    low = np.concatenate([random.normal(0, 0.01, 9000), random.normal(0.1, 0.01, 1000), [1.0] * 50])
    highest = np.quantile(low, 0.9995)
    assert propose_threshold(low) == pytest.approx(0.2 * highest)
    assert propose_threshold(np.linspace(0, 1, 5000)) == pytest.approx(0.4, abs=0.01)
    assert propose_threshold(np.full(100, -1.0)) == 0
    assert propose_threshold(np.zeros(0)) == 0


def test_a_threshold_by_hand_is_reported_beside_the_proposal(tmp_path):
    by_hand = make_copy(strokes(), delta0_mm=1.7)
    proposed = make_copy(strokes())
    assert by_hand.relief.delta0_mm == 1.7
    assert by_hand.relief.proposed_delta0_mm == proposed.relief.delta0_mm
    assert by_hand.relief.proposed_delta0_mm == proposed.relief.proposed_delta0_mm
    write_copy(by_hand, tmp_path / "copy")
    loaded = read_copy(tmp_path / "copy").relief
    assert loaded.proposed_delta0_mm == by_hand.relief.proposed_delta0_mm


def test_errors_that_neighbours_share_take_a_wider_average():
    random = np.random.default_rng(2)
    rough = cv2.GaussianBlur(random.normal(0, 1, (200, 260)).astype(np.float32), (0, 0), 1.2)
    rough *= 0.11 / rough.std()
    field = make_copy(strokes(200, 260) / 6 + rough).height_field
    variance = np.full(field.shape, 0.11**2, np.float32)
    offset = np.arange(-3, 4)
    correlation = np.exp(-(offset[:, None] ** 2 + offset**2) / (4 * 1.2**2))
    shared = dataclasses.replace(field, variance=variance, correlation=correlation)
    white = dataclasses.replace(field, variance=variance)
    truth = strokes(200, 260) / 6
    # Taken for white, the noise of the average is thought small enough too soon.
    wrong = [
        classify_relief(f, ReliefOptions(delta0_mm=0.2)).significant[truth < 0.02].sum()
        for f in (shared, white)
    ]
    assert wrong[0] < 0.2 * wrong[1]


def test_thresholds_that_make_no_sense_are_refused():
    field = make_copy(strokes()).height_field
    with pytest.raises(FittingError, match="cell"):
        classify_relief(field, ReliefOptions(cell=0))
    with pytest.raises(FittingError, match="finite"):
        classify_relief(field, ReliefOptions(delta0_mm=float("nan")))


@pytest.mark.parametrize("shape", [(120, 160), (200, 90)])
def test_the_picture_shows_the_four_panels(tmp_path, shape):
    mask = np.ones(shape, bool)
    mask[50:60, 20:40] = False
    copy = make_copy(strokes(*shape), mask=mask)
    path = tmp_path / "relief.png"
    draw_relief(copy, path)
    picture = cv2.imread(str(path)).astype(int)
    assert min(picture.shape[:2]) > 400
    # Heights are in colour; boxes are orange (BGR) and frame about as many texels as they hold.
    colourful = np.ptp(picture, axis=2) > 60
    assert colourful.mean() > 0.05
    orange = (picture[..., 2] > 180) & (picture[..., 0] < 90)
    assert orange.any()
    assert [p.name for p in tmp_path.iterdir()] == ["relief.png"]


def test_a_flat_copy_has_a_picture_too(tmp_path):
    draw_relief(make_copy(np.zeros((20, 30))), tmp_path / "flat.png")
    assert cv2.imread(str(tmp_path / "flat.png")) is not None
