from __future__ import annotations

import numpy as np
import pytest

from acquisition.photograph_plan import PhotographChoices, plan_photographs
from acquisition.recording import record_plan
from acquisition.scan import plan_response_scan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from calibration.arm_photographs import ArmPhotographs
from calibration.errors import CalibrationError
from devices.bayer import BayerPattern
from devices.simulated.settings import PaintingKind, SimulationSettings
from workstation.radiometry_sections import camera_curves, colour_patches, projector_curve

GAMMA = 1.8


@pytest.fixture(scope="module")
def rig():
    return (
        SimulationSettings(
            painting=PaintingKind.WHITE,
            camera_width=96,
            projector_width=64,
            projector_height=48,
            gamma=GAMMA,
        )
        .build()
        .open()
    )


def record(rig, plan, folder):
    with SessionWriter.create(folder, plan) as writer:
        record_plan(writer, rig)
    return folder


@pytest.fixture(scope="module")
def lit(rig, tmp_path_factory):
    choices = PhotographChoices(
        exposures_s=(0.004, 0.008, 0.016, 0.032),
        code_exposures_s=(0.03,),
        poses=2,
        steps=3,
        least_elevation=1.0,
        camera_positions=("front",),
        adaptive=False,
    )
    return record(rig, plan_photographs(rig, choices), tmp_path_factory.mktemp("lit") / "s")


def test_greys_tell_the_projector_s_response_and_repeated_ones_its_errors(rig, tmp_path):
    plan = plan_response_scan(rig, greys=9, exposure_s=(0.02,))
    sessions = [record(rig, plan, tmp_path / name) for name in ("one", "two")]
    for paths in (sessions[:1], sessions):
        curve = projector_curve(paths)
        np.testing.assert_allclose(curve.y, curve.x**GAMMA, atol=0.01)
        assert (curve.sigma_y is None) == (len(paths) == 1)
    # Greys of eight bits and the panel's black move the exponent by a few thousandths.
    assert float(curve.name.split()[3]) == pytest.approx(GAMMA, abs=0.01)


def test_a_white_target_tells_that_the_camera_is_linear(lit):
    photographs = ArmPhotographs.of(Session.open(lit))
    block = np.full((72, 96), -1, np.int32)
    block[20:50, 20:70] = 0
    linearity, noise = camera_curves(photographs, block)
    assert np.abs(linearity.y / linearity.sigma_y).max() < 4
    assert linearity.sigma_y.max() < 0.02
    assert (np.diff(noise.y) > 0).all()


def test_charts_that_are_not_there_and_monochrome_cameras_are_named(lit):
    with pytest.raises(CalibrationError, match="--mosaic"):
        colour_patches(lit, mosaic=None)
    with pytest.raises(CalibrationError, match="holds no photograph of a colour chart"):
        colour_patches(lit, mosaic=BayerPattern.RGGB)
