from __future__ import annotations

import numpy as np
import pytest

from acquisition.scan import plan_scan, scan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from devices.errors import DeviceError
from devices.interfaces import Projection
from devices.rig import Rig
from devices.simulated.rig import Sensor, demo_rig


@pytest.fixture(scope="module")
def rig():
    return demo_rig(seed=3, camera_width=240)


def test_points_lie_on_the_painting_and_in_their_pixels(rig):
    points = rig.truth.points
    seen = np.isfinite(points[..., 2])
    assert seen.mean() > 0.95
    at = points[seen]
    height = rig.painting.height_at(at[:, 0], at[:, 1])
    # Vertical walls of the frame are hit at any height between their ends.
    assert np.quantile(np.abs(at[:, 2] - height), 0.98) < 1e-6
    pixels = rig.camera_lens.project(at)
    rows, cols = np.nonzero(seen)
    assert np.abs(pixels - np.stack([cols, rows], axis=1)).max() < 1e-5


def test_frame_wall_and_shadows_are_there(rig):
    z = rig.truth.points[..., 2]
    assert (z > 10).mean() > 0.05
    assert (z < -14).mean() > 0.02
    assert (rig.truth.shading[np.isfinite(z)] == 0).mean() > 0.01


def test_the_same_seed_gives_the_same_frames_and_each_frame_its_own_noise():
    one, other = (demo_rig(seed=5, camera_width=120) for _ in range(2))
    white = Projection("white", np.full((570, 912), 255, np.uint8))
    frames = []
    for rig in (one, other):
        rig.projector.show(white)
        frames.append([rig.camera.capture(0.03).image for _ in range(2)])
    np.testing.assert_array_equal(frames[0][0], frames[1][0])
    np.testing.assert_array_equal(frames[0][1], frames[1][1])
    assert (frames[0][0] != frames[0][1]).mean() > 0.5


def test_samples_have_the_type_of_their_depth():
    random = np.random.default_rng(0)
    for bits, kind in ((8, np.uint8), (10, np.uint16)):
        sensor = Sensor(bits=bits)
        image = sensor.expose(np.full((20, 20), 1e6), random)
        assert image.dtype == kind
        assert (image == sensor.ceiling).all()


def test_photon_transfer_gives_gain_and_read_noise_back():
    sensor = Sensor(full_well_e=10_000, read_noise_e=12, bits=12)
    random = np.random.default_rng(0)
    means, variances = [], []
    for electrons in (0.0, 500.0, 2000.0, 4000.0, 8000.0):
        image = sensor.expose(np.full((400, 400), electrons), random).astype(float)
        if electrons > 0:
            means.append(image.mean() - sensor.black_level)
            variances.append(image.var())
    gain, read = np.polyfit(means, variances, 1)
    per_electron = sensor.ceiling / sensor.full_well_e
    assert gain == pytest.approx(per_electron, rel=0.02)
    assert variances[0] == pytest.approx((500 + 144) * per_electron**2 + 1 / 12, rel=0.02)
    assert np.isfinite(read)


def test_devices_refuse_what_they_cannot_do(rig):
    with pytest.raises(DeviceError, match="912×570"):
        rig.projector.show(Projection("small", np.zeros((10, 10), np.uint8)))
    with pytest.raises(DeviceError, match="outside what"):
        rig.camera.capture(0.0)


class Stuttering:
    """A camera that delivers its fifth frame twice: the third of a scan after two of a proof."""

    def __init__(self, camera):
        self._camera, self._count, self._last = camera, 0, None

    def __getattr__(self, name):
        return getattr(self._camera, name)

    def capture(self, exposure_s, *, deadline=None):
        self._count += 1
        if self._count != 6:
            self._last = self._camera.capture(exposure_s, deadline=deadline)
        return self._last


def test_a_repeated_frame_stops_the_scan_with_the_projector_dark(rig, tmp_path):
    plan = plan_scan(Rig(rig.camera, rig.projector), exposure_s=0.03)
    camera = Stuttering(rig.camera)
    with (
        pytest.raises(DeviceError, match="frame of 0003"),
        SessionWriter.create(tmp_path / "s", plan) as writer,
    ):
        scan(writer, Rig(camera, rig.projector))
    assert rig.electrons(0.03).max() < 200
    with SessionWriter.resume(tmp_path / "s") as writer:
        assert writer.missing[0] == "0003"
        scan(writer, Rig(rig.camera, rig.projector))
    assert len(Session.open(tmp_path / "s").recorded) == len(plan.frames)
