from __future__ import annotations

import numpy as np
import pytest

from acquisition.scan import plan_scan, scan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from devices.errors import DeviceError
from devices.interfaces import Projection
from devices.rig import Rig
from devices.simulated.rig import demo_rig
from devices.simulated.truth import truth_of


@pytest.fixture(scope="module")
def rig():
    return demo_rig(seed=3, camera_width=240)


def test_points_lie_on_the_painting_and_in_their_pixels(rig):
    points = truth_of(rig.scene).points
    seen = np.isfinite(points[..., 2])
    assert seen.mean() > 0.95
    at = points[seen]
    x, y = rig.painting.grid_mm()
    on_map = (np.abs(at[:, 0]) < x[-1]) & (np.abs(at[:, 1]) < y[0])
    height = rig.painting.height_at(*at[on_map, :2].T)
    # The patch under a pixel is met exactly, steep walls of the frame included.
    assert np.abs(at[on_map, 2] - height).max() < 1e-5
    np.testing.assert_allclose(at[~on_map, 2], -15.0)
    pixels = rig.camera_lens.project(at)
    rows, cols = np.nonzero(seen)
    assert np.abs(pixels - np.stack([cols, rows], axis=1)).max() < 1e-5


def test_frame_wall_and_shadows_are_there(rig):
    truth = truth_of(rig.scene)
    z = truth.points[..., 2]
    assert (z > 10).mean() > 0.05
    assert (z < -14).mean() > 0.02
    assert (truth.shading[np.isfinite(z)] == 0).mean() > 0.01


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


def test_devices_refuse_what_they_cannot_do(rig):
    with pytest.raises(DeviceError, match="912×570"):
        rig.projector.show(Projection("small", np.zeros((10, 10), np.uint8)))
    with pytest.raises(DeviceError, match="outside what"):
        rig.camera.capture(0.0)


class Stuttering:
    """A camera that delivers its sixth frame twice: the third of a scan after three of a proof."""

    def __init__(self, camera):
        self._camera, self._count, self._last = camera, 0, None

    def __getattr__(self, name):
        return getattr(self._camera, name)

    def capture(self, exposure_s, *, deadline=None):
        self._count += 1
        if self._count != 7:
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
