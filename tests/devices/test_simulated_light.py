"""Reflection, the lamp and its shadows, against plain formulae."""

from __future__ import annotations

import math

import numpy as np
import pytest

from devices.interfaces import ArmPose
from devices.simulated.arm_kinematics import ArmKinematics, Lamp
from devices.simulated.optics import SimulatedLens
from devices.simulated.rig import SimulatedRig
from devices.simulated.scene import SimulatedScene
from devices.simulated.scene_objects import PlacedSurface, Wall
from devices.simulated.sensor import Sensor
from devices.simulated.shading_kernels import (
    PAINT_F0,
    VARNISH_F0,
    VARNISH_ROUGHNESS,
    reflected,
)
from devices.simulated.surface import Surface
from devices.simulated.truth import truth_of

GREY = np.array([0.2, 0.5, 0.3])


def microfacets(normal, light, view, *, albedo, roughness, varnish=0.0, metal=0.0):
    """π times the BRDF for red, green and blue, as published: D, G1·G1 by Λ, Schlick."""
    half = (light + view) / np.linalg.norm(light + view)
    nl, nv, nh, vh = normal @ light, normal @ view, normal @ half, view @ half

    def schlick(f0, cosine):
        return f0 + (1 - f0) * (1 - cosine) ** 5

    def lobe(alpha):
        tangent2 = 1 / nh**2 - 1
        d = 1 / (np.pi * alpha**2 * nh**4 * (1 + tangent2 / alpha**2) ** 2)
        smith = [(-1 + np.sqrt(1 + alpha**2 * (1 / c**2 - 1))) / 2 for c in (nl, nv)]
        return np.pi * d / (1 + sum(smith)) / (4 * nl * nv)

    f = schlick(PAINT_F0 * (1 - metal) + albedo * metal, vh)
    enters = (1 - schlick(PAINT_F0, nl)) * (1 - schlick(PAINT_F0, nv))
    base = (1 - metal) * albedo * enters + lobe(roughness) * f
    through = (1 - schlick(VARNISH_F0, nl)) * (1 - schlick(VARNISH_F0, nv))
    coat = lobe(VARNISH_ROUGHNESS) * schlick(VARNISH_F0, vh)
    return (1 - varnish) * base + varnish * (through * base + coat)


def direction(theta, phi):
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def kernel(light, view, finish, weights):
    normal = np.array([0.0, 0.0, 1.0])
    half = (light + view) / np.linalg.norm(light + view)
    return reflected(
        finish.astype(np.float32), weights, light[2], view[2], normal @ half, view @ half
    )


def test_reflection_is_that_of_the_published_formulae():
    random = np.random.default_rng(0)
    up = np.array([0.0, 0.0, 1.0])
    for _ in range(300):
        light, view = (direction(t, p) for t, p in random.uniform(0, (1.4, 2 * np.pi), (2, 2)))
        albedo, roughness = random.uniform(0.02, 0.9, 3), random.uniform(0.05, 1.0)
        varnish, metal = random.choice([0.0, 0.4, 1.0], 2)
        finish = np.array([*albedo, roughness, varnish, metal], np.float32)
        expected = microfacets(
            *(up, light, view),
            albedo=finish[:3].astype(float),
            roughness=float(finish[3]),
            varnish=float(finish[4]),
            metal=float(finish[5]),
        )
        weights = random.uniform(0, 1, 3)
        assert kernel(light, view, finish, weights) == pytest.approx(weights @ expected, rel=1e-4)
        # Light may be followed either way.
        assert kernel(view, light, finish, weights) == pytest.approx(weights @ expected, rel=1e-4)


@pytest.mark.parametrize(
    "finish", [(1, 0.1, 0, 0), (1, 0.5, 1, 0), (0.93, 0.08, 0, 1), (1, 1, 1, 0)]
)
@pytest.mark.parametrize("theta", [0.0, 0.6, 1.2])
def test_no_more_light_comes_back_than_went_in(finish, theta):
    """Share reflected into all directions, by sampling the hemisphere."""
    albedo, roughness, varnish, metal = finish
    maps = np.array([albedo, albedo, albedo, roughness, varnish, metal], np.float32)
    view = direction(theta, 0.0)
    cosines, turns = np.meshgrid((np.arange(300) + 0.5) / 300, 2 * np.pi * np.arange(90) / 90)
    total = 0.0
    for c, p in zip(cosines.ravel(), turns.ravel(), strict=True):
        light = direction(math.acos(c), p)
        total += c * kernel(light, view, maps, np.full(3, 1 / 3))
    share = 2 * total / cosines.size
    assert 0.3 < share < 1.02


def test_the_lamp_goes_where_ring_and_arc_put_it():
    ideal = ArmKinematics(radius=500.0)
    for azimuth, elevation in ((0.0, 0.3), (1.1, 0.9), (4.0, 1.4)):
        at = ideal.lamp_position(ArmPose(azimuth, elevation))
        expected = 500 * direction(np.pi / 2 - elevation, azimuth)
        np.testing.assert_allclose(at, expected, atol=1e-9)
    sagging = ArmKinematics(radius=500.0, sag=0.01, elevation_zero=0.02, azimuth_zero=0.03)
    at = sagging.lamp_position(ArmPose(1.0, 0.0))
    assert math.asin(at[2] / 500) == pytest.approx(0.01)
    assert math.atan2(at[1], at[0]) == pytest.approx(1.03)
    moved = ArmKinematics(centre=(1, 2, 3), radius=400.0, ring_tilt=(0.02, -0.01), arc_lean=0.05)
    for azimuth in np.linspace(0, 6, 7):
        at = moved.lamp_position(ArmPose(azimuth, 0.7))
        assert np.linalg.norm(at - [1, 2, 3]) == pytest.approx(400.0)
    # A full turn of the ring draws a circle about the tilted axis.
    turn = [moved.lamp_position(ArmPose(a, 0.5)) - [1, 2, 3] for a in np.linspace(0, 6, 9)]
    axis = np.array([-0.01, -0.02 * np.cos(0.01), np.cos(0.02) * np.cos(0.01)])
    axis[0] = np.sin(-0.01)
    axis[1] = -np.sin(0.02) * np.cos(-0.01)
    assert np.ptp(np.array(turn) @ axis) < 1e-9


