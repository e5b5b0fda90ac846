from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from browser import check_page
from impasto_command import impasto
from scipy.optimize import least_squares

from acquisition.photograph_plan import PhotographChoices, plan_photographs
from acquisition.recording import record_plan
from acquisition.session import Session
from acquisition.session_writer import SessionWriter
from calibration.arm_files import ARM_FILE, load_light_arm, save_light_arm
from calibration.arm_photographs import ArmPhotographs
from calibration.errors import CalibrationError
from calibration.lens import rt_from_matrix, transform
from calibration.light_gates import check_lights
from calibration.mirror_spheres import MirrorSphere
from calibration.sphere_search import find_spheres, sphere_highlights
from devices.simulated.arm_kinematics import ArmKinematics, Lamp
from devices.simulated.arm_targets import place_arm_targets, white_reflectance
from devices.simulated.optics import SimulatedLens
from devices.simulated.rig import SimulatedRig
from devices.simulated.scene import SimulatedScene
from devices.simulated.sensor import Sensor
from devices.simulated.truth import truth_of
from fitting.reflectance.lamp_table import LampTable
from workstation.calibration_extras import LAMPS_FILE
from workstation.demonstration import true_geometry

SPHERE_MM = 18.0
POSES = 12


@pytest.fixture(scope="module")
def rig():
    width = 480
    camera = SimulatedLens.looking_at(
        width=width,
        height=360,
        focal_px=2.3 * width,
        position=(-20.0, 10.0, 450.0),
        target=(0.0, 0.0, 0.0),
        distortion=(-0.08, 0.05, 4e-4, -3e-4, 0.0),
    )
    projector = SimulatedLens.looking_at(
        width=320,
        height=240,
        focal_px=640.0,
        position=(160.0, 20.0, 430.0),
        target=(0.0, 0.0, 0.0),
        distortion=(-0.05, 0.03, -5e-4, 2e-4, 0.0),
    )
    plate, around = place_arm_targets(195.0, 146.0, sphere_mm=SPHERE_MM)
    arm = ArmKinematics(
        centre=(3.0, -4.0, 5.0),
        radius=620.0,
        ring_tilt=(0.01, -0.006),
        arc_lean=0.008,
        azimuth_zero=0.03,
        elevation_zero=-0.015,
        sag=0.006,
    )
    scene = SimulatedScene(
        plate,
        around,
        {"front": camera},
        projector,
        sensor=Sensor(bits=12),
        arm=arm,
        lamp=Lamp(aim_error=(4.0, -6.0, 0.0)),
    )
    return SimulatedRig.of(scene)


def record(rig, folder, poses=POSES):
    devices = rig.open()
    choices = PhotographChoices(
        exposures_s=(1e-4, 0.03),
        code_exposures_s=(0.04,),
        poses=poses,
        least_elevation=np.radians(30),
        period_px=24.0,
        steps=4,
        reference_every=poses,
        adaptive=False,
    )
    with SessionWriter.create(folder, plan_photographs(devices, choices)) as writer:
        record_plan(writer, devices)
    return folder


@pytest.fixture(scope="module")
def session(rig, tmp_path_factory):
    return record(rig, tmp_path_factory.mktemp("lights") / "spheres")


@pytest.fixture(scope="module")
def folder(rig, session, tmp_path_factory):
    """What the command makes of the session."""
    folder = tmp_path_factory.mktemp("calibrated")
    true_geometry(rig).save(folder / "rig")
    done = impasto(
        *("calibrate", "--rig", folder / "rig", "--spheres", session, "--white", session),
        *("--sphere-radius", SPHERE_MM, "--white-albedo", round(white_reflectance(), 6)),
        *("--out", folder / "lights", "--report", folder / "report"),
        *("--json", folder / "figures.json"),
    )
    assert done.returncode == 0, done.stderr
    assert "2 spheres, 12 poses" in done.stdout
    return folder


@pytest.fixture(scope="module")
def arm(folder):
    return load_light_arm(folder / "lights" / ARM_FILE)


