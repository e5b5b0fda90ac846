"""What every driver of an interface must do, real ones on simulated wires among them."""

from __future__ import annotations

import math
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import fake_gv_camera
import numpy as np
import pytest
from virtual_display import virtual_display

from devices.bayer import BayerPattern
from devices.deadline import Deadline
from devices.drivers import DRIVERS, DeviceKind
from devices.errors import DeviceError, DeviceTimeoutError
from devices.interfaces import (
    ArmCapabilities,
    ArmLimits,
    ArmPose,
    Camera,
    CameraCapabilities,
    CameraMount,
    LightArm,
    Projection,
    Projector,
    ProjectorCapabilities,
)
from devices.manual_mount import ManualMountSettings
from devices.recording import RecordedFrame, Recording
from devices.replay import (
    ReplayCamera,
    ReplayLightArm,
    ReplayMount,
    ReplayProjector,
)
from devices.simulated.camera import SimulatedCamera
from devices.simulated.settings import SimulationSettings

EXPOSURES_S = (0.004, 0.01, 0.02)
PANEL = (1140, 912)
POSE = ArmPose(math.radians(30), math.radians(40))
OTHER_POSE = ArmPose(math.radians(60), math.radians(30))


def picture(level: int, shape: tuple[int, int] = PANEL) -> Projection:
    return Projection(f"grey {level}", np.full(shape, level, np.uint8))


# A rig of which nothing is real, and a recording.


@pytest.fixture(scope="module")
def scene_settings():
    arm = {"real_time": True, "speed_deg_per_s": 200.0}
    return SimulationSettings.model_validate(
        {"painting": "white", "camera_width": 64, "arm": arm, "projector_width": 160}
        | {"projector_height": 100}
    )


def recording(positions: tuple[str, ...] = ("front", "left")) -> Recording:
    """Every exposure under every light, often enough for any test."""
    lights = [
        {"projection": picture(level).digest, "projection_name": f"grey {level}"}
        for level in (10, 200)
    ]
    lights += [{}, *({"arm_pose": pose, "lamp_on": True} for pose in (POSE, OTHER_POSE))]
    lights += [{"camera_position": name} for name in positions]
    frames = [
        RecordedFrame(
            id=f"{light}-{exposure_s}-{time}",
            exposure_asked_s=exposure_s,
            exposure_applied_s=0.99 * exposure_s,
            wall_time=1e9 + time,
            **what,
        )
        for time in range(20)
        for light, what in enumerate(lights)
        for exposure_s in EXPOSURES_S
    ]
    limits = ArmLimits((0.0, math.radians(350)), (math.radians(10), math.radians(85)))
    return Recording(
        frames=tuple(frames),
        load=lambda frame: (
            np.random.default_rng(zlib.crc32(frame.id.encode()))
            .integers(0, 4000, (48, 64))
            .astype(np.uint16)
        ),
        camera=CameraCapabilities("replayed camera", 64, 48, 4095, (1e-6, 60.0)),
        projector=ProjectorCapabilities("replayed projector", PANEL[1], PANEL[0], 1 / 60),
        arm=ArmCapabilities("replayed arm", limits, 1.0),
    )


# Cameras. What they need is there once; each test opens its own.

OpenCamera = Callable[[], Camera]


@contextmanager
def simulated_camera(request: pytest.FixtureRequest) -> Iterator[OpenCamera]:
    scene = request.getfixturevalue("scene_settings").build().scene
    yield lambda: SimulatedCamera(scene)


@contextmanager
def replayed_camera(request: pytest.FixtureRequest) -> Iterator[OpenCamera]:
    yield lambda: ReplayCamera(recording())


@contextmanager
def aravis_camera(request: pytest.FixtureRequest) -> Iterator[OpenCamera]:
    from devices.aravis.settings import AravisSettings

    fake_gv_camera.require_aravis()
    description = request.getfixturevalue("tmp_path_factory").mktemp("aravis") / "camera.xml"
    description.write_text(fake_gv_camera.genicam_of_fake())
    with fake_gv_camera.fake_gv_camera("-g", str(description)):
        settings = AravisSettings(
            camera=fake_gv_camera.ADDRESS, pixel_format="Mono8", instant_exposures=True
        )
        yield settings.open


