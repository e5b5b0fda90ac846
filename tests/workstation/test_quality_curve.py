from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest

from workstation.pareto_front import beats, pareto_front
from workstation.quality import Quality, expectation, stated_options
from workstation.quality_curve import QualityCurve, QualityCurveError, shipped_curve
from workstation.quality_plots import curve_pictures
from workstation.report_quality import quality_section

RUN = {
    "quality": "draft",
    "expected_seconds": {"decoding": 4.0, "fitting the reflectance": 16.0},
    "stages": [
        {"name": "decoding", "seconds": 0.0, "saved_s": 3.0},
        {"name": "fitting the reflectance", "seconds": 18.0, "saved_s": 0.0},
    ],
}


def test_the_front_is_what_nothing_else_beats():
    points = [(4, 1), (3, 2.5), (2, 2), (1, 3), (2, 2), (5, 1)]
    assert pareto_front(points, lambda point: point) == [(1, 3), (2, 2), (2, 2), (4, 1)]
    # In three figures the point is better in one.
    assert len(pareto_front([(1, 1, 2), (2, 2, 1), (2, 2, 3)], lambda point: point)) == 2
    assert not beats((1, math.nan), (2, 2))
    assert not beats((1, 1), (1, 1))
    # A little better is alike, a little worse is no win.
    assert not beats((1, 1), (1.1, 1), (0.2, 0.2))
    assert beats((1, 1), (1.3, 1), (0.2, 0.2))
    assert not beats((1, 1.1), (9, 1), (0.2, 0.2))


def test_the_curve_that_comes_with_the_program_is_of_todays_options():
    curve = shipped_curve()
    for quality in Quality:
        known, today = curve.options[quality], stated_options(quality)
        changed = {
            name: (value, today.get(name))
            for name, value in known.items()
            if today.get(name) != value
        }
        assert not changed, (
            f"{quality} has other options than when workstation/quality_curve.json was measured: "
            "run impasto bench pipeline --part curves --pictures DIR, and put "
            "DIR/quality-curve.json in its place"
        )
    assert [p.name for p in curve.points if p.default] == ["normal"]


def test_normal_is_on_the_front_and_qualities_trade_time_for_error():
    curve = shipped_curve()
    assert curve.quality("normal") in curve.front
    draft, best = expectation(Quality.DRAFT), expectation(Quality.BEST)
    assert draft.fit_time < 1 < best.fit_time
    assert draft.height_error > 1
    assert draft.heldout_db < 0 < best.heldout_db


def test_a_curve_is_read_as_it_was_written(tmp_path):
    shipped_curve().save(tmp_path / "curve.json")
    assert QualityCurve.load(tmp_path / "curve.json") == shipped_curve()


@pytest.mark.parametrize(
    "change",
    [
        lambda found: found.pop("format"),
        lambda found: found["points"][0].pop("seconds"),
        lambda found: found["points"][0].update(height_mm="much"),
        lambda found: found.update(measured=7),
        lambda found: found.update(points=3),
    ],
)
def test_a_damaged_curve_is_refused(tmp_path, change):
    shipped_curve().save(tmp_path / "curve.json")
    found = json.loads((tmp_path / "curve.json").read_text())
    change(found)
    (tmp_path / "curve.json").write_text(json.dumps(found))
    with pytest.raises(QualityCurveError, match="bench pipeline"):
        QualityCurve.load(tmp_path / "curve.json")


def test_the_report_says_what_was_stated_and_what_came_of_it():
    errors = {"height_sigma_mm": 0.02, "heldout_psnr_db": 31.5}
    section = quality_section(RUN, errors, shipped_curve(), height_mm=0.031)
    rows = {row[0]: row[1:] for row in section.tables[0].rows}
    assert rows["all stages"] == ("20 s", "21 s")
    assert rows["error of heights"][1].startswith("RMS 31.0 µm; standard error 20.0 µm")
    assert rows["photographs kept out of the fit"][1] == "31.5 dB"
    assert shipped_curve().measured in section.text
    plain, ringed = (
        [cv2.imdecode(np.frombuffer(p.content, np.uint8), 1) for p in pictures]
        for pictures in (curve_pictures(shipped_curve()), section.pictures)
    )
    assert all((a != b).any() for a, b in zip(plain, ringed, strict=True))
