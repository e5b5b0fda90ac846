from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import median_abs_deviation, norm

from acquisition.robust_spread import (
    MEDIAN_TO_SIGMA,
    nan_robust_sigma,
    robust_sigma,
    robust_spread,
)


@pytest.fixture(scope="module")
def normal_scores():
    """Quantiles of a standard normal distribution: a sample without chance."""
    return norm.ppf((np.arange(2001) + 0.5) / 2001)


def test_the_constant_is_one_over_the_upper_quartile_of_a_normal_distribution():
    assert pytest.approx(1 / norm.ppf(0.75), abs=5e-5) == MEDIAN_TO_SIGMA


def test_the_standard_deviation_of_normal_samples_is_found(normal_scores):
    assert robust_sigma(3.0 * normal_scores) == pytest.approx(3.0, rel=1e-3)
    assert robust_spread(40.0 + 3.0 * normal_scores) == pytest.approx(3.0, rel=1e-3)


def test_about_the_median_it_is_what_scipy_finds():
    samples = np.random.default_rng(5).gamma(2.0, size=500)
    assert robust_spread(samples) == pytest.approx(
        median_abs_deviation(samples, scale="normal"), rel=2e-5
    )


def test_residuals_about_zero_keep_what_they_share(normal_scores):
    shifted = normal_scores + 100.0
    assert robust_sigma(shifted) == pytest.approx(MEDIAN_TO_SIGMA * 100.0)
    assert robust_spread(shifted) == pytest.approx(1.0, rel=1e-3)


def test_outliers_hardly_count(normal_scores):
    spoiled = normal_scores.copy()
    spoiled[-100:] = 1e9
    assert robust_sigma(spoiled) == pytest.approx(1.0, rel=0.01)
    assert robust_spread(spoiled) == pytest.approx(1.0, rel=0.1)
    assert np.std(spoiled) > 1e8


def test_along_an_axis_each_column_has_its_own(normal_scores):
    columns = normal_scores[:, np.newaxis] * np.array([1.0, 5.0])
    np.testing.assert_allclose(robust_sigma(columns, axis=0), [1.0, 5.0], rtol=1e-3)
    np.testing.assert_allclose(robust_sigma(columns.T, axis=1), [1.0, 5.0], rtol=1e-3)


def test_the_type_of_the_residuals_is_kept_along_an_axis():
    residuals = np.arange(6, dtype=np.float32).reshape(3, 2)
    assert robust_sigma(residuals, axis=0).dtype == np.float32
    assert nan_robust_sigma(residuals, axis=0).dtype == np.float32
    assert isinstance(robust_sigma(residuals), float)


def test_what_is_not_known_is_left_out_only_where_asked(normal_scores):
    holed = np.stack([normal_scores, 2.0 * normal_scores], axis=1)
    holed = np.concatenate([holed, [[np.nan, 0.0]]])
    assert np.isnan(robust_sigma(holed))
    assert np.isnan(robust_spread(holed))
    assert np.isnan(robust_sigma(holed, axis=0)).tolist() == [True, False]
    np.testing.assert_allclose(nan_robust_sigma(holed, axis=0), [1.0, 2.0], rtol=2e-3)
    assert nan_robust_sigma(holed[:, 0]) == robust_sigma(normal_scores)