@contextmanager
def tethered_camera(request: pytest.FixtureRequest) -> Iterator[OpenCamera]:
    from devices.gphoto2.settings import Gphoto2Settings

    pytest.importorskip("gphoto2")
    pytest.importorskip("rawpy")
    import gphoto2_stand_in

    settings = gphoto2_stand_in.canon()
    times = ("bulb", "1", "1/50", "1/100", "1/250", "1/8000")
    settings["shutterspeed"] = gphoto2_stand_in.Setting("1/50", times)
    body = gphoto2_stand_in.Body(settings=settings)
    yield lambda: Gphoto2Settings().open(library=gphoto2_stand_in.Module(body))


@contextmanager
def video_camera(request: pytest.FixtureRequest) -> Iterator[OpenCamera]:
    from video_device_stand_in import Device

    from devices.opencv.settings import OpencvSettings

    node = request.getfixturevalue("tmp_path_factory").mktemp("opencv") / "video0"
    node.touch()
    settings = OpencvSettings(source=0, exposure_range_s=(1e-4, 0.5))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("devices.opencv.camera._device_file", lambda source: node)
        yield lambda: settings.open(capture=Device())


CAMERAS: dict[str, Callable] = {
    "simulated": simulated_camera,
    "replay": replayed_camera,
    "aravis": aravis_camera,
    "gphoto2": tethered_camera,
    "opencv": video_camera,
}


@pytest.fixture(scope="module", params=CAMERAS)
def open_camera(request):
    with CAMERAS[request.param](request) as open_camera:
        yield open_camera


@pytest.fixture
def camera(open_camera):
    camera = open_camera()
    yield camera
    camera.close()


def test_frames_are_what_the_capabilities_say(camera):
    can = camera.capabilities
    for exposure_s in EXPOSURES_S:
        frame = camera.capture(exposure_s)
        assert frame.image.shape == (can.height, can.width)
        assert frame.image.dtype in (np.uint8, np.uint16)
        assert can.size == (can.width, can.height)
        assert can.model
        assert can.bayer is None or isinstance(can.bayer, BayerPattern)
        assert 0 < can.saturation_level <= np.iinfo(frame.image.dtype).max


def test_a_frame_is_its_caller_s(camera):
    """What is done with a frame changes no later one."""
    one = camera.capture(EXPOSURES_S[0])
    kept = one.image.copy()
    other = camera.capture(EXPOSURES_S[0])
    np.testing.assert_array_equal(one.image, kept)
    assert not np.shares_memory(one.image, other.image)


def test_the_count_rises_by_one(camera):
    numbers = [camera.capture(EXPOSURES_S[n % 3]).sequence for n in range(4)]
    assert np.diff(numbers).tolist() == [1, 1, 1]


def test_exposures_begin_after_the_call_and_one_after_the_other(camera):
    ended = -math.inf
    for exposure_s in (*EXPOSURES_S, *EXPOSURES_S):
        asked_s = time.monotonic()
        frame = camera.capture(exposure_s)
        began = frame.monotonic_s - frame.exposure_applied_s
        assert began >= asked_s - 1e-6
        assert began >= ended - 1e-6
        assert math.isfinite(frame.wall_time)
        ended = frame.monotonic_s


def test_the_exposure_is_applied_nearly_as_asked(camera):
    low, high = camera.capabilities.exposure_range_s
    assert 0 < low < high
    for exposure_s in EXPOSURES_S:
        frame = camera.capture(exposure_s)
        assert frame.exposure_asked_s == exposure_s
        assert low <= frame.exposure_applied_s <= high
        # A third of a stop is the coarsest that cameras are set in.
        assert frame.exposure_applied_s == pytest.approx(exposure_s, rel=0.13)


@pytest.mark.parametrize("what", ["short", "long", "zero", "negative", "nan", "infinite"])
def test_exposures_out_of_range_are_refused_and_the_camera_goes_on(camera, what):
    low, high = camera.capabilities.exposure_range_s
    exposure_s = {"short": low / 2, "long": high * 2, "zero": 0.0, "negative": -0.01} | {
        "nan": math.nan,
        "infinite": math.inf,
    }
    with pytest.raises(DeviceError, match="exposure"):
        camera.capture(exposure_s[what])
    camera.capture(EXPOSURES_S[0])


