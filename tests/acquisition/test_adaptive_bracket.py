from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from acquisition.adaptive_bracket import AdaptiveBracket
from acquisition.journal import SkipReason
from acquisition.plan import Bracketing

BLACK, CEILING = 32, 1023
LADDER = (0.01, 0.03, 0.09, 0.27)


def expose(radiance, exposure_s):
    """Noise-free sensor numbers."""
    return np.minimum(np.round(BLACK + radiance * exposure_s), CEILING).astype(np.uint16)


def choose(radiance, *, rule=None, ladder=LADDER):
    """Exposures that an adaptive bracket takes of a scene, and what it said of the others."""
    bracket = AdaptiveBracket(
        rule or Bracketing(least_share=0), black_level=BLACK, saturation_level=CEILING
    )
    taken, skipped = [], {}
    for exposure, following in zip(ladder, (*ladder[1:], None), strict=True):
        need = bracket.need_of(exposure, next_s=following)
        if need.needed:
            bracket.add(expose(radiance, exposure), exposure)
            taken.append(exposure)
        else:
            skipped[exposure] = need
    return taken, skipped


def served(radiance, exposures, rule):
    """Which pixels some exposure gives enough signal without coming near saturation."""
    span = CEILING - BLACK
    signals = np.stack([radiance * exposure for exposure in exposures])
    return ((signals >= rule.least_signal * span) & (signals <= rule.headroom * span)).any(axis=0)


def test_no_fewer_exposures_serve_as_many_pixels():
    """Held against every subset of the ladder that holds its shortest exposure."""
    random = np.random.default_rng(5)
    rule = Bracketing(least_share=0)
    for _ in range(60):
        radiance = np.exp(random.uniform(np.log(1e3), np.log(8e4), (1, random.integers(1, 4))))
        taken, _ = choose(radiance, rule=rule)
        reachable = served(radiance, LADDER, rule)
        # Only the shortest may count above the headroom: it is taken anyhow, and did not saturate.
        first = (radiance * LADDER[0] > rule.headroom * (CEILING - BLACK)) & reachable
        assert (served(radiance, taken, rule) | first | ~reachable).all()
        for count in range(1, len(taken)):
            for others in combinations(LADDER[1:], count - 1):
                fewer = served(radiance, (LADDER[0], *others), rule)
                assert not (fewer | ~reachable | first).all()


def test_a_dim_scene_takes_the_shortest_and_the_longest():
    taken, skipped = choose(np.full((4, 4), 1000.0))
    assert taken == [0.01, 0.27]
    assert [need.reason for need in skipped.values()] == [SkipReason.SERVED] * 2


def test_a_bright_scene_takes_the_shortest_alone():
    taken, skipped = choose(np.full((4, 4), 60_000.0))
    assert taken == [0.01]
    assert all(need.saturating == 16 for need in skipped.values())


def test_what_lacks_signal_and_would_saturate_is_said_to():
    # Ratios so wide that no exposure of the ladder suits.
    taken, skipped = choose(np.full((4, 4), 20_000.0), ladder=(0.01, 0.2))
    assert taken == [0.01]
    assert skipped[0.2].reason is SkipReason.SATURATED
    assert (skipped[0.2].pixels, skipped[0.2].lacking, skipped[0.2].saturating) == (0, 16, 16)


@pytest.mark.parametrize(("pixels", "taken"), [(4, False), (6, True)])
def test_a_few_pixels_do_not_cost_an_exposure(pixels, taken):
    radiance = np.full(10_000, 60_000.0)
    radiance[:pixels] = 1000.0
    exposures, skipped = choose(radiance.reshape(100, 100), rule=Bracketing(least_share=5e-4))
    assert (0.27 in exposures) is taken
    if not taken:
        assert skipped[0.27].pixels == pixels


def test_pixels_saturated_in_the_shortest_exposure_ask_for_nothing():
    taken, _ = choose(np.full((4, 4), 1e6))
    assert taken == [0.01]


def test_frames_are_not_altered():
    frame = expose(np.full((4, 4), 1000.0), 0.01)
    kept = frame.copy()
    bracket = AdaptiveBracket(Bracketing(), black_level=BLACK, saturation_level=CEILING)
    bracket.add(frame, 0.01)
    bracket.add(expose(np.full((4, 4), 1000.0), 0.09), 0.09)
    np.testing.assert_array_equal(frame, kept)
