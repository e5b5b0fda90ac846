import numpy as np
import pytest

from fitting.reflectance.held_out import compare


def test_noise_alone_leaves_of_a_perfect_rendering_what_is_predicted():
    random = np.random.default_rng(0)
    perfect = random.uniform(2.0, 60.0, (80, 90, 3)).astype(np.float32)
    variance = 0.05 * perfect + 0.2
    photograph = perfect + np.sqrt(variance) * random.standard_normal(perfect.shape)
    found = compare(photograph.astype(np.float32), variance, perfect, name="perfect")
    assert found.psnr_db == pytest.approx(found.noise_psnr_db, abs=0.1)
    assert found.mean_delta_e == pytest.approx(found.noise_delta_e, rel=0.03)
    # Of another copy it says the same.
    other = compare(photograph.astype(np.float32), variance, 1.2 * perfect, name="other")
    assert (other.noise_psnr_db, other.noise_delta_e) == (found.noise_psnr_db, found.noise_delta_e)
    assert other.psnr_db < found.psnr_db - 3
    assert other.mean_delta_e > 1.5 * found.mean_delta_e


def test_variance_that_is_no_number_is_no_noise_beyond_the_canvas():
    measured = np.linspace(4.0, 5.0, 108, dtype=np.float32).reshape(6, 6, 3)
    measured[3:] = np.nan
    variance = np.where(np.isfinite(measured), np.float32(0.01), np.float32(np.nan))
    found = compare(measured, variance, np.full_like(measured, 4.0), name="half")
    assert np.isfinite([found.noise_psnr_db, found.noise_delta_e]).all()
    variance[1, 2, 0], variance[1, 3, 1] = np.nan, np.inf
    again = compare(measured, variance, np.full_like(measured, 4.0), name="half")
    assert again.noise_psnr_db == pytest.approx(found.noise_psnr_db, abs=0.1)
    assert again.psnr_db == found.psnr_db
