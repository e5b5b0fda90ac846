from __future__ import annotations

import json
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import typer
from browser import check_page
from typer.testing import CliRunner

from acquisition.errors import SessionError
from devices.errors import ImpastoError
from workstation.benchmark_page import run_benchmarks
from workstation.benchmark_records import Record, Sense
from workstation.benchmarks.pipeline import curve_records, settings
from workstation.benchmarks.pipeline_scenes import Capture, RecordedScene
from workstation.commands import bench
from workstation.quality import Quality, quality_options
from workstation.quality_curve import CurvePoint, QualityCurve


def record(name, value):
    return Record(name=name, value=value, unit="s", bound=2.0, sense=Sense.AT_MOST)


@pytest.fixture
def three(monkeypatch):
    def drawing(*, pictures):
        cv2.imwrite(str(pictures / "a-curve.png"), np.zeros((4, 5), np.uint8))
        return [record("one", 1.0)]

    def failing():
        raise ImpastoError("no light")

    for name, measure in (
        ("drawing", drawing),
        ("failing", failing),
        ("slow", lambda: [record("two", 3.0)]),
    ):
        module = SimpleNamespace(bench=measure)
        monkeypatch.setitem(sys.modules, f"workstation.benchmarks.{name}", module)
    return ["drawing", "failing", "slow"]


def test_every_benchmark_runs_even_if_one_fails(three, tmp_path):
    done = run_benchmarks(three, tmp_path / "out")
    assert [one.name for one in done.records] == ["one", "two"]
    assert done.failed == {"failing": "no light"}
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "drawing",
        "drawing.json",
        "index.html",
        "slow.json",
    ]
    assert json.loads((tmp_path / "out" / "slow.json").read_text())[0]["holds"] is False
    page = (tmp_path / "out" / "index.html").read_text()
    for said in (
        "1 of 2 figures",
        "It failed: no light",
        "failing failed: no light",
        "a curve",
        "two: 3\xa0s, bound at most 2",
    ):
        assert said in page
    with pytest.raises(SessionError, match="exists already"):
        run_benchmarks(three, tmp_path / "out")


def test_the_page_is_whole_and_reachable_in_a_browser(browser, three, monkeypatch, tmp_path):
    named = Record(
        name="procam.heldout_repeatability_detrended_over_predicted_mm",
        value=-0.00012345,
        unit="mm",
        bound=(-1e-3, 1e-3),
        sense=Sense.WITHIN,
        note="of /a/folder/of/real/captures/that_has_a_name_as_long_as_they_come, 20 seeds",
    )
    module = SimpleNamespace(bench=lambda: [named])
    monkeypatch.setitem(sys.modules, "workstation.benchmarks.long", module)
    run_benchmarks([*three, "long"], tmp_path / "out")
    check_page(browser, tmp_path / "out" / "index.html")


@pytest.mark.parametrize("words", [["all"], ["surface", "--out", "x"], ["all", "--part", "a"]])
def test_a_folder_goes_with_all_benchmarks_and_no_others(words):
    app = typer.Typer()
    bench.register(app)
    assert CliRunner().invoke(app, words).exit_code == 2


def point(name, seconds, height, decibel, *, recording_s=0.0):
    curve, default = ("quality", True) if name == "normal" else ("steps", False)
    return CurvePoint(
        curve, name, seconds, seconds, recording_s, height, decibel, 9, 9, default=default
    )


def values(*points):
    records = curve_records(QualityCurve(points, "a scene", "today", "impasto", "here", {}))
    return {one.name: one.value for one in records}


def test_what_beats_the_defaults_is_told():
    usual = point("normal", 2, 2, 30)
    others = [point("4", 1, 3, 20), point("16", 4, 1, 31), point("8", 3, 2.5, 29)]
    found = values(usual, *others)
    assert found["pipeline.normal_on_front"] == 1
    assert found["pipeline.heights_beat_normal"] == found["pipeline.reflectance_beat_normal"] == 0
    assert found["pipeline.steps.16"] == 4
    found = values(usual, *others, point("better", 1.5, 1.5, 30.5))
    assert found["pipeline.normal_on_front"] == 0
    assert found["pipeline.heights_beat_normal"] == found["pipeline.reflectance_beat_normal"] == 1
    # By less than processors differ from run to run.
    alike = values(usual, point("like", 1.95, 1.99, 30.05))
    assert alike["pipeline.heights_beat_normal"] == 0
    assert alike["pipeline.normal_on_front"] == 1
    # What is quicker to process is dearer where it takes longer to record.
    dear = values(usual, point("more frames", 1.5, 1.5, 30.5, recording_s=3))
    assert dear["pipeline.normal_on_front"] == 1
    assert dear["pipeline.steps.more_frames"] == 4.5


def test_one_setting_is_the_default_and_it_is_that_of_the_command():
    defaults = [(capture, options) for _, _, capture, options, default in settings() if default]
    assert defaults == [(Capture(), quality_options(Quality.NORMAL))]


def test_a_recorded_scene_is_judged_by_photographs_that_it_does_not_see(tmp_path):
    scene = RecordedScene.of("small_oil", tmp_path / "scene", width=96)
    capture = Capture(steps=4, lamp_poses=6)
    draft = quality_options(Quality.DRAFT)
    found = scene.measure(capture, draft, curve="quality", name="draft", default=False)
    assert 0.05 < found.height_mm < 0.4
    # Without the shadow that the frame throws, some 20 dB.
    assert 21 < found.heldout_db < 40
    assert 0 < found.fit_seconds < found.seconds
    # Some hundred frames, and the arm's way between six poses from two places.
    assert 30 < found.recording_s < 300
    assert {path.name for path in scene.folder.iterdir() if path.is_dir()} == {
        "rig",
        "scan-4-1",
        "photographs-6",
        "judges",
    }
