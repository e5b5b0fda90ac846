from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acquisition.patterns import Axis
from acquisition.session import Session
from calibration.lens import transform
from devices.simulated.rig import demo_rig
from workstation.benchmarks import decoding_invariances as decoding
from workstation.benchmarks import stress
from workstation.benchmarks import surface_invariances as surface
from workstation.benchmarks.analytic_scans import scan_of, surface_rig
from workstation.benchmarks.invariances import Invariance, rounding_sigma
from workstation.benchmarks.turned_cameras import (
    camera_turn,
    turned_lens,
    turned_map,
    turned_pixels,
    turned_rig,
)
from workstation.demonstration import record_simulated_scan


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans") / "scan"
    record_simulated_scan(demo_rig(camera_width=80), folder)
    return Session.open(folder)


def test_what_must_not_matter_to_decoding_does_not(session):
    found = [*decoding.decoding_invariances(session), *decoding.merging_invariances()]
    assert [str(one) for one in found if not one.holds] == []
    assert {one.stage for one in found} == {"decode", "merge"}


def test_what_depends_on_the_order_of_frames_is_found(session, monkeypatch):
    right = decoding.decode

    def wrong(plan, read_frame, options=None):
        """A little off where the first frame is another one."""
        found = right(plan, read_frame, options)
        off = 0.0 if plan.frames[0].id == session.plan.frames[0].id else 0.01
        axes = {
            axis: replace(one, coordinate=one.coordinate + off) for axis, one in found.axes.items()
        }
        return replace(found, axes=axes)

    monkeypatch.setattr(decoding, "decode", wrong)
    broken = [one.name for one in decoding.decoding_invariances(session) if not one.holds]
    assert set(broken) == {"decode, frames in another order"}


def test_a_surface_that_hides_what_it_does_not_know_is_found(monkeypatch):
    rig = surface_rig(120)
    found = surface._of_a_short_baseline(rig, 1e-1)
    assert found.holds
    right = surface.reconstruct_surface

    def certain(scan, rig):
        one = right(scan, rig)
        field = one.copy.height_field
        sure = replace(field, variance=np.float32(1e-2) * field.variance)
        return replace(one, copy=replace(one.copy, height_field=sure))

    monkeypatch.setattr(surface, "reconstruct_surface", certain)
    assert not surface._of_a_short_baseline(rig, 1e-1).holds


def test_a_result_that_is_not_there_does_not_hold():
    assert not Invariance("decode, made up", np.inf, 1.0, "px").holds
    assert not Invariance("decode, made up", np.nan, 1.0, "px").holds
    assert Invariance("decode, made up", 0.0, 0.0, "px").stage == "decode"


def test_a_change_that_matters_is_counted_for_its_stage():
    found = [
        Invariance("decode, one thread", 0.0, 0.0, "px"),
        Invariance("surface, rig in metres", 0.3, 0.1, "mm"),
        Invariance("surface, one thread", 0.0, 0.0, "mm"),
    ]
    records = {record.name: record for record in stress._silent_records([], found)}
    assert records["stress.silent_wrong"].value == 1
    assert records["stress.changes_that_mattered.decode"].holds
    surface_record = records["stress.changes_that_mattered.surface"]
    assert not surface_record.holds
    assert surface_record.runs == 2
    assert "rig in metres: 0.3 of 0.1 mm" in surface_record.note


def test_rounding_is_as_large_as_it_is():
    numbers = np.random.default_rng(0).uniform(1024, 1600, 100_000)
    errors = numbers.astype(np.float32) - numbers
    assert errors.std() == pytest.approx(rounding_sigma(1600), rel=0.02)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_turned_camera_sees_the_same_points_at_turned_pixels(quarters):
    rig = surface_rig(160)
    points = np.random.default_rng(0).uniform([-60, -40, 430], [60, 40, 460], (50, 3))
    turned = turned_rig(rig, quarters)
    there = transform(camera_turn(quarters), points)
    expected = turned_pixels(rig.camera.project(points), rig.camera, quarters)
    np.testing.assert_allclose(turned.camera.project(there), expected, atol=1e-9)
    panel = rig.projector.project(transform(rig.rt_proj_cam, points))
    lit = turned.projector.project(transform(turned.rt_proj_cam, there))
    np.testing.assert_allclose(lit, panel, atol=1e-8)
    back = turned_lens(turned.camera, -quarters)
    np.testing.assert_allclose(back.intrinsics, rig.camera.intrinsics, atol=1e-12)


def test_a_turned_map_is_what_a_turned_camera_decodes():
    rig = surface_rig(96)
    scan = scan_of(rig)
    turned = turned_map(scan, 1)
    assert turned.shape == scan.shape[::-1]
    pixel = np.array([20.0, 30.0])
    col, row = turned_pixels(pixel, rig.camera, 1).astype(int)
    for axis in (Axis.COLUMN, Axis.ROW):
        assert turned.axes[axis].coordinate[row, col] == scan.axes[axis].coordinate[30, 20]
