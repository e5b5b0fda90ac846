from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from fitting.reflectance.lobe import LafortuneLobes
from fitting.reflectance.lobe_kernels import (
    evaluate_lobe,
    huber_weights,
    make_workspace,
    solve_channel,
    sum_columns,
    sum_slopes,
)
from workstation.benchmarks.paint_samples import capture_directions


@pytest.fixture
def space():
    rng = np.random.default_rng(0)
    made = make_workspace(40)
    view, light = capture_directions(1, 40, rng)
    made.axes[:] = (view[0] * light[0] * [-1, -1, 1]).T
    made.rows[:] = rng.uniform(0.5, 2, made.rows.shape)
    made.weight[:] = rng.uniform(0.5, 2, made.weight.shape)
    made.target[:] = rng.normal(size=made.target.shape)
    return made


@pytest.mark.parametrize("shape", [[0.0, 0.0, 0.0], [3.5, -0.1, 0.05], [7.3, 0.2, -0.2]])
def test_lobe_is_equation_one(space, shape):
    view, light = capture_directions(1, 40, np.random.default_rng(0))
    evaluate_lobe(space.axes, 40, np.array(shape), space.lobe, space.slopes)
    lobes = LafortuneLobes(np.array([shape]), np.zeros((1, 3)), np.ones((1, 3)))
    c_x, c_y, c_z, k = lobes.coefficients[0]
    base = np.maximum(((view * light)[0] * [c_x, c_y, c_z]).sum(axis=1), 0)
    np.testing.assert_allclose(space.lobe, base**k, rtol=1e-7, atol=1e-60)
    np.testing.assert_allclose(
        lobes.reflectance(view, light)[0, :, 1], base**k, rtol=1e-7, atol=1e-60
    )


def test_slopes_are_derivatives(space):
    shape, h = np.array([3.0, -0.1, 0.1]), 1e-6
    evaluate_lobe(space.axes, 40, shape, space.lobe, space.slopes)
    slopes = space.slopes.copy()
    for p in range(3):
        ends = []
        for sign in (-1, 1):
            moved = shape.copy()
            moved[p] += sign * h
            evaluate_lobe(space.axes, 40, moved, space.lobe, space.slopes)
            ends.append(space.lobe.copy())
        np.testing.assert_allclose(slopes[p], (ends[1] - ends[0]) / (2 * h), rtol=1e-5, atol=1e-8)


def test_base_below_zero_is_no_light():
    space = make_workspace(2)
    space.axes[:] = [[-0.9, 0.2], [0.0, 0.0], [0.1, 0.5]]
    evaluate_lobe(space.axes, 2, np.zeros(3), space.lobe, space.slopes)
    assert space.lobe[0] == 0
    assert np.all(space.slopes[:, 0] == 0)
    assert space.lobe[1] == pytest.approx(0.7)


def test_sums_are_dot_products(space):
    evaluate_lobe(space.axes, 40, np.array([1.0, 0.1, 0.1]), space.lobe, space.slopes)
    b, w, t, s = space.lobe, space.weight, space.target, space.slopes
    sum_columns(w, t, b, 40, space.sums)
    expected = np.stack([w.sum(1), w @ b, w @ b**2, t.sum(1), t @ b], axis=1)
    np.testing.assert_allclose(space.sums, expected, rtol=1e-12)
    sum_slopes(w, t, b, s, 40, 3, space.by_column, space.by_slope)
    by_column = np.stack([w @ s.T, (w * b) @ s.T, t @ s.T], axis=2)
    np.testing.assert_allclose(space.by_column, by_column, rtol=1e-11, atol=1e-13)
    by_slope = np.einsum("ci,pi,qi->cpq", w, s, s)
    for p in range(3):
        np.testing.assert_allclose(space.by_slope[:, p, : p + 1], by_slope[:, p, : p + 1])


@pytest.mark.parametrize("seed", range(20))
def test_columns_are_non_negative_least_squares(seed):
    rng = np.random.default_rng(seed)
    columns = np.column_stack([rng.uniform(0.2, 1, 12), rng.uniform(0, 1, 12) ** 4])
    values = columns @ rng.uniform(-1, 1, 2) + 0.1 * rng.normal(size=12)
    (a_dd, a_ds), (_, a_ss) = columns.T @ columns
    t_d, t_s = columns.T @ values
    rho_d, rho_s, gain = solve_channel(a_dd, a_ds, a_ss, t_d, t_s)
    expected, norm = nnls(columns, values)
    np.testing.assert_allclose([rho_d, rho_s], expected, atol=1e-10)
    assert values @ values - gain == pytest.approx(norm**2)


def test_a_lobe_that_reaches_no_sample_is_left_out():
    assert solve_channel(2.0, 0.0, 0.0, 4.0, 0.0) == (2.0, 0.0, 8.0)


@pytest.mark.parametrize("limit", [0.5, 3.0, np.inf])
def test_huber_weights_and_loss(space, limit):
    evaluate_lobe(space.axes, 40, np.array([1.0, 0.0, 0.0]), space.lobe, space.slopes)
    rho = np.array([[0.1, 0.2, 0.3], [0.5, 0.6, 0.7]])
    gain, values = space.rows[:3], space.rows[3:]
    residual = np.abs(values - gain * (rho[0][:, None] + rho[1][:, None] * space.lobe))
    near = residual <= limit
    far = 0.0 if np.isinf(limit) else limit * (2 * residual - limit)
    u = np.where(near, 1.0, 0.0 if np.isinf(limit) else limit / residual)
    cost, plain = huber_weights(space.rows, space.lobe, rho, 40, limit, space.weight, space.target)
    assert cost == pytest.approx(np.where(near, residual**2, far).sum())
    assert plain == near.all()
    np.testing.assert_allclose(space.weight, u * gain**2)
    np.testing.assert_allclose(space.target, u * gain * values)
