from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from acquisition.atomic_files import (
    file_in_progress,
    folder_in_progress,
    remove_leftovers,
    write_bytes,
)


def content_of(folder: Path) -> dict[str, bytes]:
    files = (f for f in folder.rglob("*") if f.is_file())
    return {f.relative_to(folder).as_posix(): f.read_bytes() for f in files}


def test_a_file_replaces_the_old_one_only_when_it_is_whole(tmp_path):
    destination = tmp_path / "figures.json"
    write_bytes(destination, b"old")
    with file_in_progress(destination) as temporary:
        assert temporary.suffix == ".json"
        temporary.write_bytes(b"new")
        assert destination.read_bytes() == b"old"
    assert content_of(tmp_path) == {"figures.json": b"new"}


@pytest.mark.parametrize("failure", [OSError("disk full"), KeyboardInterrupt()])
def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path, failure):
    write_bytes(tmp_path / "a.txt", b"old")
    with pytest.raises(type(failure)), file_in_progress(tmp_path / "a.txt") as temporary:
        temporary.write_bytes(b"ha")
        raise failure
    assert content_of(tmp_path) == {"a.txt": b"old"}


def test_the_flush_comes_before_the_rename(tmp_path, monkeypatch):
    calls = []
    fsync, replace = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda f: (calls.append("fsync"), fsync(f)))
    monkeypatch.setattr(Path, "replace", lambda a, b: (calls.append("rename"), replace(a, b)))
    write_bytes(tmp_path / "a", b"x")
    assert calls == ["fsync", "rename", "fsync"]


def test_files_and_folders_get_the_usual_permissions(tmp_path):
    mask = os.umask(0o022)
    try:
        write_bytes(tmp_path / "a", b"x")
        with folder_in_progress(tmp_path / "f"):
            pass
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o644
    assert stat.S_IMODE((tmp_path / "f").stat().st_mode) == 0o755


def test_a_file_in_no_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"b\.json: there is no folder"):
        write_bytes(tmp_path / "a" / "b.json", b"x")


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    destination = tmp_path / "deep" / "copy"
    with folder_in_progress(destination) as folder:
        (folder / "a").write_bytes(b"1")
        assert not destination.exists()
    assert content_of(destination) == {"a": b"1"}
    with pytest.raises(KeyboardInterrupt), folder_in_progress(tmp_path / "b") as folder:
        (folder / "a").write_bytes(b"1")
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["deep"]


def test_a_folder_is_replaced_only_when_that_is_asked_for(tmp_path):
    destination = tmp_path / "copy"
    for text in (b"1", b"2"):
        with folder_in_progress(destination, replace=True) as folder:
            (folder / text.decode()).write_bytes(text)
    assert content_of(tmp_path) == {"copy/2": b"2"}
    with pytest.raises(FileExistsError, match="copy exists"), folder_in_progress(destination):
        pass
    with pytest.raises(OSError, match="full"), folder_in_progress(destination, replace=True):
        raise OSError("full")
    assert content_of(tmp_path) == {"copy/2": b"2"}


def test_what_appears_while_a_folder_is_filled_stays(tmp_path):
    destination = tmp_path / "copy"
    with (
        pytest.raises(FileExistsError, match="appeared meanwhile"),
        folder_in_progress(destination) as folder,
    ):
        (folder / "a").write_bytes(b"1")
        destination.mkdir()
        (destination / "b").write_bytes(b"2")
    assert content_of(tmp_path) == {"copy/b": b"2"}


def test_what_a_killed_writer_left_is_told_from_real_files(tmp_path):
    (tmp_path / "frames").mkdir()
    (tmp_path / ".keep.me").write_bytes(b"")
    child = os.fork()
    if child == 0:
        with file_in_progress(tmp_path / "frames" / "0001.png"):
            os._exit(9)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    assert len(content_of(tmp_path)) == 2
    remove_leftovers(tmp_path)
    assert list(content_of(tmp_path)) == [".keep.me"]
