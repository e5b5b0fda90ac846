from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from acquisition.patterns import Axis, PhaseShift, pattern_image
from devices.simulated.oil_painting import paint_small_oil
from devices.simulated.optics import PanelResponse
from devices.simulated.rig import SimulatedRig, demo_rig
from devices.simulated.sensor import Sensor
from devices.simulated.surface import Surface
from devices.simulated.truth import truth_of


@pytest.fixture(scope="module")
def rig():
    return demo_rig(seed=3, camera_width=240)


@pytest.fixture(scope="module")
def truth(rig):
    return truth_of(rig.scene)


def flat_surface(half_mm: float = 140.0, pitch_mm: float = 0.5, height=0.0) -> Surface:
    n = round(2 * half_mm / pitch_mm) + 1
    flat = np.zeros((n, n), np.float32) + height
    return Surface.uniform(flat, pitch_mm=pitch_mm, canvas_mm=(120.0, 90.0), albedo=0.6)


def rig_with(surface: Surface, rig: SimulatedRig, **options) -> SimulatedRig:
    return SimulatedRig.before(surface, rig.camera_lens, rig.projector_lens, **options)


def brown_conrady(points, lens):
    """OpenCV's five-parameter model written out."""
    local = points @ lens.rotation.T + lens.translation
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    k1, k2, p1, p2, k3 = lens.distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    k = lens.matrix
    return np.stack([k[0, 0] * xd + k[0, 2], k[1, 1] * yd + k[1, 2]], axis=1)


def test_panel_coordinates_are_those_of_the_true_surface_point(rig, truth):
    """From the painting to both imagers, by the formula; the rig goes from the camera's rays."""
    random = np.random.default_rng(0)
    x, y = random.uniform(-55, 55, 4000), random.uniform(-40, 40, 4000)
    points = np.stack([x, y, rig.painting.height_at(x, y)], axis=1)
    in_camera = brown_conrady(points, rig.camera_lens)
    in_panel = brown_conrady(points, rig.projector_lens)
    panel = truth.panel.astype(np.float32)
    at = in_camera.astype(np.float32).reshape(-1, 1, 2)
    seen = np.stack(
        [
            cv2.remap(np.ascontiguousarray(panel[..., i]), at, None, cv2.INTER_LINEAR).ravel()
            for i in (0, 1)
        ],
        axis=1,
    )
    error = np.abs(seen - in_panel).max(axis=1)
    # Between pixels the panel coordinate bends with the relief; one pixel spans 3.4 of the panel.
    assert np.median(error) < 0.06
    assert np.quantile(error, 0.9) < 0.5


def test_the_lenses_follow_the_distortion_formula_both_ways(rig):
    random = np.random.default_rng(1)
    points = random.uniform([-80, -60, -15], [80, 60, 15], (500, 3))
    for lens in (rig.camera_lens, rig.projector_lens):
        np.testing.assert_allclose(lens.project(points), brown_conrady(points, lens), atol=1e-9)
        straight = brown_conrady(points, replace(lens, distortion=np.zeros(5)))
        # Several times the 0.05 px that decoding resolves: ignoring it would be noticed.
        assert np.abs(straight - lens.project(points)).max() > 0.3
    small = replace(rig.projector_lens, width=60, height=40)
    rays = small.rays()
    pixels = brown_conrady(small.position + 400 * rays, small)
    col, row = np.meshgrid(np.arange(60), np.arange(40))
    assert np.abs(pixels - np.stack([col.ravel(), row.ravel()], axis=1)).max() < 1e-6


def test_shadows_are_where_the_surface_rises_above_the_line_to_the_projector(rig, truth):
    """By sampling the line densely, instead of marching through the grid."""
    points = truth.points
    normal_enough = np.isfinite(points[..., 2]) & (np.abs(points[..., 0]) < 58)
    normal_enough &= np.abs(points[..., 1]) < 43
    at = points[normal_enough]
    dark = truth.shading[normal_enough] == 0
    normals = truth.normals[normal_enough]
    lamp = rig.projector_lens.position
    faces_lamp = (normals * (lamp - at)).sum(axis=1) > 0
    share = np.linspace(1e-4, 0.12, 3000)
    near = np.geomspace(1e-6, 1e-4, 50)
    rng = np.random.default_rng(2)
    some = np.concatenate([rng.choice(np.flatnonzero(dark), 200), rng.choice(len(at), 200)])
    agree = certain = shadowed = 0
    for n in some:

        def clearance(share, n=n):
            line = at[n] + share[:, np.newaxis] * (lamp - at[n])
            clear = line[:, 2] - rig.painting.height_at(line[:, 0], line[:, 1])
            return clear.min(), share[clear.argmin()]

        clear, nearest = clearance(share)
        # A wall of the frame rises by a millimetre within a step: look closer there.
        clear = min(clear, clearance(nearest + (share[1] - share[0]) * np.linspace(-1, 1, 2000))[0])
        # The cell itself may face away where the interpolated normal does not.
        own = clearance(near)[0] < -2e-5
        if (abs(clear) < 1e-3 and not own) or not faces_lamp[n]:
            continue  # grazing, or dark for another reason
        certain += 1
        hidden = clear < 0 or own
        shadowed += hidden
        agree += hidden == dark[n]
    assert certain > 200
    assert shadowed > 50
    assert agree / certain > 0.995


