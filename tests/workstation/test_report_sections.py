from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibration.errors import CalibrationError
from workstation.report_sections import (
    ColourPatch,
    LightSection,
    ReportSections,
    ResponseCurve,
    srgb_code,
)
from workstation.section_plots import light_picture, response_picture

LIGHTS = LightSection(
    names=("a", "b"),
    position_mm=np.array([[100.0, 0, 300], [0, 200, 250]]),
    residual_deg=np.array([0.02, 0.05]),
    sigma_deg=np.array([0.03, 0.03]),
)
CURVE = ResponseCurve(
    name="projector",
    input_name="grey",
    output_name="light",
    x=np.linspace(0, 1, 9),
    y=np.linspace(0, 1, 9) ** 2.2,
    sigma_y=np.full(9, 0.01),
)


def picture(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


def test_lights_and_responses_are_drawn():
    for data in (light_picture(LIGHTS), response_picture(CURVE)):
        drawn = picture(data)
        assert drawn.shape[1] == 690
        assert np.ptp(drawn) > 200


def test_sections_are_plain_numbers_in_json():
    patch = ColourPatch(
        name="red",
        reference_srgb=np.array([1.0, 0, 0]),
        measured_srgb=np.array([0.9, 0.1, 0]),
        delta_e_before=4.0,
        delta_e_after=1.0,
    )
    found = ReportSections(lights=LIGHTS, responses=(CURVE,), colours=(patch,)).as_json()
    assert found["lights"][1]["position_mm"] == [0, 200, 250]
    assert found["responses"][0]["x"][-1] == 1.0
    assert found["responses"][0]["sigma_y"] == [0.01] * 9
    assert found["colours"] == [
        {
            "name": "red",
            "reference_srgb": [1.0, 0.0, 0.0],
            "measured_srgb": [0.9, 0.1, 0.0],
            "before": 4.0,
            "after": 1.0,
        }
    ]
    assert ReportSections().as_json() == {}


def test_sections_that_do_not_fit_are_refused():
    with pytest.raises(CalibrationError, match="1 light poses"):
        LightSection(
            names=("a",),
            position_mm=np.zeros((2, 3)),
            residual_deg=np.zeros(1),
            sigma_deg=np.zeros(1),
        )
    with pytest.raises(CalibrationError, match="2 light poses"):
        LightSection(
            names=("a", "b"),
            position_mm=np.zeros((2, 3)),
            residual_deg=np.zeros(1),
            sigma_deg=np.zeros(2),
        )
    with pytest.raises(CalibrationError, match="camera: "):
        ResponseCurve(name="camera", input_name="", output_name="", x=np.zeros(3), y=np.zeros(4))


def test_colours_beyond_the_gamut_are_clipped():
    assert srgb_code(np.array([1.2, -0.1, 0.5])) == "#ff0080"