def test_a_deadline_in_the_past_is_missed(camera):
    with pytest.raises(DeviceTimeoutError):
        camera.capture(EXPOSURES_S[0], deadline=Deadline.after(-1.0))


def test_a_deadline_in_time_is_none(camera):
    camera.capture(EXPOSURES_S[0], deadline=Deadline.after(20.0))


def test_a_closed_camera_takes_no_frames_and_closes_again(camera):
    camera.capture(EXPOSURES_S[0])
    camera.close()
    camera.close()
    with pytest.raises(DeviceError, match="closed"):
        camera.capture(EXPOSURES_S[0])
    camera.close()


def test_a_camera_closes_that_was_never_used(camera):
    camera.close()
    camera.close()


# Projectors.


@contextmanager
def simulated_projector(request: pytest.FixtureRequest) -> Iterator[Projector]:
    yield request.getfixturevalue("scene_settings").build().projector


@contextmanager
def replayed_projector(request: pytest.FixtureRequest) -> Iterator[Projector]:
    yield ReplayProjector(recording())


@contextmanager
def dlpc350_projector(request: pytest.FixtureRequest) -> Iterator[Projector]:
    from devices.dlpc350.settings import Dlpc350Settings
    from devices.simulated.dlpc350_backend import SimulatedUsbBackend

    stored = [
        {"projection": picture(level).digest, "image": number}
        for number, level in enumerate((10, 200))
    ]
    table = {"source": "flash", "latency_s": 0.0, "stored": stored}
    yield Dlpc350Settings.model_validate(table).open(backend=SimulatedUsbBackend())


@contextmanager
def hdmi_projector(request: pytest.FixtureRequest) -> Iterator[Projector]:
    from devices.hdmi.settings import HdmiSettings

    folder = request.getfixturevalue("tmp_path")
    with virtual_display(folder, *PANEL[::-1]) as display:
        yield HdmiSettings(
            screen="screen",
            width=PANEL[1],
            height=PANEL[0],
            display=display.name,
            latency_s=0.01,
            require_vsync=False,
        ).open()


PROJECTORS: dict[str, Callable] = {
    "simulated": simulated_projector,
    "replay": replayed_projector,
    "dlpc350": dlpc350_projector,
    "hdmi": hdmi_projector,
}


@pytest.fixture(params=PROJECTORS)
def projector(request):
    with PROJECTORS[request.param](request) as projector:
        yield projector
        projector.close()


def own_picture(projector: Projector, level: int) -> Projection:
    return picture(level, projector.capabilities.size[::-1])


def test_a_picture_is_there_since_a_time_that_has_come(projector):
    since = 0.0
    for level in (10, 200, 10):
        asked_s = time.monotonic()
        shown_s = projector.show(own_picture(projector, level))
        assert shown_s <= time.monotonic()
        assert shown_s >= max(asked_s, since)
        since = shown_s


def test_pictures_of_another_size_or_type_are_refused_and_the_projector_goes_on(projector):
    width, height = projector.capabilities.size
    wrong = [
        np.zeros((height, width - 1), np.uint8),
        np.zeros((width, height), np.uint8),
        np.zeros((height, width, 3), np.uint8),
        np.zeros((height, width), np.uint16),
        np.zeros((height, width), float),
    ]
    for image in wrong:
        with pytest.raises(DeviceError, match="shows 8-bit pictures"):
            projector.show(Projection("wrong", image))
    projector.show(own_picture(projector, 200))


def test_a_panel_has_a_size_and_a_rate(projector):
    can = projector.capabilities
    assert can.width > 0
    assert can.height > 0
    assert can.size == (can.width, can.height)
    assert 0 < can.frame_period_s < 1
    assert can.model


def test_a_picture_that_comes_too_late_is_an_error(projector):
    with pytest.raises(DeviceTimeoutError):
        projector.show(own_picture(projector, 10), deadline=Deadline.after(-1.0))


def test_a_projector_can_be_blanked_at_any_time(projector):
    projector.blank()
    projector.blank()
    projector.show(own_picture(projector, 200))
    projector.blank()
    projector.show(own_picture(projector, 200))
    projector.close()
    projector.blank()