def test_a_ridge_casts_the_shadow_that_geometry_says(rig):
    flat = flat_surface()
    height = np.zeros_like(flat.height)
    middle = (height.shape[1] - 1) // 2
    height[:, middle : middle + 3] = 10.0
    ridged = truth_of(rig_with(replace(flat, height=height), rig).scene)
    # The lamp is to the right, so the shadow of the ridge's left edge falls to the left.
    lamp = rig.projector_lens.position
    reach = 10.0 * lamp[0] / (lamp[2] - 10.0)
    row = rig.camera_lens.height // 2
    points, shading = ridged.points[row], ridged.shading[row]
    x = points[:, 0]
    behind = (np.abs(points[:, 2]) < 1e-6) & (x < -0.6) & (x > -20)
    dark = x[behind & (shading == 0)]
    pixel = 195.0 / 240
    assert dark.min() == pytest.approx(-reach, abs=1.5 * pixel)
    assert (shading[behind & (x < -reach - pixel)] > 0).all()
    assert (shading[behind & (x > -reach + pixel)] == 0).all()


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_a_plane_decodes_to_the_truth_within_its_noise(rig, bits):
    """Plain least squares in NumPy against the true panel coordinate."""
    sensor = Sensor(bits=bits, black_level=2.0)
    flat = rig_with(flat_surface(), rig, sensor=sensor, seed=bits)
    steps, period, frames = 8, 24.0, []
    for step in range(steps):
        shift = 2 * np.pi * step / steps
        pattern = PhaseShift(axis=Axis.COLUMN, period_px=period, shift_rad=shift)
        flat.scene.show(pattern_image(pattern, width=912, height=570))
        frames.append(flat.camera.capture(0.03).image.astype(float))
    stack = np.stack(frames)
    angle = 2 * np.pi * np.arange(steps) / steps
    c, s = (np.tensordot(f(angle), stack, axes=1) * 2 / steps for f in (np.cos, np.sin))
    phase, modulation = np.arctan2(-s, c), np.hypot(c, s)
    gain = sensor.numbers_per_electron
    level = stack.mean(axis=0) - sensor.black_level
    variance = gain * level + (gain * sensor.read_noise_e) ** 2 + 1 / 12
    sigma = np.sqrt(2 / steps * variance) / np.maximum(modulation, 1e-9)
    column, row = np.moveaxis(truth_of(flat.scene).panel, -1, 0)
    inside = (column > 20) & (column < 890) & (row > 5) & (row < 564)
    wrapped = np.angle(np.exp(1j * (phase - 2 * np.pi * column / period)))
    error = wrapped[inside] / sigma[inside]
    assert inside.mean() > 0.8
    assert abs(error.mean()) < 0.05
    assert error.std() == pytest.approx(1.0, abs=0.025)


def test_gamma_blur_and_black_level_of_the_projector(rig):
    flat = rig_with(flat_surface(), rig, panel=PanelResponse(gamma=2.2, black=0.01))

    def light(level):
        flat.scene.show(np.full((570, 912), level, np.uint8))
        return flat.electrons(0.03)[90, 120]

    dark, full = light(0), light(255)
    assert dark / full == pytest.approx(0.01, rel=1e-5)
    assert (light(128) - dark) / (full - dark) == pytest.approx((128 / 255) ** 2.2, rel=1e-4)
    amplitudes = []
    for blur in (0.0, 1.5):
        blurred = rig_with(flat_surface(), rig, panel=PanelResponse(blur_px=blur, black=0.0))
        frames = []
        for shift in (0.0, np.pi):
            pattern = PhaseShift(axis=Axis.COLUMN, period_px=12, shift_rad=shift)
            blurred.scene.show(pattern_image(pattern, width=912, height=570))
            frames.append(blurred.electrons(0.03)[60:120, 60:180])
        amplitudes.append(np.std(frames[0] - frames[1]))
    loss = amplitudes[1] / amplitudes[0]
    assert loss == pytest.approx(np.exp(-2 * (np.pi * 1.5 / 12) ** 2), rel=0.01)


def test_a_painting_is_a_function_of_its_seed_with_its_truth():
    one, same, other = (paint_small_oil(seed=s, pitch_mm=0.25) for s in (4, 4, 5))
    for name in ("height", "albedo", "roughness", "varnish"):
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
    assert np.abs(one.height - other.height).max() > 0.3
    x, y = np.random.default_rng(0).uniform(-50, 50, 500), np.linspace(-38, 38, 500)
    found = one.points_at(np.stack([x, y, 0 * x], axis=1))
    step = 0.25
    slopes = np.stack(
        [
            (one.height_at(x + step, y) - one.height_at(x - step, y)) / (2 * step),
            (one.height_at(x, y + step) - one.height_at(x, y - step)) / (2 * step),
        ],
        axis=1,
    )
    np.testing.assert_allclose(-found.normals[:, :2] / found.normals[:, 2:], slopes, atol=1e-4)
    assert ((found.albedo >= 0.01) & (found.albedo <= 0.9)).all()
