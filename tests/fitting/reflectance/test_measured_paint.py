from __future__ import annotations

import math

import numpy as np
import pytest

from fitting.reflectance.clusters import fit_reflectance
from fitting.reflectance.lobe import LobeVariant
from fitting.reflectance.shared_lobe import PooledProblem, fit_pooled
from fitting.reflectance.solver import fit_texels
from workstation.benchmarks.measured_reflectance import (
    LEAST_SQUARES,
    continued,
    descended,
    hemispherical_basis,
    polynomial_basis,
    random_shapes,
    read_ball,
    read_goniometer,
    relative_rms,
)


@pytest.mark.parametrize(("paint", "known"), [("garnet_red", 0.249), ("krylon_blue", 0.265)])
def test_measured_paint_from_random_starts(real_data, paint, known):
    samples = read_goniometer(real_data / "cornell_paint_brdf" / f"{paint}.brdf")
    fits = fit_texels(samples, options=LEAST_SQUARES)
    assert relative_rms(fits.lobes, samples) <= 1.01 * known
    shapes = random_shapes(50, seed=0)
    assert max(relative_rms(lobe, samples) for lobe in continued(samples, shapes)) <= 1.01 * known
    plain = [relative_rms(lobe, samples) for lobe in descended(samples, shapes)]
    assert np.mean(np.array(plain) <= 1.01 * known) >= 0.9
    pooled = fit_pooled(PooledProblem(samples, LobeVariant.FREE, huber_limit=math.inf))
    assert pooled.cost == pytest.approx(fits.cost[0], rel=1e-3)


def test_ball_under_lights_that_were_held_out(real_data):
    ball = read_ball(real_data / "diligent_ball")
    assert ball.basis_psnr_db(polynomial_basis(ball.light)) == pytest.approx(29.85, abs=0.01)
    assert ball.basis_psnr_db(hemispherical_basis(ball.light)) == pytest.approx(29.51, abs=0.01)
    fits, _ = fit_reflectance(ball.training)
    assert ball.relight_psnr_db(fits.lobes) >= 36.4
