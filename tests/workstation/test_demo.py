from __future__ import annotations

import json

import numpy as np
import pytest
import typer
from browser import check_page
from typer.testing import CliRunner

from acquisition.session import Session
from calibration.lens import compose
from fitting.copy_files import read_copy
from workstation.commands import demo
from workstation.copy_writing import write_processed
from workstation.demo_job import SESSIONS_FOLDER
from workstation.demo_processing import process_demo
from workstation.demo_recording import DemoCapture, DemoRecorder, DemoSize, replay_sessions
from workstation.demonstration import align_to_truth, measure_height_error, rt_true_camera
from workstation.destinations import DEMO_FILE
from workstation.stage_cache import StageCache, digest_of_files


def run(*arguments):
    app = typer.Typer()
    demo.register(app)
    return CliRunner().invoke(app, [*map(str, arguments)])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "demo"
    done = run("--size", "tiny", "--out", folder, "--json", folder.with_suffix(".json"))
    assert done.exit_code == 0, done.output
    assert f"open {folder / 'index.html'}" in done.output
    return folder


def test_the_demo_is_as_accurate_as_it_predicts(made):
    figures = json.loads((made / "report.json").read_text())
    assert figures == json.loads(made.with_suffix(".json").read_text())
    truth = figures["truth"]
    assert 0.8 < truth["height_rms_over_predicted"] < 1.25
    assert 0.9 < truth["z_spread"] < 1.15
    assert abs(truth["height_bias_mm"]) < 0.2 * truth["height_rms_predicted_mm"]
    assert truth["texels_outside_canvas"] == 0
    assert max(truth["camera_mm"].values()) < 0.5
    # Nearly the whole canvas of 120 × 90 mm is there, less shadow of the frame and erosion.
    assert figures["texels"] * figures["pitch_mm"] ** 2 > 0.75 * 120 * 90
    # Texels of 1.2 mm are coarser than the strokes: the usual size does better.
    assert figures["reflectance"]["held_out"]["psnr_db"] > 22
    assert len(list((made / "renders").glob("*.png"))) == 6
    assert {"decoding", "fitting the reflectance"} <= {s["name"] for s in figures["stages"]}
    assert figures["peak_mb"] < 3000
    bounds = {record["name"]: record for record in figures["bounds"]}
    assert bounds["demo.height_rms_over_predicted"]["holds"]
    assert bounds["demo.peak_mb"]["value"] == figures["peak_mb"]
    # Of texels this coarse, and a rig that is declared.
    assert not bounds["demo.heldout_psnr_db"]["holds"]
    assert "demo.stereo_px" not in bounds


def test_its_report_has_every_part_and_the_copy_its_reflectance(made):
    page = (made / "index.html").read_text()
    for part in (
        *("Photographs kept out", "Against the truth", "Reflectance", "Stages", "Views"),
        *("Run time against error", "Figures and bounds"),
    ):
        assert f"<h2>{part}</h2>" in page
    assert page.count('type="range"') == 2
    assert "in-progress" not in page
    copy = read_copy(made / "copy")
    assert copy.reflectance is not None
    # Paint is no brighter than white, and no darker than soot.
    albedo = np.pi * np.median(copy.reflectance.diffuse[copy.height_field.mask], axis=0)
    assert (albedo > 0.05).all()
    assert (albedo < 1).all()


def test_its_report_is_whole_and_reachable_in_a_browser(browser, made):
    check_page(browser, made / "index.html")


def test_replayed_sessions_give_the_identical_copy(made, tmp_path):
    sessions = tmp_path / SESSIONS_FOLDER
    replay_sessions(made / SESSIONS_FOLDER, sessions)
    done = process_demo(sessions, made, DemoCapture.of(DemoSize.TINY), StageCache(None))
    write_processed(done, tmp_path / "copy")
    assert digest_of_files(tmp_path / "copy") == digest_of_files(made / "copy")


@pytest.fixture(scope="module")
def rig():
    return DemoCapture.of(DemoSize.TINY).rig(seed=0)


def test_the_same_seed_records_the_same(made, rig, tmp_path):
    recorder = DemoRecorder(rig, DemoCapture.of(DemoSize.TINY), tmp_path)
    recorder.record_scan(made / "rig")
    recorder.record_photographs()
    for name in ("scan", "photographs"):
        again, first = Session.open(tmp_path / name), Session.open(made / SESSIONS_FOLDER / name)
        assert again.digest == first.digest
        times = [[round(s.recorded[f.id].wall_time, 6) for f in s.frames] for s in (again, first)]
        assert times[0] == times[1]


def test_a_demo_is_replaced_only_if_that_is_asked_for(made):
    before = digest_of_files(made)
    refused = run("--size", "tiny", "--out", made)
    assert "exists already" in str(refused.exception)
    (made / DEMO_FILE).rename(made / "kept.json")
    assert "exists already" in str(run("--size", "tiny", "--out", made, "--force").exception)
    (made / "kept.json").rename(made / DEMO_FILE)
    assert digest_of_files(made) == before


def test_a_copy_elsewhere_is_brought_back_to_the_truth(made, rig):
    copy = read_copy(made / "copy")
    pose = align_to_truth(copy, rig)
    aligned = measure_height_error(copy, rig, rt_true_canvas=pose)
    turned = compose(np.array([0.004, -0.003, 0.002, 0.5, -0.4, 0.3]), pose)
    assert measure_height_error(copy, rig, rt_true_canvas=turned).observed_rms_mm > 3 * (
        aligned.observed_rms_mm
    )
    # The true camera's frame is the rig's here, as it was declared.
    assert np.abs(pose - compose(rt_true_camera(rig), copy.height_field.rt_cam_canvas)).max() < 0.1


def test_nothing_is_left_of_a_demo_that_fails(tmp_path, monkeypatch):
    def full(*arguments, **named):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("workstation.demo_job.DemoRecorder", full)
    monkeypatch.setattr("workstation.demo_recording.demo_rig", lambda **named: None)
    assert run("--size", "tiny", "--out", tmp_path / "demo").exception is not None
    assert list(tmp_path.iterdir()) == []
