from __future__ import annotations

import pytest
from tiny_rig import TinyCamera, TinyScene, tiny_rig

from acquisition import frame_files
from acquisition.photograph_plan import PhotographChoices, plan_photographs
from acquisition.recording import record_plan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from workstation.benchmarks.session_differences import frame_differences


class Brighter(TinyCamera):
    """One sample of what it takes is too bright."""

    def capture(self, exposure_s, *, deadline=None):
        frame = super().capture(exposure_s, deadline=deadline)
        frame.image[0, 0] += 1
        return frame


@pytest.fixture
def plan():
    choices = PhotographChoices(
        exposures_s=(0.05,), code_exposures_s=(0.1,), poses=1, steps=3, camera_positions=("front",)
    )
    return plan_photographs(tiny_rig(), choices)


@pytest.fixture
def whole(tmp_path, plan):
    return record(tmp_path / "whole", plan)


def brighter():
    scene = TinyScene()
    return tiny_rig(scene, camera=Brighter(scene))


def record(path, plan, rig=None, **choices):
    with SessionWriter.create(path, plan) as writer:
        record_plan(writer, rig or tiny_rig(), **choices)
    return Session.open(path)


def test_frames_of_other_samples_are_named(tmp_path, plan, whole):
    assert frame_differences(whole, whole) == []
    said = frame_differences(record(tmp_path / "other", plan, brighter()), whole)
    assert [name.split()[0] for name in said] == [frame.id for frame in plan.frames]
    for of_frame in said:
        assert "(1 of " in of_frame
        assert "samples, by 1 at most)" in of_frame


@pytest.mark.parametrize("when", ["before", "after"])
def test_frames_from_before_and_after_a_cut_are_told_apart(tmp_path, plan, whole, when):
    early = {frame.id for frame in plan.frames[:-2]}

    def cut(name):
        if name == plan.frames[-3].id:
            raise KeyboardInterrupt

    path = tmp_path / "cut"
    with pytest.raises(KeyboardInterrupt):
        record(path, plan, brighter() if when == "before" else tiny_rig(), advance=cut)
    with SessionWriter.resume(path) as writer:
        record_plan(writer, brighter() if when == "after" else tiny_rig())
    said = frame_differences(Session.open(path), whole)
    assert {name.split()[0] in early for name in said} == {when == "before"}
    assert all(f"(recorded {when} it was cut off; 1 of " in of_frame for of_frame in said)


def test_frames_coded_otherwise_are_told_from_other_samples(tmp_path, monkeypatch, plan, whole):
    monkeypatch.setattr(frame_files, "_LEVEL", 0)
    said = frame_differences(record(tmp_path / "coded", plan), whole)
    assert said
    assert all("every sample is the same, coded in other bytes" in of_frame for of_frame in said)
