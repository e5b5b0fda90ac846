"""What stages took is known by quality."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_copy import make_copy

from fitting.digital_copy import ReflectanceMaps
from workstation.report_reflectance import reflectance_section
from workstation.report_stages import stages_section
from workstation.stage_cache import StageRun
from workstation.stage_times import note_times, times_before


def test_each_quality_has_times_of_its_own(tmp_path):
    note_times(tmp_path, "normal", [StageRun("fitting", 45.0, False, 0.0)])
    note_times(tmp_path, "draft", [StageRun("fitting", 4.0, False, 0.0)])
    note_times(tmp_path, "normal", [StageRun("decoding", 0.1, True, 7.0)])
    note_times(tmp_path, "normal", [StageRun("fitting", 0.1, True, 0.0)])
    assert times_before(tmp_path, "normal") == {"fitting": 45.0, "decoding": 7.0}
    assert times_before(tmp_path, "draft") == {"fitting": 4.0}
    assert times_before(tmp_path, "best") == {}


@pytest.mark.parametrize("content", ["{torn", "[]", '{"draft": 3}', '{"draft": {"fitting": []}}'])
def test_times_that_make_no_sense_are_not_known(tmp_path, content):
    (tmp_path / "times.json").write_text(content)
    assert times_before(tmp_path, "draft") == {}
    assert times_before(None, "draft") == {}
    note_times(tmp_path / "nowhere", "draft", [])
    assert not (tmp_path / "nowhere").exists()


def test_a_page_says_no_time_that_nobody_expected():
    stages = [{"name": "decoding", "seconds": 2.0, "skipped": False, "saved_s": 0.0}]
    silent = stages_section({"quality": "draft", "stages": stages}, ())
    assert "expected" not in silent.text
    assert silent.text.startswith("Quality draft. ")
    told = stages_section(
        {"quality": "draft", "stages": stages, "expected_seconds": {"decoding": 3.0}}, ()
    )
    assert "expected to take 3.0 s" in told.text


def test_a_material_s_misfit_is_floor_and_share_together():
    flat = make_copy(np.zeros((8, 8)))
    ones = np.ones((8, 8, 4), np.float32)
    maps = ReflectanceMaps(0.1 * ones[..., :3], 0.1 * ones[..., :3], ones)
    floors = ((0.05 * 0.2 / np.pi, 0.0), (0.03 * 0.2 / np.pi, 0.04))
    materials = [
        {"k": 3.0, "variant": "FREE", "misfit": floor, "misfit_relative": share}
        for floor, share in floors
    ]
    made = replace(flat, reflectance=maps, provenance={"reflectance": {"materials": materials}})
    table = reflectance_section(made).tables[-1]
    assert table.heading[-1] == "misfit, of a 20 % grey's radiance"
    assert [row[-1] for row in table.rows] == ["5.0 %", "5.0 %"]
