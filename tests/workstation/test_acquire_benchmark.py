from __future__ import annotations

import cv2
import numpy as np
import pytest

from acquisition.patterns import PhaseShift
from acquisition.scan_plan import plan_structured_light
from devices.simulated.settings import PaintingKind, SimulationSettings
from devices.simulated.truth import truth_of
from workstation.benchmarks.frames_against_error import (
    Outcome,
    PlanKind,
    _fixed_plans,
    draw_outcomes,
    skip_records,
)
from workstation.benchmarks.response_capture import CAPTURE, gamma_record
from workstation.benchmarks.torture_decoding import optically_decodable

FULL = Outcome(PlanKind.FULL, "full", 96, 0.9, 0.030)


def test_a_metered_plan_is_held_against_the_full_one():
    metered = Outcome(PlanKind.METERED, "60 µm", 56, 0.9, 0.031)
    records = {r.name: r for r in skip_records(FULL, metered, [])}
    assert records["skip.frames_fraction"].value == pytest.approx(56 / 96)
    assert records["skip.height_error_ratio"].value == pytest.approx(31 / 30)
    assert all(record.holds for record in records.values())
    worse = Outcome(PlanKind.METERED, "60 µm", 60, 0.8, 0.033)
    assert not any(record.holds for record in skip_records(FULL, worse, []))


def test_outcomes_are_drawn(tmp_path):
    outcomes = [
        FULL,
        Outcome(PlanKind.METERED, "60 µm", 56, 0.9, 0.031),
        Outcome(PlanKind.FIXED, "9 periods", 32, 0.67, 0.034),
    ]
    draw_outcomes(outcomes, tmp_path / "drawn.png")
    assert cv2.imread(str(tmp_path / "drawn.png")).std() > 10


def test_fixed_plans_are_parts_of_the_full_one():
    full = plan_structured_light(
        camera_size=(80, 60),
        projector_size=(912, 570),
        saturation_level=1023,
        exposure_s=(1 / 60, 3 / 60, 9 / 60),
    )
    plans = dict(_fixed_plans(full))
    assert len(plans) == 11
    one = plans["3 periods, 4 steps"]
    assert {frame.exposure_s for frame in one.frames} == {3 / 60}
    fringes = [f.pattern for f in one.frames if isinstance(f.pattern, PhaseShift)]
    assert sorted({round(np.degrees(p.shift_rad)) for p in fringes}) == [0, 90, 180, 270]
    assert len(plans["1+3+9 periods, 4 steps"].frames) == len(full.frames) - 3 * 2 * 4


def test_what_is_optically_decodable_follows_from_the_light_alone():
    """White paper is, wherever the panel lights it; with too much ambient light none of it is."""
    settings = {"painting": PaintingKind.WHITE, "camera_width": 64}
    rig = SimulationSettings(**settings).build()
    truth = truth_of(rig.scene)
    lit = (truth.shading > 0) & (truth.panel >= 0).all(axis=-1)
    lit &= (truth.panel <= [1279, 799]).all(axis=-1)
    paper = lit & (truth.points[..., 2] > -1)
    assert paper.sum() > 1000
    assert optically_decodable(rig, truth)[paper].all()
    assert not optically_decodable(rig, truth)[~lit].any()
    glaring = SimulationSettings(**settings, ambient=10.0).build()
    assert not optically_decodable(glaring, truth_of(glaring.scene)).any()


def test_one_response_straightens_two_real_distortions(real_data):
    record = gamma_record(real_data / CAPTURE)
    assert record.holds
    assert record.runs == 2
