"""The simulated devices: contracts, determinism, settings, and who may ask for the truth."""

from __future__ import annotations

import json
import math
import re
import threading
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceTimeoutError
from devices.interfaces import ArmLimits, ArmPose, Projection
from devices.rig import Rig
from devices.simulated.light_arm import ArmMechanism, SimulatedLightArm
from devices.simulated.rig import SimulatedRig, demo_rig
from devices.simulated.settings import SimulationSettings
from devices.simulated.truth import truth_of

ROOT = Path(__file__).parents[2]
LIMITS = ArmLimits((0.0, 6.0), (0.2, 1.5))


def arm(**options):
    mechanism = ArmMechanism(ArmPose(2.0, 0.8))
    return mechanism, SimulatedLightArm(mechanism, limits=LIMITS, **options)


def test_an_arm_knows_where_it_is_only_after_homing():
    mechanism, light = arm()
    assert light.pose is None
    with pytest.raises(DeviceError, match="home it first"):
        light.move_to(ArmPose(1.0, 1.0))
    light.home()
    assert light.pose == mechanism.pose == ArmPose(0.0, 0.2)
    light.move_to(ArmPose(1.0, 1.0))
    assert light.pose == mechanism.pose == ArmPose(1.0, 1.0)


@pytest.mark.parametrize("pose", [ArmPose(-0.1, 1.0), ArmPose(1.0, 1.6), ArmPose(math.nan, 1.0)])
def test_poses_outside_the_limits_are_refused_and_nothing_moves(pose):
    mechanism, light = arm()
    light.home()
    with pytest.raises(DeviceError, match="outside the arm's limits"):
        light.move_to(pose)
    assert mechanism.pose == ArmPose(0.0, 0.2)


def test_the_lamp_goes_out_before_the_arm_moves_and_stays_out():
    mechanism, light = arm()
    light.home()
    light.switch_lamp(True)
    assert mechanism.lamp_on
    light.move_to(ArmPose(1.0, 1.0))
    assert not mechanism.lamp_on
    light.switch_lamp(True)
    with pytest.raises(DeviceError):
        light.move_to(ArmPose(9.0, 1.0))
    light.home()
    assert not mechanism.lamp_on


def test_an_arm_stops_in_the_middle_of_a_move_with_its_lamp_out():
    mechanism, light = arm(speed=2.0, real_time=True)
    light.home()
    threading.Timer(0.15, light.stop).start()
    with pytest.raises(DeviceError, match="was stopped at azimuth"):
        light.move_to(ArmPose(6.0, 0.2))
    assert 0.05 < mechanism.pose.azimuth < 3.0
    assert light.pose == mechanism.pose
    assert not mechanism.lamp_on
    light.move_to(ArmPose(mechanism.pose.azimuth, 0.25))


@pytest.mark.parametrize("real_time", [False, True])
def test_an_arm_that_is_late_says_where_it_came_to(real_time):
    _, light = arm(speed=1.0, real_time=real_time)
    light.home()
    with pytest.raises(DeviceTimeoutError, match="came only to azimuth"):
        light.move_to(ArmPose(5.0, 0.2), deadline=Deadline.after(0.1))
    assert light.pose is not None
    assert 0.0 < light.pose.azimuth < 0.5


def test_homing_cut_short_leaves_the_position_untrusted():
    _, light = arm(speed=1.0)
    with pytest.raises(DeviceTimeoutError):
        light.home(deadline=Deadline.after(0.05))
    assert light.pose is None


def test_a_closed_arm_takes_no_orders():
    mechanism, light = arm()
    light.home()
    light.switch_lamp(True)
    light.close()
    light.close()
    assert not mechanism.lamp_on
    for order in (
        light.home,
        lambda: light.switch_lamp(True),
        lambda: light.move_to(ArmPose(1, 1)),
    ):
        with pytest.raises(DeviceError, match="closed"):
            order()


@pytest.fixture(scope="module")
def scene():
    return demo_rig(seed=4, camera_width=96).scene


@pytest.fixture
def rig(scene):
    """New devices for the scene that all tests share."""
    scene.place_camera("front")
    return SimulatedRig.of(scene)


def picture(level):
    return Projection(f"grey {level}", np.full((570, 912), level, np.uint8))


def test_noise_is_that_of_the_subject_and_not_of_the_order_of_frames():
    """A recording cut off and resumed elsewhere gives the frames that it would have given."""

    def shots(rig, wanted):
        frames = {}
        for name in wanted:
            if name == "lamp":
                rig.projector.blank()
                rig.arm.home()
                rig.arm.move_to(ArmPose(1.0, 0.7))
                rig.arm.switch_lamp(True)
            else:
                rig.arm.stop()
                rig.projector.show(picture(name))
            frames[name] = rig.camera.capture(0.03).image
        return frames

    whole = shots(demo_rig(seed=4, camera_width=48), [255, 90, "lamp", 10])
    resumed = shots(demo_rig(seed=4, camera_width=48), [10, "lamp", 90])
    for name, image in resumed.items():
        np.testing.assert_array_equal(image, whole[name])


