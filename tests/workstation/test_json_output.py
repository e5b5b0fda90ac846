from __future__ import annotations

import json

import pytest

from workstation.json_output import write_json


def test_figures_come_back_and_what_is_no_number_is_null(tmp_path):
    figures = {"a": [1, 0.1, float("nan")], "b": {"c": float("inf"), "d": None, "e": "é"}}
    write_json(tmp_path / "f.json", figures)
    expected = {"a": [1, 0.1, None], "b": {"c": None, "d": None, "e": "é"}}
    assert json.loads((tmp_path / "f.json").read_text()) == expected
    assert [p.name for p in tmp_path.iterdir()] == ["f.json"]


def test_without_a_file_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_json(None, {"a": 1})
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"f\.json: there is no folder"):
        write_json(tmp_path / "none" / "f.json", {})