@pytest.fixture(scope="module")
def figures(folder):
    return json.loads((folder / "figures.json").read_text())["light_arm"]


def rt_cam_scene(rig):
    return rt_from_matrix(rig.camera_lens.rotation, rig.camera_lens.translation)


def test_light_directions_are_found_to_a_tenth_of_a_degree_and_as_well_as_predicted(rig, arm):
    truth, pose_of_scene = truth_of(rig.scene), rt_cam_scene(rig)
    middle = pose_of_scene[3:]
    errors, predicted = [], []
    for pose in arm.poses:
        towards = transform(pose_of_scene, truth.lamp_position(pose)) - middle
        off = towards / np.linalg.norm(towards) - arm.lamp(pose).directions(middle)
        errors.append(np.degrees(np.linalg.norm(off)))
        spread = np.trace(arm.direction_covariance(pose, middle))
        predicted.append(np.degrees(np.degrees(spread)))
    assert max(errors) < 0.1
    # Errors of the spheres' places are shared by all poses, so one session is one draw.
    assert 0.4 < np.sqrt(np.mean(np.square(errors)) / np.mean(predicted)) < 1.5
    assert arm.suspect == ()
    assert arm.inflation == 1


def test_highlights_are_found_without_a_pull_towards_the_spheres_middles(rig, session):
    photographs = ArmPhotographs.of(Session.open(session))
    lens, truth, pose = true_geometry(rig).camera, truth_of(rig.scene), rt_cam_scene(rig)
    found = find_spheres(photographs, lens, radius_mm=SPHERE_MM)
    pulls = []
    for one, ball in zip(sphere_highlights(photographs, found), rig.scene.background, strict=False):
        centre = transform(pose, ball.centre_mm)
        middle = lens.project(centre[np.newaxis])[0]
        lamps = [transform(pose, truth.lamp_position(p)) for p in photographs.poses]
        for pixel, lamp in zip(one.pixels, lamps, strict=True):
            if np.isfinite(pixel).all():
                true = mirrored(lens, one.sphere, centre, lamp, start=pixel)
                pulls.append((pixel - true) @ (true - middle) / np.linalg.norm(true - middle))
    # What is left is below the error of a single highlight; in pixels it was three times that.
    assert len(pulls) > 20
    assert abs(np.mean(pulls)) < one.sigma_px


def mirrored(lens, sphere, centre, lamp, *, start):
    """Pixel in which a sphere shows a lamp."""

    def off(pixel):
        at, direction = sphere.reflect(lens.unproject(pixel[np.newaxis]), centre=centre)
        towards = lamp - at[0]
        return direction[0] - towards / np.linalg.norm(towards)

    return least_squares(off, start).x


def test_spheres_and_target_are_where_they_are(rig, figures):
    pose = rt_cam_scene(rig)
    for found, true in zip(figures["spheres"], rig.scene.background, strict=False):
        assert np.abs(found["centre_mm"] - transform(pose, true.centre_mm)).max() < 0.6
        assert found["outline_px"] < 0.4
    assert figures["target_blocks"] > 50
    assert figures["target_flatness_mm"] < 0.1


def test_the_lamp_sends_what_it_sends(rig, arm):
    middle, scene = rt_cam_scene(rig)[3:], rig.scene
    white = scene.sensor.rate_e_per_s * scene.sensor.numbers_per_electron
    white *= scene.sensor.weights(scene.lamp.colour)[0, 0].sum()
    for pose in arm.poses[::5]:
        truth = truth_of(scene)
        away = truth.lamp_position(pose)
        off_axis = -truth.lamp_axis(pose) @ away / np.linalg.norm(away)
        sent = np.pi * white * (scene.arm.radius**2 / (away @ away)) * off_axis**6
        assert arm.lamp(pose).irradiance(middle)[0] == pytest.approx(sent, rel=0.03)


