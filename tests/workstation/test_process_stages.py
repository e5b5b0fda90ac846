from __future__ import annotations

import errno
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from calibration.rig_geometry import RigGeometry
from devices.errors import ImpastoError
from devices.simulated.rig import demo_rig
from fitting.copy_files import read_copy
from fitting.relief_classification import ReliefOptions
from fitting.surface import SurfaceOptions
from workstation import copy_writing, processing
from workstation.commands import process
from workstation.copy_places import held_out_picture, relief_picture, run_file, stages_folder
from workstation.demonstration import record_simulated_scan
from workstation.processing import (
    DECODING,
    FIGURES,
    RELIEF,
    SURFACE,
    ProcessingOptions,
    process_session,
)
from workstation.quality import Quality, quality_options
from workstation.stage_cache import (
    StageCache,
    StageRun,
    StagesInUseError,
    digest_of_files,
    sole_use,
)
from workstation.stage_progress import StageClock, clock_text


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    path = tmp_path_factory.mktemp("scan") / "session"
    record_simulated_scan(demo_rig(camera_width=160), path)
    return path


@pytest.fixture(scope="module")
def kept(session, tmp_path_factory):
    """Stored results of a first run."""
    folder = tmp_path_factory.mktemp("kept") / "stages"
    process_session(session, stages=StageCache(folder))
    return folder


@pytest.fixture
def stages(kept, tmp_path):
    shutil.copytree(kept, tmp_path / "stages")
    return StageCache(tmp_path / "stages")


def ran(stages):
    return [run.name for run in stages.runs if not run.skipped]


def command(*arguments):
    app = typer.Typer()
    process.register(app)
    return CliRunner().invoke(app, [*map(str, arguments)])


def test_nothing_runs_twice_and_the_copy_is_the_same(session, stages):
    first = process_session(session)
    again = process_session(session, stages=stages)
    assert ran(stages) == []
    assert again.figures["texels"] == first.figures["texels"]
    assert again.copy.provenance == first.copy.provenance
    np.testing.assert_array_equal(again.copy.height_field.height, first.copy.height_field.height)


def test_another_threshold_classifies_the_relief_and_nothing_else(session, stages):
    options = ProcessingOptions(surface=SurfaceOptions(relief=ReliefOptions(delta0_mm=0.37)))
    done = process_session(session, options=options, stages=stages)
    assert ran(stages) == [RELIEF]
    assert done.copy.relief.delta0_mm == 0.37
    assert done.figures["delta0_mm"] == 0.37
    fresh = process_session(session, options=options)
    assert (fresh.copy.relief.significant == done.copy.relief.significant).all()


def test_another_pitch_or_calibration_keeps_what_was_decoded(session, stages, tmp_path):
    process_session(session, options=quality_options(Quality.DRAFT), stages=stages)
    assert ran(stages) == [SURFACE, RELIEF, FIGURES]
    stages.runs.clear()
    rig = RigGeometry.load(session / "calibration")
    moved = replace(rig, rt_proj_cam=rig.rt_proj_cam * 1.001)
    moved.save(tmp_path / "rig")
    process_session(session, calibration=tmp_path / "rig", stages=stages)
    assert ran(stages) == [SURFACE, RELIEF, FIGURES]


