from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.arm_geometry import ArmParameters
from calibration.target_shading import LitTarget, TargetShading
from devices.interfaces import ArmPose

_LAMP_NUMBERS = 7
ARM = ArmParameters(
    rt_rig_ring=np.array([np.pi, 0.0, 0.0, 5.0, -3.0, 900.0]),
    radius_mm=1100.0,
    elevation_zero=0.01,
    lean=0.005,
    sag=0.002,
    aim=np.array([4.0, 6.0, 0.0]),
    intensity=np.array([3.0e6, 2.5e6, 2.0e6]),
    exponent=5.0,
)
POSES = tuple(
    ArmPose(azimuth, elevation)
    for azimuth, elevation in zip(
        np.radians(np.arange(10) * 36.0), np.radians([35.0, 60.0] * 5), strict=True
    )
)
SIGMA = 0.004


def matt_target(*, noise: float = 0.0, albedo: float = 0.9) -> TargetShading:
    """What the arm's lamps send to a plate that faces the camera, with some noise."""
    x, y = np.meshgrid(np.linspace(-120, 120, 7), np.linspace(-90, 90, 5))
    points = np.stack([x, y, np.full_like(x, 900.0)], axis=-1).reshape(-1, 3)
    normal = np.array([0.0, 0.0, -1.0])
    radiance = []
    for pose in POSES:
        lamp = ARM.lamp(pose)
        cosine = lamp.directions(points) @ normal
        radiance.append(lamp.irradiance(points) * cosine[:, np.newaxis] * albedo / np.pi)
    sent = np.stack(radiance)
    off = np.random.default_rng(8).standard_normal(sent.shape)
    return TargetShading(points, normal, sent * (1 + noise * off), SIGMA * sent, albedo)


def uneven(shading: TargetShading) -> tuple[TargetShading, np.ndarray]:
    """The same plate with a factor at each point, and the factors."""
    gains = 1 + 0.1 * np.cos(np.arange(len(shading.points)))
    gains /= gains.mean()
    radiance = shading.radiance * gains[:, np.newaxis]
    return replace(shading, radiance=radiance, gains_unknown=True), gains


def test_a_matt_target_sends_what_its_lamps_give():
    target = LitTarget(matt_target(), POSES)
    np.testing.assert_allclose(target.radiance(ARM), target.shading.radiance, rtol=1e-12)
    np.testing.assert_allclose(target.residuals(ARM), 0, atol=1e-9)
    assert target.misfit(ARM) == pytest.approx(0, abs=1e-12)


def test_residuals_are_in_standard_errors_of_the_scaled_variances():
    shading = matt_target(noise=SIGMA)
    off = LitTarget(shading, POSES).residuals(ARM)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1.0, rel=0.1)
    np.testing.assert_allclose(LitTarget(shading, POSES, excess=4.0).residuals(ARM), off / 2)


def test_gains_of_an_uneven_target_are_found():
    shading, gains = uneven(matt_target())
    target = LitTarget(shading, POSES)
    np.testing.assert_allclose(target.gains(ARM), gains, rtol=1e-9)
    assert target.misfit(ARM) == pytest.approx(0, abs=1e-9)
    assert LitTarget(replace(shading, gains_unknown=False), POSES).misfit(ARM) > 0.05


def test_a_target_of_its_own_law_is_explained_by_the_incidence_only_where_it_may_be():
    shading = matt_target()
    cosine = np.stack(
        [ARM.lamp(pose).directions(shading.points) @ shading.normal for pose in POSES]
    )
    law = 1 - 0.2 * (1 - cosine) ** 2
    of_paint = replace(shading, radiance=shading.radiance * (law / law.mean())[..., np.newaxis])
    brighter = replace(ARM, intensity=ARM.intensity * 1.3)
    assert LitTarget(of_paint, POSES).misfit(ARM) > 0.01
    assert np.ptp(LitTarget(of_paint, POSES, matt=False).residuals(ARM)) < 0.2
    # How bright the lamp is the law does not say.
    assert LitTarget(of_paint, POSES, matt=False).misfit(brighter) > 0.2


def test_a_shadow_on_a_few_samples_is_left_out_and_much_of_it_is_not():
    clean = matt_target(noise=SIGMA)
    assert LitTarget(clean, POSES).without_shadows(ARM) is clean
    dark = clean.radiance.copy()
    dark[3, :2] *= 0.5
    found = LitTarget(replace(clean, radiance=dark), POSES).without_shadows(ARM)
    hidden = np.zeros(dark.shape, np.bool_)
    hidden[3, :2] = True
    np.testing.assert_array_equal(np.isnan(found.radiance), hidden)
    dark[:, :8] *= 0.5
    half = replace(clean, radiance=dark)
    assert LitTarget(half, POSES).without_shadows(ARM) is half


def test_noise_is_no_excess_and_a_bend_of_the_light_is():
    shading = matt_target(noise=SIGMA)
    target = LitTarget(shading, POSES)
    assert target.excess_over_noise(ARM, pull=0.0, lamp_numbers=_LAMP_NUMBERS) == 1
    assert target.excess_over_noise(ARM, pull=1e5, lamp_numbers=_LAMP_NUMBERS) > 10
    bend = (shading.points[:, 0] / 120) ** 2
    bent = shading.radiance * (1 + 0.01 * bend[:, np.newaxis])
    excess = LitTarget(replace(shading, radiance=bent), POSES).excess_over_noise(
        ARM, pull=0.0, lamp_numbers=_LAMP_NUMBERS
    )
    assert excess > 3


def test_channels_that_are_one_count_once():
    shading = matt_target()
    # From block to block to either side, which nothing smooth explains.
    side = np.where(np.arange(len(shading.points)) % 2, 1.4 * SIGMA, -1.4 * SIGMA)
    of_one = shading.radiance[..., :1] / ARM.intensity[0]
    grey = replace(
        shading,
        radiance=np.repeat(of_one * (1 + side[:, np.newaxis]), 3, axis=2),
        sigma=np.repeat(SIGMA * of_one, 3, axis=2) * np.sqrt(3),
    )
    assert grey.is_monochrome
    assert not shading.is_monochrome
    white = replace(ARM, intensity=np.ones(3))
    excess = LitTarget(grey, POSES).excess_over_noise(white, pull=0.0, lamp_numbers=_LAMP_NUMBERS)
    samples = len(POSES) * len(shading.points)
    assert excess == pytest.approx(1.4**2 * samples / (samples - _LAMP_NUMBERS), rel=1e-6)