def test_lamps_and_the_lens_s_vignetting_are_in_the_table(rig, folder, arm):
    table = LampTable.load(folder / "lights" / LAMPS_FILE)
    assert len(table.poses) == len(arm.poses)
    for pose in arm.poses:
        np.testing.assert_allclose(table.lamp(pose).position, arm.lamp(pose).position)
    lens = rig.camera_lens
    corner = np.array([40.0, 40.0])
    slope = (corner - lens.matrix[:2, 2]) / lens.matrix[0, 0]
    natural = (1 + slope @ slope) ** -2
    assert table.flat_field.gain(corner) == pytest.approx(natural, abs=0.02)


def test_the_report_shows_lamps_and_vignetting(folder):
    page = (folder / "report" / "index.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    assert "Passed: every gate holds" in page
    assert "relative RMS error of radiance" in page
    report = json.loads((folder / "report" / "report.json").read_text())
    assert len(report["lights"]) == POSES
    assert report["flat_field"]["coefficients"][0] < 0


def test_the_report_is_whole_and_reachable_in_a_browser(browser, folder):
    check_page(browser, folder / "report" / "index.html")


@pytest.mark.parametrize(
    ("change", "scale", "gate", "outcome"),
    [
        ({}, 1.0, None, None),
        ({}, 1.25, "spheres beside the target", "refused"),
        ({}, 0.8, "spheres beside the target", "refused"),
        ({"shading_misfit": 0.057}, 1.0, "shading of the target", "warning"),
        ({"shading_misfit": 0.23}, 1.0, "shading of the target", "refused"),
        ({"shading_misfit": float("nan")}, 1.0, "shading of the target", "refused"),
        ({"suspect": (1,)}, 1.0, "suspect poses", "warning"),
        ({"suspect": (1, 2, 3, 4)}, 1.0, "suspect poses", "refused"),
        ({"inflation": 4.0}, 1.0, "highlights", "warning"),
        ({"residual_deg": np.full(POSES, 0.6)}, 1.0, "highlights", "refused"),
        ({"sphere_shift_sigmas": np.array([1.0, 5.0])}, 1.0, "outlines", "refused"),
        ({"radius_error": -0.03, "radius_sigma": 0.004}, 1.0, "radius of the spheres", "refused"),
        ({"radius_error": -0.03, "radius_sigma": 0.03}, 1.0, None, None),
    ],
)
def test_each_gate_of_the_lights_tells_its_own_fault(arm, change, scale, gate, outcome):
    radius = scale * SPHERE_MM
    places = scale * np.array([[-70.0, 40.0, 442.0], [70.0, -40.0, 442.0]])
    report = check_lights(
        replace(arm, **change),
        [MirrorSphere(place, radius, np.eye(3)) for place in places],
        target_middle=np.array([0.0, 0.0, 450.0]),
        target_normal=np.array([0.0, 0.0, -1.0]),
    )
    assert report.passed == (outcome != "refused")
    failed = [(str(one.gate), one.outcome) for one in report.failures]
    assert len(failed) == (0 if gate is None else 1)
    for name, found in failed:
        assert gate in name
        assert found == outcome
    if scale > 1:
        assert "would stand 102 mm behind the white target's plane" in report.failures[0].remedy


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--opencv", "rig.yml"), "leave --opencv out"),
        (("--earlier", "."), "leave --earlier out"),
        (("--baseline", 300), "leave --baseline out"),
        (("--lamps-for", "nowhere"), "nowhere: no such session"),
        (("--chart", "nowhere"), "are shown in the report: name --report"),
        (("--report", "report", "--greys", "nowhere"), "nowhere: no such session"),
        (("--report", "lights"), "is or lies in what --out names"),
    ],
)
def test_options_that_are_no_use_are_refused_before_the_work(
    folder, session, tmp_path, options, message
):
    lights = ("--rig", folder / "rig", "--spheres", session, "--sphere-radius", SPHERE_MM)
    done = impasto("calibrate", *lights, "--out", "lights", *options, cwd=tmp_path)
    assert done.returncode in (2, 3)
    assert message in re.sub(r"[\s│]+", " ", done.stderr)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_no_calibration_is_never_replaced(folder, session, tmp_path):
    (tmp_path / "keep").write_text("mine")
    lights = ("--rig", folder / "rig", "--spheres", session, "--sphere-radius", SPHERE_MM)
    for out in (tmp_path, session, session.parent, session / "lights", folder / "rig"):
        done = impasto("calibrate", *lights, "--out", out, "--force")
        assert done.returncode not in (0, 5)
        assert f"--out {out}" in done.stderr
    assert (tmp_path / "keep").read_text() == "mine"
    assert len(Session.open(session).frames) > 0
    done = impasto("calibrate", "--rig", tmp_path, *lights[2:])
    assert "holds no calibration of camera and projector" in done.stderr
    assert "--calibration" not in done.stderr