def test_what_was_cut_off_goes_on(session, tmp_path, monkeypatch):
    def cut_off(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(processing, "reconstruct_surface", cut_off)
    stages = StageCache(tmp_path / "stages")
    with pytest.raises(KeyboardInterrupt):
        process_session(session, stages=stages)
    monkeypatch.undo()
    stages = StageCache(tmp_path / "stages")
    process_session(session, stages=stages)
    assert ran(stages) == [SURFACE, RELIEF, FIGURES]
    assert [run.name for run in stages.runs if run.skipped] == [DECODING]


def test_the_command_goes_from_draft_to_what_is_up_to_date(session, tmp_path):
    out, figures = tmp_path / "copy", tmp_path / "f.json"
    done = command(session, "--out", out, "--quality", "draft", "--json", figures)
    assert done.exit_code == 0, done.output
    assert "draft: about" in done.output
    assert "times those of normal" in done.output
    draft = json.loads(figures.read_text())
    before = digest_of_files(out)
    assert json.loads(run_file(out).read_text())["stages"] == draft["stages"]
    assert all(stage["peak_mb"] > 10 for stage in draft["stages"])
    again = tmp_path / "again.json"
    done = command(session, "--out", out, "--quality", "draft", "--json", again)
    assert "is up to date" in done.output
    assert "spared" in done.output
    assert digest_of_files(out) == before
    known = json.loads(again.read_text())
    assert all(stage["skipped"] for stage in known["stages"])
    assert known["texels"] == draft["texels"]
    done = command(session, "--out", out, "--quality", "draft", "--delta0", 0.3)
    assert "is up to date" not in done.output
    assert read_copy(out).relief.delta0_mm == 0.3
    assert command(session, "--out", out, "--quality", "draft").exit_code == 0
    assert digest_of_files(out) == before
    # A copy that was damaged, or a file beside it that was removed, is written again.
    (out / "relief.exr").unlink()
    assert "is up to date" not in command(session, "--out", out, "--quality", "draft").output
    assert digest_of_files(out) == before
    run_file(out).unlink()
    assert "is up to date" not in command(session, "--out", out, "--quality", "draft").output
    assert run_file(out).is_file()
    with sole_use(stages_folder(out)):
        done = command(session, "--out", out, "--quality", "draft", "--delta0", 0.4)
    assert isinstance(done.exception, StagesInUseError)
    done = command(session, "--out", out, "--afresh", "--json", figures)
    assert done.exit_code == 0, done.output
    normal = json.loads(figures.read_text())
    assert not any(stage["skipped"] for stage in normal["stages"])
    assert normal["texels"] > 2 * draft["texels"]
    provenance = read_copy(out).provenance
    assert provenance["parameters"]["surface"]["pitch_factor"] == 1.0
    assert provenance["errors"]["decoded_sigma_px"]["column"] > 0


def test_a_copy_of_another_session_is_not_replaced(session, tmp_path):
    out = tmp_path / "copy"
    assert command(session, "--out", out, "--afresh").exit_code == 0
    header = json.loads((out / "copy.json").read_text())
    header["provenance"]["session"] = "another"
    (out / "copy.json").write_text(json.dumps(header))
    refused = command(session, "--out", out, "--afresh")
    assert "exists already" in str(refused.exception)
    assert not stages_folder(out).exists()
    assert command(session, "--out", out, "--afresh", "--force").exit_code == 0
    assert read_copy(out).provenance["session"] != "another"


def test_pictures_beside_a_copy_are_its_own_wherever_it_is_moved(session, tmp_path):
    out, moved = tmp_path / "copy", tmp_path / "moved"
    assert command(session, "--out", out).exit_code == 0
    held_out_picture(out).write_bytes(b"of a copy with photographs that was here")
    assert command(session, "--out", out).exit_code == 0
    assert not held_out_picture(out).exists()
    out.rename(moved)
    stages_folder(out).rename(stages_folder(moved))
    assert "is up to date" not in command(session, "--out", moved).output
    assert relief_picture(moved).read_bytes() == relief_picture(out).read_bytes()
    assert run_file(moved).is_file()
    # Nor is a note believed that was damaged.
    note = stages_folder(moved) / "written.json"
    damaged = json.loads(note.read_text())
    del damaged["figures"]["stages"]
    note.write_text(json.dumps(damaged))
    again = command(session, "--out", moved)
    assert again.exit_code == 0, again.output
    assert "is up to date" not in again.output
    assert "is up to date" in command(session, "--out", moved).output


def test_no_copy_appears_whose_picture_has_no_room(session, tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(copy_writing, "draw_relief", full)
    done = command(session, "--out", tmp_path / "new" / "copy", "--afresh")
    assert isinstance(done.exception, OSError)
    assert list((tmp_path / "new").iterdir()) == []


def test_time_left_falls_to_nothing_and_follows_the_pace(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    clock = StageClock({"a": 10.0, "b": 30.0}, _begun=0.0)
    assert clock.left_s == 40.0
    clock.begin("a")
    now[0] = 5.0
    assert clock.left_s == 35.0
    assert clock.share == pytest.approx(5 / 40)
    now[0] = 20.0
    clock.done(StageRun("a", 20.0, False))
    # Twice as slow as expected: what is left takes longer too, if not quite twice as long.
    assert 30.0 < clock.left_s < 60.0
    clock.done(StageRun("b", 0.0, True, 30.0))
    assert clock.left_s == 0.0
    assert clock.share == 1.0


def test_times_are_said_as_people_say_them():
    assert [clock_text(s) for s in (0.04, 9.94, 42, 100, 3725)] == [
        "0.0 s",
        "9.9 s",
        "42 s",
        "1 min 40 s",
        "1 h 02 min",
    ]


def test_a_recording_that_was_changed_since_is_looked_at_again(session, tmp_path):
    mine, out = tmp_path / "session", tmp_path / "copy"
    shutil.copytree(session, mine)
    assert command(mine, "--out", out, "--quality", "draft").exit_code == 0
    assert "is up to date" in command(mine, "--out", out, "--quality", "draft").output
    models = mine / "calibration" / "projector.cameramodel"
    models.write_text(models.read_text().replace("extrinsics", "extrinsics "))
    done = command(mine, "--out", out, "--quality", "draft")
    assert "is up to date" not in done.output
    assert isinstance(done.exception, ImpastoError)