@pytest.fixture
def plate():
    """A matt plate with a post, seen from above by a lamp on a crooked arm."""
    height = np.zeros((501, 601), np.float32)
    height[240:260, 290:310] = 12.0
    surface = Surface.uniform(height, pitch_mm=0.4, canvas_mm=(240, 200), albedo=0.5)
    lens = SimulatedLens.looking_at(
        **{"width": 240, "height": 180, "focal_px": 500.0, "position": (5.0, -8.0, 500.0)},
        **{"target": (0.0, 0.0, 0.0), "distortion": (-0.05, 0.0, 0.0, 0.0, 0.0)},
    )
    scene = SimulatedScene(
        PlacedSurface(surface),
        (Wall(-15.0),),
        {"only": lens},
        lens.moved((100.0, 0.0, 480.0), (0.0, 0.0, 0.0)),
        arm=ArmKinematics(centre=(2.0, -1.0, 4.0), radius=420.0, elevation_zero=0.01, sag=0.004),
        lamp=Lamp(exponent=9.0, colour=(1.0, 0.8, 0.5), aim_error=(5.0, 0.0, 0.0)),
        ambient=0.02,
    )
    return SimulatedRig.of(scene)


def test_lamp_light_falls_off_with_distance_and_from_its_axis(plate):
    pose = ArmPose(0.7, 0.8)
    truth = truth_of(plate.scene)
    lamp, axis = truth.lamp_position(pose), truth.lamp_axis(pose)
    shading = truth.lamp_shading(pose)
    flat = (np.abs(truth.points[..., 2]) < 1e-6) & (truth.normals[..., 2] > 0.99999)
    flat &= shading > 0
    at = truth.points[flat]
    to_lamp = lamp - at
    reach = np.linalg.norm(to_lamp, axis=1)
    light = to_lamp / reach[:, None]
    eye = truth.camera.position - at
    eye /= np.linalg.norm(eye, axis=1)[:, None]
    up = np.array([0.0, 0.0, 1.0])
    weights = Sensor().weights(plate.scene.lamp.colour)[0, 0]
    some = np.random.default_rng(0).choice(len(at), 200)
    albedo, roughness = truth.albedo[flat][0].astype(float), float(truth.roughness[flat][0])
    factor = [
        weights @ microfacets(up, light[n], eye[n], albedo=albedo, roughness=roughness)
        for n in some
    ]
    cosine = light[some, 2] * (-light[some] @ axis) ** 9 * (420 / reach[some]) ** 2
    own_axis = (truth.camera.axis @ -eye[some].T) ** truth.camera.vignetting
    np.testing.assert_allclose(shading[flat][some], factor * cosine * own_axis, rtol=2e-4)


def test_the_post_s_shadow_lies_where_the_lamp_is_not_seen(plate):
    pose = ArmPose(0.0, 0.5)
    truth = truth_of(plate.scene)
    lamp = truth.lamp_position(pose)
    shading = truth.lamp_shading(pose)
    flat = np.abs(truth.points[..., 2]) < 1e-6
    at = truth.points[flat]
    # The line from a point to the lamp passes the post's box if it meets it below its top.
    hidden = np.zeros(len(at), bool)
    for s in np.linspace(1e-4, 0.2, 4000):
        x, y, z = (at + s * (lamp - at)).T
        hidden |= (np.abs(x - 0.0) < 3.9) & (np.abs(y - 0.0) < 3.9) & (z < 12)
    dark = shading[flat] == 0
    assert hidden.sum() > 100
    # Edges of the post lie within a cell, 0.4 mm.
    assert (dark == hidden).mean() > 0.995


def test_frames_show_the_lamp_only_while_it_is_lit_and_the_room_always(plate):
    plate.arm.home()
    plate.arm.move_to(ArmPose(0.5, 0.6))
    dark = plate.electrons(0.05)
    plate.arm.switch_lamp(True)
    lit = plate.electrons(0.05)
    truth = truth_of(plate.scene)
    scale = 0.05 * plate.scene.sensor.rate_e_per_s
    np.testing.assert_allclose(
        lit - dark, truth.lamp_shading(plate.arm.pose) * scale, atol=1e-3 * lit.max()
    )
    albedo = truth.albedo @ Sensor().weights((1.0, 1.0, 1.0))[0, 0]
    room = 0.02 * albedo * plate.scene.view().transmission.reshape(dark.shape)
    leak = plate.scene.panel.black * truth.shading
    covered = ((truth.panel > 0) & (truth.panel < (239, 179))).all(axis=-1)
    np.testing.assert_allclose(dark[covered], scale * (room + leak)[covered], rtol=1e-4)
    beside = ((truth.panel < -1) | (truth.panel > (240, 180))).any(axis=-1)
    np.testing.assert_allclose(dark[beside], scale * room[beside], rtol=1e-4)
    plate.arm.move_to(ArmPose(1.5, 0.6))
    np.testing.assert_array_equal(plate.electrons(0.05), dark)
