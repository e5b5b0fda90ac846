from __future__ import annotations

import dataclasses
import zlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from photographed_relief import lamp, lens, pose_looking_at_origin
from tiny_rig import HEIGHT, WIDTH, TinyCamera, TinyScene, tiny_rig

from acquisition.errors import SessionError
from acquisition.photograph_plan import PhotographChoices, plan_photographs
from acquisition.plan import Purpose
from acquisition.recording import record_plan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from calibration.lens import compose, invert, transform
from devices.bayer import BayerPattern
from fitting.errors import FittingError
from fitting.reflectance.recorded_photographs import (
    PhotographOptions,
    read_photographs,
)

RT_RIG_CANVAS = pose_looking_at_origin((10.0, -20.0, 300.0))
CHOICES = PhotographChoices(
    exposures_s=(0.05, 0.1, 0.2),
    code_exposures_s=(0.1,),
    poses=3,
    steps=3,
    period_px=32.0,
    reference_every=2,
)


def recorded(folder, camera=None):
    scene = TinyScene()
    rig = tiny_rig(scene, **({"camera": camera(scene)} if camera else {}))
    with SessionWriter.create(folder, plan_photographs(rig, CHOICES)) as writer:
        record_plan(writer, rig)
    return Session.open(folder)


class Lamps:
    """A lamp at the elevation of its arm."""

    def lamp(self, pose):
        return lamp(np.degrees(pose.elevation), np.degrees(pose.azimuth))


def views_of(session):
    def view(place):
        shift = np.array([0, 0, 0, 5.0 if place == "left" else 0.0, 0, 0])
        return SimpleNamespace(
            lens=lens(WIDTH, HEIGHT, 60.0), rt_cam_canvas=lambda rt: compose(shift, rt)
        )

    return {place: view(place) for place in ("front", "left")}


def read(session, tmp_path, **options):
    (tmp_path / "scratch").mkdir(exist_ok=True)
    return read_photographs(
        session,
        views_of(session),
        Lamps(),
        RT_RIG_CANVAS,
        scratch=tmp_path / "scratch",
        options=PhotographOptions(**options),
    )


def bright(frame):
    """What the tiny rig shows in a frame: see there."""
    seed = zlib.crc32(repr((None, frame.arm_pose, frame.camera_position)).encode())
    return np.random.default_rng(seed).random((HEIGHT, WIDTH)) < 0.5


def test_photographs_hold_radiance_per_second_without_what_is_there_in_the_dark(tmp_path):
    session = recorded(tmp_path / "s")
    photographs = read(session, tmp_path, mosaic=BayerPattern.GRBG)
    frames = {}
    for frame in session.frames:
        if frame.purpose is Purpose.PHOTOGRAPH:
            frames.setdefault(frame.bracket, frame)
    assert len(photographs) == len(frames) == 2 * 3
    for photograph, frame in zip(photographs, frames.values(), strict=True):
        expected = np.where(bright(frame), 5000.0, 300.0)
        assert np.asarray(photograph.radiance) == pytest.approx(expected, rel=0.01)
        assert (np.asarray(photograph.variance) > 0).all()
        assert isinstance(photograph.radiance, np.memmap)
        assert photograph.mosaic is BayerPattern.GRBG
        at = np.array([3.0, 4.0, 5.0])
        before = transform(photograph.rt_cam_canvas, at)
        assert before[0] == pytest.approx(
            transform(RT_RIG_CANVAS, at)[0] + (5 if frame.camera_position == "left" else 0)
        )
        in_rig = Lamps().lamp(frame.arm_pose)
        points = np.array([[10.0, 5.0, 290.0]])
        canvas = transform(invert(RT_RIG_CANVAS), points)
        assert photograph.lamp.irradiance(canvas) == pytest.approx(in_rig.irradiance(points))


def test_grey_photographs_say_no_more_in_three_channels_than_in_one(tmp_path):
    session = recorded(tmp_path / "s")
    grey, mosaic = (read(session, tmp_path, **o) for o in ({}, {"mosaic": BayerPattern.RGGB}))
    assert grey[0].radiance.shape == (HEIGHT, WIDTH, 3)
    assert np.array_equal(grey[0].radiance[..., 2], mosaic[0].radiance)
    assert grey[0].variance[..., 1] == pytest.approx(3 * mosaic[0].variance)


class ColourCamera(TinyCamera):
    capabilities = replace(TinyCamera.capabilities, bayer=BayerPattern.GRBG)


def test_the_mosaic_is_what_the_session_says(tmp_path):
    session = recorded(tmp_path / "s", ColourCamera)
    assert {photograph.mosaic for photograph in read(session, tmp_path)} == {BayerPattern.GRBG}
    with pytest.raises(SessionError, match="--mosaic"):
        read(session, tmp_path, mosaic=BayerPattern.RGGB)


class FadingCamera(TinyCamera):
    """Its pictures get darker by a percent with every frame, as if the lamp did."""

    def __init__(self, scene):
        super().__init__(scene)
        self.frames = 0

    def capture(self, exposure_s, *, deadline=None):
        frame = super().capture(exposure_s, deadline=deadline)
        if not self.scene.lamp_on:
            return frame
        self.frames += 1
        faded = 32 + (frame.image.astype(float) - 32) * (1 - 0.003 * self.frames)
        return dataclasses.replace(frame, image=np.round(faded).astype(np.uint16))


def test_the_drift_of_the_lamp_is_divided_out(tmp_path):
    session = recorded(tmp_path / "s", FadingCamera)
    followed = read(session, tmp_path, mosaic=BayerPattern.RGGB)
    plain = read(session, tmp_path, mosaic=BayerPattern.RGGB, follow_drift=False)

    def scatter(photographs):
        level = [np.percentile(p.radiance / p.exposure, 75) for p in photographs[:3]]
        return np.ptp(level) / np.mean(level)

    assert scatter(followed) < 0.5 * scatter(plain)


def test_places_that_are_not_registered_are_named(tmp_path):
    session = recorded(tmp_path / "s")
    with pytest.raises(FittingError, match="'front' are not registered"):
        read_photographs(session, {}, Lamps(), RT_RIG_CANVAS, scratch=tmp_path)


def test_a_lamp_keeps_what_it_sends_when_the_frame_changes():
    one = lamp(40, 70)
    moved = one.transformed(RT_RIG_CANVAS)
    points = np.random.default_rng(0).normal(0, 30, (5, 3))
    assert moved.irradiance(transform(RT_RIG_CANVAS, points)) == pytest.approx(
        one.irradiance(points)
    )