def test_a_closed_projector_shows_nothing_and_closes_again(projector):
    projector.close()
    projector.close()
    with pytest.raises(DeviceError, match="closed"):
        projector.show(own_picture(projector, 10))
    projector.close()


# Light arms.


@dataclass
class ArmUnderTest:
    """An arm, and what it truly does."""

    arm: LightArm
    truly_lit: Callable[[], bool]
    true_pose: Callable[[], ArmPose | None]


@contextmanager
def simulated_arm(request: pytest.FixtureRequest) -> Iterator[ArmUnderTest]:
    rig = request.getfixturevalue("scene_settings").build()
    mechanism = rig.arm._mechanism
    yield ArmUnderTest(rig.arm, lambda: mechanism.lamp_on, lambda: mechanism.pose)


@contextmanager
def replayed_arm(request: pytest.FixtureRequest) -> Iterator[ArmUnderTest]:
    arm = ReplayLightArm(recording())
    yield ArmUnderTest(arm, lambda: arm.lamp_on, lambda: arm.pose)


@contextmanager
def grbl_arm(request: pytest.FixtureRequest) -> Iterator[ArmUnderTest]:
    from devices.grbl.settings import GrblSettings
    from devices.simulated.grbl_controller import SimulatedGrblController
    from devices.simulated.grbl_port import SimulatedGrblPort

    controller = SimulatedGrblController()
    with SimulatedGrblPort(controller, time_scale=8.0) as port:
        arm = GrblSettings(port=port.address).open()
        yield ArmUnderTest(arm, lambda: controller.lamp_on, lambda: controller.pose)


ARMS: dict[str, Callable] = {
    "simulated": simulated_arm,
    "replay": replayed_arm,
    "grbl": grbl_arm,
}


@pytest.fixture(params=ARMS)
def fresh_arm(request):
    with ARMS[request.param](request) as under_test:
        yield under_test
        under_test.arm.close()


@pytest.fixture(scope="module", params=ARMS)
def homed(request):
    """Each arm once for all tests that leave it open and homed."""
    with ARMS[request.param](request) as under_test:
        under_test.arm.home()
        yield under_test
        under_test.arm.close()


def same_pose(one: ArmPose | None, other: ArmPose | None) -> bool:
    if one is None or other is None:
        return one is other
    away = abs(one.azimuth - other.azimuth), abs(one.elevation - other.elevation)
    return max(away) < math.radians(0.06)


def test_a_position_is_not_known_before_homing(fresh_arm):
    arm = fresh_arm.arm
    assert arm.pose is None
    assert not arm.lamp_on
    before = fresh_arm.true_pose()
    with pytest.raises(DeviceError, match="hom"):
        arm.move_to(POSE)
    assert same_pose(fresh_arm.true_pose(), before)
    arm.home()
    arm.capabilities.limits.check(arm.pose)
    assert not fresh_arm.truly_lit()


def test_an_arm_stands_where_it_was_sent(homed):
    for pose in (POSE, OTHER_POSE):
        homed.arm.move_to(pose)
        assert same_pose(homed.arm.pose, pose)
        assert same_pose(homed.true_pose(), pose)


def test_poses_outside_the_limits_are_refused_and_nothing_moves(homed):
    homed.arm.move_to(POSE)
    limits = homed.arm.capabilities.limits
    outside = [
        ArmPose(limits.azimuth[1] + 0.1, POSE.elevation),
        ArmPose(limits.azimuth[0] - 0.1, POSE.elevation),
        ArmPose(POSE.azimuth, limits.elevation[1] + 0.1),
        ArmPose(POSE.azimuth, limits.elevation[0] - 0.1),
        ArmPose(math.nan, POSE.elevation),
        ArmPose(POSE.azimuth, math.inf),
    ]
    for pose in outside:
        with pytest.raises(DeviceError, match="outside the arm's limits"):
            homed.arm.move_to(pose)
        assert same_pose(homed.true_pose(), POSE)
        assert same_pose(homed.arm.pose, POSE)


def test_the_lamp_lights_and_goes_out(homed):
    for on in (True, True, False, False):
        asked_s = time.monotonic()
        since_s = homed.arm.switch_lamp(on)
        assert asked_s <= since_s <= time.monotonic()
        assert homed.arm.lamp_on is on
        assert homed.truly_lit() is on


