from __future__ import annotations

import numpy as np
import pytest

from fitting.digital_copy import ReflectanceMaps
from fitting.reflectance.microfacet import MicrofacetMaps, ggx, microfacets_of


def maps_of(k, *, diffuse=0.1, specular=0.2, c_x=-1.0, c_y=-1.0):
    k = np.atleast_2d(np.asarray(k, float))
    lobe = np.stack([np.full(k.shape, c_x), np.full(k.shape, c_y), np.ones(k.shape), k], axis=-1)
    three = np.ones((*k.shape, 3), np.float32)
    return ReflectanceMaps(
        three * np.float32(diffuse), three * np.float32(specular), np.float32(lobe)
    )


def test_diffuse_light_carries_over_unchanged():
    found = microfacets_of(maps_of([30.0], specular=0.0, diffuse=0.2))
    assert found.albedo == pytest.approx(0.2 * np.pi, rel=1e-6)
    assert not found.f0.any()
    assert not found.error.any()


def test_narrow_lobes_make_smooth_facets():
    # As much light in each as four hundredths of a mirror's.
    each = [(k, 0.04 * (k + 2) / (8 * np.pi)) for k in (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)]
    single = [microfacets_of(maps_of([k], specular=rho)) for k, rho in each]
    found = MicrofacetMaps(
        *(
            np.concatenate([getattr(one, name) for one in single], axis=1)
            for name in ("albedo", "f0", "alpha", "error")
        )
    )
    assert (np.diff(found.alpha) < 0).all()
    assert (found.f0 > 0).all()
    assert (found.f0 <= 1).all()
    assert (found.error > 0).all()


@pytest.mark.parametrize("k", [5.0, 30.0, 200.0])
def test_the_error_is_that_of_an_independent_sum_over_directions(k):
    maps = maps_of([k])
    found = microfacets_of(maps)
    random = np.random.default_rng(0)
    # Views and lights evenly over the cap of 65°.
    lowest = np.cos(np.radians(65.0))

    def cap(n):
        z = random.uniform(lowest, 1, n)
        turn = random.uniform(0, 2 * np.pi, n)
        sine = np.sqrt(1 - z**2)
        return np.column_stack([sine * np.cos(turn), sine * np.sin(turn), z])

    view, light = cap(400_000), cap(400_000)
    half = view + light
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    mirrored = light * [-1, -1, 1]
    lobe = 0.1 + 0.2 * np.maximum(np.sum(view * mirrored, axis=1), 0) ** k
    rise = (1 - np.sum(view * half, axis=1)) ** 5
    size = np.sum((lobe * light[:, 2]) ** 2)

    def error(alpha, f0):
        facets = ggx(alpha, light[:, 2], view[:, 2], half[:, 2]) * (f0 + (1 - f0) * rise)
        return np.sqrt(np.sum(((0.1 + facets - lobe) * light[:, 2]) ** 2) / size)

    alpha, f0 = found.alpha[0, 0], found.f0[0, 0, 0]
    best = error(alpha, f0)
    assert found.error[0, 0] == pytest.approx(best, rel=0.2)
    for wider in (0.7, 1.4):
        for more in (0.5, 0.7, 1.0, 1.4, 2.0):
            assert best < 1.02 * error(wider * alpha, more * f0)


def test_lobes_of_no_sense_give_finite_maps():
    found = microfacets_of(maps_of([1.0, 3000, 5], c_x=-0.4, c_y=-2.5, specular=1e4))
    wild = maps_of([5.0])
    wild.lobe[..., :3] = 0
    for result in (found, microfacets_of(wild)):
        for array in (result.albedo, result.f0, result.alpha, result.error):
            assert np.isfinite(array).all()
