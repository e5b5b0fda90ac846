from __future__ import annotations

import shutil
from dataclasses import dataclass
from enum import Enum

import numpy as np
import pytest

from workstation import stage_cache
from workstation.result_files import write_result
from workstation.stage_cache import StageCache, StagesInUseError, digest_of_files, sole_use


class Kind(Enum):
    SHARP = 1


@dataclass(frozen=True)
class Options:
    size: int = 3
    kind: Kind = Kind.SHARP


class Work:
    """Two stages, the second made from the first, that count how often they run."""

    def __init__(self, folder):
        self.folder = folder
        self.ran = []

    def do(self, *, session="s1", size=3, height=0.5):
        begun = []
        cache = StageCache(self.folder, begun.append)

        def first():
            self.ran.append("first")
            return np.arange(size)

        def second():
            self.ran.append("second")
            return {"sum": float(decoded.get().sum()) * height}

        decoded = cache.run("first", first, depends_on=(session,), parameters=Options(size))
        done = cache.run("second", second, depends_on=(decoded.key,), parameters=height)
        assert begun == [run.name for run in cache.runs if not run.skipped]
        return done.get()["sum"], cache.runs


@pytest.fixture
def work(tmp_path):
    return Work(tmp_path / "stages")


def test_nothing_runs_twice(work):
    assert work.do()[0] == 1.5
    value, runs = work.do()
    assert value == 1.5
    assert work.ran == ["first", "second"]
    assert [run.skipped for run in runs] == [True, True]


@pytest.mark.parametrize(
    ("change", "again", "value"),
    [
        ({"height": 2.0}, ["second"], 6.0),
        ({"size": 4}, ["first", "second"], 3.0),
        ({"session": "s2"}, ["first", "second"], 1.5),
    ],
    ids=["second's parameter", "first's parameter", "input"],
)
def test_only_what_depends_on_a_change_runs(work, change, again, value):
    work.do()
    work.ran.clear()
    assert work.do(**change)[0] == value
    assert work.ran == again
    # And back: only one result is kept of each stage.
    work.ran.clear()
    assert work.do()[0] == 1.5
    assert work.ran == again


def test_another_program_runs_everything(work, monkeypatch):
    work.do()
    monkeypatch.setattr(stage_cache, "digest_of_program", lambda: "another version")
    work.do()
    assert work.ran == ["first", "second"] * 2


def test_without_a_folder_every_stage_runs():
    work = Work(None)
    assert work.do()[0] == work.do()[0] == 1.5
    assert work.ran == ["first", "second"] * 2


@pytest.mark.parametrize("file", ["first.json", "first.npz", "second.json", "second.npz"])
@pytest.mark.parametrize("damage", ["missing", "cut", "noise"])
def test_damaged_results_are_made_again(work, file, damage):
    work.do()
    path = work.folder / file
    if damage == "missing":
        path.unlink()
    elif damage == "cut":
        path.write_bytes(path.read_bytes()[:30])
    else:
        path.write_bytes(b"\0" * 300)
    assert work.do()[0] == 1.5
    assert work.do()[0] == 1.5


@pytest.mark.parametrize("other", ["cut", "another result", "another session's"])
def test_a_stage_whose_result_is_not_its_own_runs_and_says_so(work, other, tmp_path):
    work.do()
    file = work.folder / "second.npz"
    if other == "cut":
        file.write_bytes(file.read_bytes()[:-40])
    elif other == "another result":
        write_result({"sum": 7.0}, file)
    else:
        stranger = Work(tmp_path / "elsewhere")
        stranger.do(session="s2", height=4.0)
        shutil.copy(stranger.folder / "second.npz", file)
    work.ran.clear()
    value, runs = work.do()
    assert value == 1.5
    assert work.ran == ["second"]
    assert [(run.name, run.skipped) for run in runs] == [("first", True), ("second", False)]
    # It was stored again.
    assert [run.skipped for run in work.do()[1]] == [True, True]


def test_a_folder_of_stages_has_one_user(tmp_path):
    folder = tmp_path / "stages"
    with sole_use(folder):
        with pytest.raises(StagesInUseError, match="another run"), sole_use(folder):
            pass
        with sole_use(tmp_path / "others"), sole_use(None):
            pass
    with sole_use(folder):
        (folder / "first.json").write_text("{}")
    # Nothing is left where nothing was stored.
    assert [path.name for path in tmp_path.iterdir()] == ["stages"]


def test_where_no_folder_can_be_made_there_is_nothing_to_keep_others_from(tmp_path):
    (tmp_path / "file").write_text("")
    with sole_use(tmp_path / "file" / "stages"):
        pass


def test_a_full_disk_costs_the_next_run_its_time_and_no_more(work, monkeypatch):
    def full(result, path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(stage_cache, "write_result", full)
    assert work.do()[0] == work.do()[0] == 1.5
    assert work.ran == ["first", "second"] * 2
    assert not [path for path in work.folder.iterdir() if path.suffix == ".json"]


def test_files_are_told_apart_by_name_and_content(tmp_path):
    (tmp_path / "a").write_text("1")
    seen = {digest_of_files(tmp_path)}
    (tmp_path / "a").rename(tmp_path / "b")
    seen.add(digest_of_files(tmp_path))
    (tmp_path / "b").write_text("2")
    seen.add(digest_of_files(tmp_path))
    assert len(seen) == 3