def test_the_lamp_is_out_while_the_arm_moves(homed):
    homed.arm.move_to(POSE)
    homed.arm.switch_lamp(True)
    seen = []
    moving = threading.Event()

    def watch():
        while not moving.is_set():
            lit, pose = homed.truly_lit(), homed.true_pose()
            seen.append((lit, same_pose(pose, POSE)))
            time.sleep(0.002)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        homed.arm.move_to(OTHER_POSE)
    finally:
        moving.set()
        watcher.join()
    assert not homed.arm.lamp_on
    assert not homed.truly_lit()
    # Lit, if at all, only where it stood.
    assert all(at_rest for lit, at_rest in seen if lit)


def test_stopping_is_harmless_at_any_time(homed):
    homed.arm.move_to(POSE)
    homed.arm.switch_lamp(True)
    homed.arm.stop()
    homed.arm.stop()
    assert not homed.arm.lamp_on
    assert not homed.truly_lit()
    if homed.arm.pose is None:
        homed.arm.home()
    homed.arm.move_to(OTHER_POSE)
    assert same_pose(homed.true_pose(), OTHER_POSE)


def test_a_move_that_comes_too_late_is_an_error(homed):
    if homed.arm.pose is None:
        homed.arm.home()
    homed.arm.move_to(POSE)
    with pytest.raises(DeviceTimeoutError):
        homed.arm.move_to(OTHER_POSE, deadline=Deadline.after(-1.0))
    assert not homed.truly_lit()
    time.sleep(0.3)
    resting = homed.true_pose()
    time.sleep(0.1)
    assert same_pose(homed.true_pose(), resting)
    homed.arm.home()


def test_a_closed_arm_neither_moves_nor_lights_and_closes_again(fresh_arm):
    arm = fresh_arm.arm
    arm.stop()
    arm.close()
    arm.close()
    before = fresh_arm.true_pose()
    for action in (arm.home, lambda: arm.move_to(POSE), lambda: arm.switch_lamp(True)):
        with pytest.raises(DeviceError, match="closed"):
            action()
    arm.stop()
    arm.close()
    assert same_pose(fresh_arm.true_pose(), before)
    assert not fresh_arm.truly_lit()


def test_an_arm_that_is_closed_with_its_lamp_lit_is_dark(fresh_arm):
    fresh_arm.arm.home()
    fresh_arm.arm.switch_lamp(True)
    assert fresh_arm.truly_lit()
    fresh_arm.arm.close()
    deadline = Deadline.after(3.0)
    while fresh_arm.truly_lit() and not deadline.passed:
        time.sleep(0.01)
    assert not fresh_arm.truly_lit()


# Mounts.


def simulated_mount(request: pytest.FixtureRequest) -> CameraMount:
    return request.getfixturevalue("scene_settings").build().mount


def replayed_mount(request: pytest.FixtureRequest) -> CameraMount:
    return ReplayMount(recording())


def manual_mount(request: pytest.FixtureRequest) -> CameraMount:
    settings = ManualMountSettings(positions=("front", "left", "right"))
    return settings.open(confirm=lambda question: True)


MOUNTS: dict[str, Callable] = {
    "simulated": simulated_mount,
    "replay": replayed_mount,
    "manual": manual_mount,
}


@pytest.fixture(params=MOUNTS)
def mount(request):
    return MOUNTS[request.param](request)


def test_a_camera_stands_where_it_was_placed(mount):
    assert len(set(mount.positions)) == len(mount.positions) >= 2
    assert mount.position == mount.positions[0]
    for position in (*mount.positions, *reversed(mount.positions)):
        mount.place(position)
        assert mount.position == position


def test_a_place_that_there_is_not_is_refused_and_nothing_moves(mount):
    mount.place(mount.positions[1])
    with pytest.raises(DeviceError, match="nowhere"):
        mount.place("nowhere")
    assert mount.position == mount.positions[1]


def test_no_driver_is_left_out():
    suites = {
        DeviceKind.CAMERA: CAMERAS,
        DeviceKind.PROJECTOR: PROJECTORS,
        DeviceKind.ARM: ARMS,
        DeviceKind.MOUNT: MOUNTS,
    }
    for kind, suite in suites.items():
        named = {driver.name for driver in DRIVERS if driver.kind == kind}
        assert set(suite) == named | {"replay"}
