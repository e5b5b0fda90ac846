"""Which mosaic frames have is in the plan, from the camera on; where it is not, they tell."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tiny_rig import HEIGHT, WIDTH, TinyCamera, TinyScene, tiny_rig

from acquisition.capture_description import CaptureDescription
from acquisition.errors import SessionError
from acquisition.foreign_capture import find_capture
from acquisition.photograph_plan import PhotographChoices, plan_photographs
from acquisition.plan import Imager, Plan
from acquisition.recorded_frames import recording_of
from acquisition.recording import record_plan
from acquisition.scan import plan_response_scan, plan_scan
from acquisition.session import Session
from acquisition.session_mosaic import mosaic_of, warning_of_colours
from acquisition.session_writer import SessionWriter
from calibration.arm_photographs import ArmPhotographs
from devices.bayer import BayerPattern
from devices.errors import DeviceError
from workstation.calibration_messages import messages_on_lights

CHOICES = PhotographChoices(
    exposures_s=(0.05, 0.1, 0.5), code_exposures_s=(0.1,), poses=3, steps=3, period_px=32.0
)


class ColourCamera(TinyCamera):
    """Filters of a mosaic before every pixel."""

    capabilities = replace(TinyCamera.capabilities, bayer=BayerPattern.GBRG)
    filters = np.array([[1.0, 0.4], [0.2, 1.0]])

    def capture(self, exposure_s, *, deadline=None):
        frame = super().capture(exposure_s, deadline=deadline)
        filters = np.tile(self.filters, (HEIGHT // 2, WIDTH // 2))
        noise = np.random.default_rng(frame.sequence).integers(0, 3, filters.shape)
        light = (frame.image - 32.0) * filters
        return replace(frame, image=(32 + light + noise).astype(np.uint16))


class UnsaidColours(ColourCamera):
    """The same without saying so."""

    capabilities = TinyCamera.capabilities


def rig_with(camera):
    scene = TinyScene()
    return tiny_rig(scene, camera=camera(scene))


def recorded(folder, camera):
    rig = rig_with(camera)
    with SessionWriter.create(folder, plan_photographs(rig, CHOICES)) as writer:
        record_plan(writer, rig)
    return Session.open(folder)


def test_the_camera_s_mosaic_is_in_the_plan_of_all_that_it_takes():
    rig = rig_with(ColourCamera)
    for plan in (
        plan_photographs(rig, CHOICES),
        plan_scan(rig, period_px=16, exposure_s=0.1),
        plan_response_scan(rig, exposure_s=(0.1,)),
    ):
        assert plan.camera.mosaic is BayerPattern.GBRG
        assert Plan.model_validate_json(plan.model_dump_json()) == plan


def test_a_plan_without_one_is_written_and_read_as_it_always_was():
    plan = plan_photographs(rig_with(TinyCamera), CHOICES)
    written = json.loads(plan.model_dump_json())
    assert written["camera"] == {"width": WIDTH, "height": HEIGHT}
    assert Plan.model_validate(written).camera.mosaic is None


def test_a_panel_has_none():
    plan = plan_photographs(rig_with(TinyCamera), CHOICES)
    panel = Imager(width=64, height=40, mosaic=BayerPattern.RGGB)
    with pytest.raises(ValueError, match="panel has no mosaic"):
        Plan(**(dict(plan) | {"projector": panel}))


def test_what_the_session_says_counts_and_cannot_be_contradicted(tmp_path):
    session = recorded(tmp_path / "s", ColourCamera)
    assert mosaic_of(session) is BayerPattern.GBRG
    assert mosaic_of(session, BayerPattern.GBRG) is BayerPattern.GBRG
    assert ArmPhotographs.of(session).mosaic is BayerPattern.GBRG
    for ask in (mosaic_of, lambda s, m: ArmPhotographs.of(s, mosaic=m)):
        with pytest.raises(SessionError, match="mosaic of GBRG, not RGGB: leave --mosaic out"):
            ask(session, BayerPattern.RGGB)
    assert recording_of(session).camera.bayer is BayerPattern.GBRG


def test_a_session_goes_on_with_a_camera_of_its_mosaic_only(tmp_path):
    plan = plan_photographs(rig_with(ColourCamera), CHOICES)
    with (
        SessionWriter.create(tmp_path / "s", plan) as writer,
        pytest.raises(DeviceError, match="mosaic of GBRG, this one is monochrome"),
    ):
        record_plan(writer, rig_with(TinyCamera))


def test_colours_of_which_nobody_said_are_seen_in_the_photographs(tmp_path):
    unsaid = recorded(tmp_path / "unsaid", UnsaidColours)
    assert mosaic_of(unsaid) is None
    assert mosaic_of(unsaid, BayerPattern.GBRG) is BayerPattern.GBRG
    assert "name the order of its colours with --mosaic" in warning_of_colours(unsaid, None)
    assert warning_of_colours(unsaid, BayerPattern.GBRG) is None
    lights = SimpleNamespace(
        white=ArmPhotographs.of(unsaid),
        spheres=(),
        arm=SimpleNamespace(poses=(), residual_deg=np.ones(2), shading_excess=1.0),
        direction_sigma_deg=lambda: np.ones(2),
        gates=SimpleNamespace(failures=(), not_tested=()),
    )
    assert "--mosaic" in messages_on_lights(lights).warnings[0]
    # Its pixels differ by as much, by chance.
    assert warning_of_colours(recorded(tmp_path / "grey", TinyCamera), None) is None


def test_a_capture_s_description_carries_it(tmp_path):
    import cv2

    for number in (1, 2, 3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((24, 32), 40 * number, np.uint8))
    said = {
        "name": "test",
        "camera": {"width": 32, "height": 24, "mosaic": "BGGR"},
        "projector": {"width": 64, "height": 40},
        "saturation_level": 255,
        "phase_shift": [{"axis": "column", "periods": 1, "files": ["1.png", "2.png", "3.png"]}],
    }
    plan = find_capture(tmp_path, CaptureDescription.model_validate(said)).plan
    assert plan.camera.mosaic is BayerPattern.BGGR
    for wrong in (
        {"channel": "green"},
        {"projector": {"width": 64, "height": 40, "mosaic": "BGGR"}},
        {"camera": {"width": 32, "height": 24, "mosaic": "XTRANS"}},
    ):
        with pytest.raises(ValueError, match="mosaic"):
            CaptureDescription.model_validate(said | wrong)