def test_each_frame_of_the_same_has_its_own_noise(rig):
    rig.projector.show(picture(200))
    one, two = (rig.camera.capture(0.03).image for _ in range(2))
    assert (one != two).mean() > 0.5
    assert abs(one.mean() - two.mean()) < 0.5
    difference = one.astype(float) - two
    longer = rig.camera.capture(0.0300001).image.astype(float) - two
    assert abs(np.corrcoef(difference.ravel(), longer.ravel())[0, 1] - 0.5) < 0.1


def test_the_camera_sees_another_side_from_each_place(rig):
    devices = rig.open()
    assert devices.camera_positions == ("front", "left", "right", "above")
    seen = {}
    for place in devices.camera_positions:
        devices.place_camera(place)
        devices.show(picture(255))
        seen[place] = devices.capture(0.03)
        assert seen[place].subject.camera_position == place
        truth = truth_of(rig.scene, position=place)
        points = truth.points[np.isfinite(truth.points[..., 2])]
        pixels = truth.camera.project(points)
        rows, cols = np.nonzero(np.isfinite(truth.points[..., 2]))
        assert np.abs(pixels - np.stack([cols, rows], axis=1)).max() < 1e-5
        assert np.linalg.norm(truth.points[36, 48, :2]) < 15
    images = [frame.image.astype(float) for frame in seen.values()]
    for n, image in enumerate(images):
        for other in images[n + 1 :]:
            assert np.abs(image - other).mean() > 10
    with pytest.raises(DeviceError, match="no position 'below'; there are front, left"):
        devices.place_camera("below")


def test_a_rig_leaves_everything_dark_and_still(rig):
    with rig.open() as devices:
        devices.arm.home()
        devices.move_light(ArmPose(1.0, 0.9))
        devices.switch_lamp(True)
        devices.show(picture(255))
        assert rig.electrons(0.03).mean() > 500
    assert rig.electrons(0.03).max() < 400
    assert not rig.arm.lamp_on
    with pytest.raises(DeviceError, match="closed"):
        rig.camera.capture(0.03)


def test_the_scene_refuses_what_does_not_fit_its_panel(rig):
    with pytest.raises(DeviceError, match="912×570, not uint8 of"):
        rig.scene.show(np.zeros((10, 12), np.uint8))


def test_a_lamp_lit_at_an_unknown_place_is_refused(rig):
    class Lost:
        pose = None
        lamp_on = True

    rig.scene.carry_lamp(Lost())
    with pytest.raises(DeviceError, match="nothing says where it is"):
        rig.camera.capture(0.03)


SMALL = {"painting": "white", "camera_width": 64, "camera_height": 48}


def validated(table):
    return SimulationSettings.model_validate_json(json.dumps(table), strict=True)


def test_settings_from_a_table_build_what_they_say():
    table = {
        **SMALL,
        **{"bits": 14, "bayer": "RGGB", "full_well_e": 30_000, "seed": 3, "gamma": 1.8},
        **{"projector_width": 320, "projector_height": 200, "focal_px": 150.0},
        "positions": {"here": [0, 0, 700], "there": [300, 0, 650]},
        "arm": {"radius_mm": 640, "elevation_deg": [20, 80], "sag_deg": 0.0},
    }
    rig = validated(table).build()
    camera = rig.camera.capabilities
    assert camera.size == (64, 48)
    assert camera.bayer == "RGGB"
    assert camera.saturation_level == 2**14 - 1
    assert rig.projector.capabilities.size == (320, 200)
    assert rig.mount.positions == ("here", "there")
    assert rig.mount.position == "here"
    np.testing.assert_allclose(rig.scene.cameras["there"].position, [300, 0, 650])
    assert rig.camera_lens.matrix[0, 0] == 150.0
    assert rig.scene.panel.gamma == 1.8
    assert rig.arm.capabilities.limits.elevation == pytest.approx(np.radians([20, 80]))
    assert rig.scene.arm.radius == 640
    opened = validated(table).open_rig()
    assert isinstance(opened, Rig)
    assert opened.source == "simulation"


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"painting": "fresco"}, "small_oil"),
        ({"bits": 20}, "16"),
        ({"bits": 8, "black_level": 200.0}, "no room for light"),
        ({"positions": {"behind": [0, 0, -400]}}, "before the painting"),
        ({"positions": {"near": [0, 0, 20]}}, "50 mm away"),
        ({"arm": {"elevation_deg": [80, 20]}}, "no range"),
        ({"camera_width": 0}, "16"),
        ({"focal": 3}, "focal"),
    ],
)
def test_settings_that_cannot_be_built_are_refused(wrong, message):
    with pytest.raises(ValidationError, match=message):
        validated({**SMALL, **wrong})


def test_only_tests_benchmarks_and_the_demo_ask_for_the_truth():
    """The line that keeps figures honest: nothing that processes a recording knows the truth."""
    demo = {"workstation/demonstration.py", "workstation/demo_truth.py"}
    truth = "devices/simulated/truth.py"
    users = []
    for package in ("devices", "acquisition", "calibration", "fitting", "render", "workstation"):
        for path in (ROOT / package).rglob("*.py"):
            name = path.relative_to(ROOT).as_posix()
            if re.search(r"\btruth_of\b|simulated\.truth\b|\bSceneTruth\b", path.read_text()):
                users.append(name)
    assert truth in users
    for name in users:
        assert name in {*demo, truth} or name.startswith("workstation/benchmarks/"), name
