from __future__ import annotations

import os
import shutil
import signal
import time

import numpy as np
import pytest

from acquisition.errors import SessionError
from acquisition.session import PLAN_FILE, Session
from workstation.benchmarks import fuzzing
from workstation.benchmarks.fuzz_targets import make_targets, reseal
from workstation.benchmarks.fuzzing import End, Target, damage, fingerprint, fuzz
from workstation.benchmarks.mutations import (
    mutate_bytes,
    mutate_exr,
    mutate_json,
    mutate_png,
    mutate_text,
)

GOOD = b'{"numbers": [1, 2, 3], "name": "good"}'


@pytest.fixture(scope="module")
def targets(tmp_path_factory):
    return {target.name: target for target in make_targets(tmp_path_factory.mktemp("good"))}


@pytest.fixture
def folder(tmp_path):
    good = tmp_path / "good"
    good.mkdir()
    (good / "file.json").write_bytes(GOOD)
    return good


def reading(react):
    def read(folder):
        file = folder / "file.json"
        content = file.read_bytes() if file.is_file() else b""
        if content == GOOD:
            return fingerprint(content)
        return react(content)

    return read


def crash(content):
    os.kill(os.getpid(), signal.SIGKILL)


def hang(content):
    time.sleep(60)


def refuse(content):
    raise SessionError("damaged")


@pytest.mark.parametrize(
    ("react", "end", "why"),
    [
        (crash, End.UNNAMED, "the process died"),
        (hang, End.UNNAMED, "no end after 1 s"),
        (lambda content: 1 / 0, End.UNNAMED, "ZeroDivisionError at test_fuzzing.py"),
        (refuse, End.REFUSED, ""),
        (fingerprint, End.OTHER, "read as something else"),
        (lambda content: fingerprint(GOOD), End.SAME, ""),
    ],
    ids=["crash", "hang", "unnamed", "refused", "other", "same"],
)
def test_each_end_of_a_trial_is_told_from_the_others(folder, monkeypatch, react, end, why):
    monkeypatch.setattr(fuzzing, "_TRIAL_SECONDS", 1)
    target = Target("made up", folder, reading(react), sealed=True)
    outcome = fuzz(target, range(4))
    assert outcome.trials == 4
    assert outcome.ends[end] >= 3
    assert set(outcome.ends) <= {end, End.SAME}
    assert all(said.startswith(why) and why for said in outcome.failures)
    assert bool(outcome.failures) == bool(why)


def test_a_trial_is_known_by_its_number(folder, tmp_path):
    target = Target("made up", folder, reading(refuse))
    contents = set()
    for _ in range(2):
        damage(target, tmp_path / "a", np.random.default_rng(7))
        contents.add((tmp_path / "a" / "file.json").read_bytes())
    assert len(contents) == 1


@pytest.mark.parametrize("name", ["plan.json", "journal.jsonl", "manifest.sha256", "frames"])
@pytest.mark.parametrize("seed", range(8))
def test_mutations_change_what_they_are_given_in_the_same_way_each_time(targets, name, seed):
    session = targets["session as recorded"].folder
    file = next((session / name).iterdir()) if name == "frames" else session / name
    mutations = {".json": mutate_json, ".png": mutate_png}
    structured = mutations.get(file.suffix, mutate_text)
    content = file.read_bytes()
    for mutation in (mutate_bytes, structured):
        changed = [mutation(content, np.random.default_rng(seed)) for _ in range(2)]
        assert changed[0] == changed[1]
    every = {structured(content, np.random.default_rng(s)) for s in range(20)}
    assert len(every - {content}) > 10


def test_values_of_a_map_are_changed(targets):
    content = (targets["copy"].folder / "relief.exr").read_bytes()
    every = {mutate_exr(content, np.random.default_rng(s)) for s in range(10)}
    assert len(every - {content}) > 5


def test_resealing_takes_damage_past_the_checksums(targets, tmp_path):
    shutil.copytree(targets["session resealed"].folder, tmp_path / "s")
    plan = tmp_path / "s" / PLAN_FILE
    plan.write_text(plan.read_text().replace('"source"', '"source" '))
    with pytest.raises(SessionError, match="altered"):
        Session.open(tmp_path / "s")
    reseal(tmp_path / "s")
    Session.open(tmp_path / "s")


def test_every_kind_of_file_is_read_or_refused_by_name(targets):
    for target in targets.values():
        outcome = fuzz(target, range(15))
        assert outcome.ends[End.UNNAMED] == 0, (target.name, outcome.failures)
        if target.name == "results of stages":  # made anew
            assert outcome.ends[End.SAME] == outcome.trials
        else:
            assert outcome.ends[End.REFUSED] > 0, target.name
        if target.sealed:
            assert outcome.ends[End.OTHER] == 0, (target.name, outcome.failures)
