"""A report is of one copy: of what else is named, only what that copy was made from is shown."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic_copy import make_copy
from tiny_rig import TinyScene, tiny_rig

from acquisition.recording import record_plan
from acquisition.scan import plan_response_scan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from fitting.copy_files import write_copy
from fitting.errors import CopyError
from workstation.copy_places import run_file
from workstation.copy_writing import HELD_OUT_FILE, HELD_OUT_FOLDER, write_run
from workstation.report_reflectance import held_out_section
from workstation.report_sources import calibration_behind, find_sources
from workstation.stage_cache import digest_of_files


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Two sessions of one rig, with its calibration."""
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "rig").mkdir()
    (folder / "rig" / "camera.cameramodel").write_text("a lens")
    for name, exposure_s in (("mine", 0.1), ("other", 0.2)):
        rig = tiny_rig(TinyScene())
        plan = plan_response_scan(rig, greys=3, exposure_s=(exposure_s,))
        with SessionWriter.create(folder / name, plan, calibration=folder / "rig") as writer:
            record_plan(writer, rig)
    return folder


@pytest.fixture
def provenance(recorded):
    return {
        "session": Session.open(recorded / "mine").digest,
        "photographs": Session.open(recorded / "other").digest,
        "calibration": digest_of_files(recorded / "rig"),
    }


def test_what_the_copy_was_made_from_is_taken(recorded, provenance, tmp_path):
    found = find_sources(
        *(tmp_path, provenance),
        session=recorded / "mine",
        photographs=recorded / "other",
        calibration=recorded / "rig",
    )
    assert (found.session.path, found.photographs.path) == (recorded / "mine", recorded / "other")
    assert (found.run, found.warnings) == (None, ())
    assert find_sources(tmp_path, provenance).session is None


@pytest.mark.parametrize("option", ["session", "photographs"])
def test_other_sessions_are_refused_by_their_digests(recorded, provenance, tmp_path, option):
    foreign = {"session": recorded / "other", "photographs": recorded / "mine"}[option]
    with pytest.raises(CopyError, match=r"is not what .* was made from") as refused:
        find_sources(tmp_path, provenance, **{option: foreign})
    for digest in (Session.open(foreign).digest, provenance[option]):
        assert digest[:12] in str(refused.value)
    with pytest.raises(CopyError, match="does not say that it was made from"):
        find_sources(tmp_path, {}, **{option: foreign})


def test_the_calibration_is_that_which_was_used(recorded, provenance, tmp_path):
    session = Session.open(recorded / "mine")
    own = session.calibration_folder
    assert calibration_behind(provenance, session) == own
    # Copies of earlier versions do not say which.
    assert calibration_behind({}, session) == own
    (tmp_path / "camera.cameramodel").write_text("another lens")
    used = provenance | {"calibration": digest_of_files(tmp_path)}
    assert calibration_behind(used, session) is None
    assert calibration_behind(used, session, tmp_path) == tmp_path
    for refuse in (
        lambda: calibration_behind(used, session, recorded / "rig"),
        lambda: find_sources(tmp_path, used, calibration=recorded / "rig"),
    ):
        with pytest.raises(CopyError, match=provenance["calibration"][:12]):
            refuse()


def test_the_record_of_another_run_is_left_out(tmp_path):
    for name, height in (("mine", 0.5), ("other", 0.7)):
        write_copy(make_copy(np.full((8, 8), height)), tmp_path / name)
        done = SimpleNamespace(figures={}, stages=SimpleNamespace(runs=[]))
        write_run(done, tmp_path / name, {"quality": "draft"})
    mine = tmp_path / "mine"
    found = find_sources(mine, {})
    assert found.run["quality"] == "draft"
    assert not found.warnings
    shutil.copy(run_file(tmp_path / "other"), run_file(mine))
    found = find_sources(mine, {})
    assert found.run is None
    assert "mine-run.json is not the record of this copy" in found.warnings[0]
    run_file(mine).write_text(json.dumps({"stages": []}))
    assert find_sources(mine, {}).run is None


STAGE = {"name": "decoding", "seconds": 1.0, "skipped": False, "saved_s": 0.0}


@pytest.mark.parametrize(
    "damage",
    [
        {"stages": [STAGE | {"saved_s": None}]},
        {"stages": [STAGE | {"seconds": "1"}]},
        {"stages": [STAGE | {"seconds": math.nan}]},
        {"stages": [list(STAGE)]},
        {"quality": "splendid"},
        {"quality": None},
        {"expected_seconds": [1]},
        {"expected_seconds": {"decoding": "a"}},
        {"rays": 5},
        {"rays": {"tested": 1}},
    ],
)
def test_a_record_that_makes_no_sense_is_left_out(tmp_path, damage):
    copy = tmp_path / "copy"
    write_copy(make_copy(np.full((8, 8), 0.5)), copy)
    whole = {"copy": digest_of_files(copy), "quality": "draft", "stages": [STAGE]}
    run_file(copy).write_text(json.dumps(whole))
    assert find_sources(copy, {}).run == whole
    run_file(copy).write_text(json.dumps(whole | damage))
    assert find_sources(copy, {}).run is None


@pytest.mark.parametrize(
    "damage",
    [
        {"errors": []},
        {"errors": {"height_noise": {}}},
        {"errors": {"height_noise": {"predicted_mm": None, "observed_mm": 1.0}}},
        {"errors": {"height_sigma_mm": None}},
        {"errors": {"canvas_shape": {"bow_x_mm": 1.0}}},
        {"errors": {"calibration_uncertainty": {}}},
        {"reflectance": 5},
        {"reflectance": {"materials": [{"k": "a"}]}},
        {"warnings": 5},
    ],
)
def test_a_copy_that_makes_no_sense_of_its_making_is_refused(damage):
    with pytest.raises(CopyError, match=rf"copy.json: provenance.{next(iter(damage))}.*again"):
        find_sources(Path("none"), damage)


def test_photographs_kept_out_are_listed_where_their_noise_is_not_known(tmp_path):
    """Older copies hold nothing of it, and what is not finite is null in JSON."""
    known = {"name": "front", "psnr_db": 30.0, "delta_e": 2.0}
    null = {"noise_psnr_db": None, "noise_delta_e": None}
    (tmp_path / HELD_OUT_FILE).write_text(json.dumps([known, known | null]))
    rows = held_out_section(tmp_path).tables[0].rows
    assert rows == (("front", "30.0 dB", "–", "2.00", "–"),) * 2


def test_photographs_kept_out_are_listed_without_their_pictures_too(tmp_path):
    figures = {"psnr_db": 30.0, "delta_e": 2.0, "noise_psnr_db": 40.0, "noise_delta_e": 1.0}
    rows = [{"name": name} | figures for name in ("front", "left")]
    (tmp_path / HELD_OUT_FILE).write_text(json.dumps(rows))
    section = held_out_section(tmp_path)
    assert [row[0] for row in section.tables[0].rows] == ["front", "left"]
    assert not section.comparisons
    assert "2 the pictures are not in the copy" in section.text
    folder = tmp_path / HELD_OUT_FOLDER
    folder.mkdir()
    for kind in ("measured", "rendered"):
        (folder / f"left-{kind}.png").write_bytes(b"a picture")
    section = held_out_section(tmp_path)
    assert len(section.comparisons) == 1
    assert "slider" in section.text