def test_spheres_that_are_named_are_looked_for_there_only(rig, session):
    photographs = ArmPhotographs.of(Session.open(session))
    lens = true_geometry(rig).camera
    near = [find_spheres(photographs, lens, radius_mm=SPHERE_MM)[n].circle for n in (1, 0)]
    found = find_spheres(photographs, lens, radius_mm=SPHERE_MM, near=near)
    assert [one.circle[0] for one in found] == pytest.approx([near[1][0], near[0][0]], abs=0.1)
    with pytest.raises(CalibrationError, match="no sphere at column 240"):
        find_spheres(photographs, lens, radius_mm=SPHERE_MM, near=[(240.0, 180.0, 40.0)])
    for circle in ((100.0, 100.0, 1e9), (1e7, 100.0, 30.0), (float("nan"), 1.0, 30.0)):
        with pytest.raises(CalibrationError, match="pictures have 480 columns and 360 rows"):
            find_spheres(photographs, lens, radius_mm=SPHERE_MM, near=[circle])
    # A disc that shows no lamp is no mirror.
    elsewhere = [replace(found[0], circle=(240.0, 180.0, 30.0)), found[1]]
    with pytest.raises(CalibrationError, match="1 of 2 spheres show the lamp"):
        sphere_highlights(photographs, elsewhere)


def test_an_arm_is_the_same_after_writing_and_reading(arm, tmp_path):
    unseen = replace(
        arm,
        residual_deg=np.append(arm.residual_deg[:-1], np.nan),
        radius_error=0.01,
        matt=False,
        placed_by_highlights=True,
    )
    save_light_arm(unseen, tmp_path / ARM_FILE)
    read = load_light_arm(tmp_path / ARM_FILE)
    pose = arm.poses[2]
    assert read.poses == arm.poses
    np.testing.assert_array_equal(read.lamp(pose).position, arm.lamp(pose).position)
    np.testing.assert_array_equal(read.covariance, arm.covariance)
    np.testing.assert_array_equal(read.residual_deg, unseen.residual_deg)
    assert (read.radius_error, read.matt, read.placed_by_highlights) == (0.01, False, True)
    np.testing.assert_equal(read.radius_sigma, arm.radius_sigma)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: "{", "not a calibration of a light arm"),
        (lambda c: c | {"format": "other"}, "of format"),
        (lambda c: c | {"poses": []}, "no pose"),
        (lambda c: c | {"covariance": [[1.0]]}, "finite numbers"),
        (lambda c: c | {"covariance": (-np.eye(17)).tolist()}, "negative variances"),
        (lambda c: c | {"inflation": -1.0}, "not positive"),
        (lambda c: {k: v for k, v in c.items() if k != "parameters"}, "parameters"),
    ],
)
def test_files_of_arms_that_make_no_sense_are_refused(arm, tmp_path, spoil, message):
    file = tmp_path / ARM_FILE
    save_light_arm(arm, file)
    content = spoil(json.loads(file.read_text()))
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(CalibrationError, match=message):
        load_light_arm(file)
    with pytest.raises(CalibrationError, match="no such calibration"):
        load_light_arm(tmp_path / "nothing.json")
