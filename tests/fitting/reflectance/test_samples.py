from __future__ import annotations

import math

import numpy as np
import pytest

from fitting.errors import FittingError
from fitting.reflectance.samples import RadianceSamples, local_frames
from workstation.benchmarks.lafortune_samples import make_lobes, observe


def test_frames_are_rotations_with_the_normal_as_z():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(50, 3))
    normals[0] = [1, 0, 0]  # along the direction that x should follow
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frames = local_frames(normals)
    identity = np.broadcast_to(np.eye(3), (50, 3, 3))
    np.testing.assert_allclose(frames @ np.swapaxes(frames, 1, 2), identity, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0)
    np.testing.assert_allclose(frames[:, 2], normals)
    np.testing.assert_allclose(local_frames([0.0, 0.0, 1.0]), np.eye(3))


def test_normals_without_direction_are_refused():
    with pytest.raises(FittingError, match="normals"):
        local_frames([[0.0, 0.0, 0.0]])
    with pytest.raises(FittingError, match="normals"):
        local_frames([[np.nan, 0.0, 1.0]])


def test_grazing_samples_are_left_out():
    samples = observe(make_lobes(10, np.random.default_rng(0)), 50, 0)
    limited = samples.limited(math.radians(40))
    kept = limited.weight > 0
    assert np.all(limited.light[..., 2][kept] >= math.cos(math.radians(40)) - 1e-6)
    assert 0 < kept.sum() < (samples.weight > 0).sum()
    with pytest.raises(FittingError, match="grazing"):
        samples.limited(3.0)


def test_valid_samples_are_finite_and_in_front():
    samples = observe(make_lobes(4, np.random.default_rng(1)), 20, 1)
    radiance, light = samples.radiance.copy(), samples.light.copy()
    radiance[0, 3, 1] = np.nan
    light[1, 4, 2] = -0.1
    spoiled = RadianceSamples(samples.view, light, radiance, samples.variance, samples.weight)
    assert not spoiled.valid[0, 3]
    assert not spoiled.valid[1, 4]
    assert spoiled.valid.sum() == samples.valid.sum() - 2


def test_shapes_must_agree():
    one = np.ones((4, 5, 3))
    with pytest.raises(FittingError, match="variance"):
        RadianceSamples(one, one, one, one[:, :4], one[..., 0])
    with pytest.raises(FittingError, match="negative weight"):
        RadianceSamples(one, one, one, one, -one[..., 0])
