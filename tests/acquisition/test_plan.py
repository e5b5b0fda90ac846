from __future__ import annotations

import pytest
from pydantic import ValidationError
from synthetic_scan import fringe_patterns, gray_patterns, make_plan

from acquisition.patterns import WHITE, Axis
from acquisition.plan import Crop, Imager, Plan, PlannedFrame


@pytest.fixture
def plan():
    patterns = fringe_patterns(Axis.COLUMN, period=512 / 7, steps=3)
    return make_plan([*patterns, *gray_patterns(Axis.ROW, step=16.0, bits=3), WHITE])


def test_a_plan_survives_json_exactly(plan):
    assert Plan.model_validate_json(plan.model_dump_json()) == plan


def test_a_plan_cannot_be_altered(plan):
    with pytest.raises(ValidationError):
        plan.saturation_level = 3


def changed(plan, **parts):
    return Plan.model_validate({**plan.model_dump(), **parts})


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"frames": ()}, "frames"),
        ({"format": "impasto-plan-2"}, "format"),
        ({"saturation_level": 0}, "saturation_level"),
        ({"camera": {"width": 0, "height": 3}}, "width"),
        ({"colour": "red"}, "colour"),
        ({"crop": Crop(column=1, row=0, width=320, height=240)}, "outside the sensor"),
        ({"camera": Imager(width=320, height=239)}, "outside the sensor"),
    ],
)
def test_plans_that_cannot_be_are_refused(plan, parts, message):
    with pytest.raises(ValidationError, match=message):
        changed(plan, **parts)


def test_a_crop_at_the_sensors_corner_fits(plan):
    crop = Crop(column=310, row=239, width=10, height=1)
    assert changed(plan, crop=crop).crop == crop


def test_frames_have_names_of_their_own(plan):
    first = plan.frames[0]
    with pytest.raises(ValidationError, match="more than once: 0000"):
        changed(plan, frames=(first, first))


@pytest.mark.parametrize("name", ["", "../plan", "a/b", "A", ".hidden", "a.png", "x" * 65, "a\n"])
def test_names_that_are_no_file_names_are_refused(name):
    with pytest.raises(ValidationError, match="id"):
        PlannedFrame(id=name, pattern=WHITE)


@pytest.mark.parametrize("exposure", [0.0, -1.0, float("nan"), float("inf")])
def test_exposures_are_positive_and_finite(exposure):
    with pytest.raises(ValidationError, match="exposure_s"):
        PlannedFrame(id="a", pattern=WHITE, exposure_s=exposure)
