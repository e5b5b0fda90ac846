from __future__ import annotations

import signal
import time

import fake_gv_camera as fake
import numpy as np
import pytest

from devices.aravis.settings import AravisSettings, Trigger, find
from devices.deadline import Deadline
from devices.errors import (
    DeviceError,
    DeviceLostError,
    DeviceTimeoutError,
    FrameOrderError,
)
from devices.frame_order import FrameOrder, Light


@pytest.fixture
def description(tmp_path):
    """File with the camera's description, its sensor made small; and a way to add to it."""
    fake.require_aravis()
    file = tmp_path / "camera.xml"
    file.write_text(fake.genicam_of_fake())
    return file


@pytest.fixture
def process(description):
    with fake.fake_gv_camera("-g", str(description)) as running:
        yield running


def settings(**keys):
    keys = {"pixel_format": "Mono8", "instant_exposures": True, **keys}
    return AravisSettings(camera=fake.ADDRESS, **keys)


@pytest.fixture
def camera(process):
    opened = settings().open()
    yield opened
    opened.close()


def expected_level(exposure_s):
    """The simulated ramp is scaled by 1 + log10(exposure / 10 ms), clipped at 255."""
    ramp = np.arange(255)
    return np.clip(ramp * (1 + np.log10(exposure_s / 0.01)), 0, 255).mean()


def test_exposure_is_applied_and_the_level_follows_it(camera):
    assert camera.capabilities.size == (fake.WIDTH, fake.HEIGHT)
    assert camera.capabilities.exposure_range_s == pytest.approx((10e-6, 10.0))
    for number, exposure_s in enumerate((0.002, 0.005, 0.01, 0.03), start=1):
        frame = camera.capture(exposure_s)
        assert frame.sequence == number
        assert frame.exposure_applied_s == pytest.approx(exposure_s, abs=1e-6)
        assert frame.image.dtype == np.uint8
        assert frame.image.mean() == pytest.approx(expected_level(exposure_s), abs=4)


def test_the_exposure_is_the_one_that_the_camera_can_make(camera):
    frame = camera.capture(0.0012345678)
    assert frame.exposure_asked_s == 0.0012345678
    assert frame.exposure_applied_s == pytest.approx(0.001234, abs=2e-6)
    assert frame.exposure_applied_s != frame.exposure_asked_s


def test_frames_are_exposed_after_they_were_asked_for(camera):
    order = FrameOrder(saturation_level=255)
    for _ in range(5):
        asked_s = time.monotonic()
        frame = camera.capture(0.08)
        order.check(frame, light=Light(), subject_since_s=asked_s, delivered_s=time.monotonic())
    for _ in range(5):
        time.sleep(0.03)
        asked_s = time.monotonic()
        frame = camera.capture(0.01)
        assert frame.monotonic_s - frame.exposure_applied_s >= asked_s
        assert frame.monotonic_s <= time.monotonic() + 0.5
        assert frame.wall_time - time.time() == pytest.approx(
            frame.monotonic_s - time.monotonic(), abs=0.01
        )


def test_the_gain_is_fixed_and_raises_the_level(process):
    levels = []
    for gain in (None, 1.0):
        opened = settings(gain=gain).open()
        assert opened.gain == (gain or 0.0)
        levels.append(opened.capture(0.001).image.mean())
        opened.close()
    # One unit of gain adds one to the scale of the ramp, which is 0 at 1 ms.
    assert levels == pytest.approx([0, 127], abs=3)


@pytest.mark.parametrize(
    ("name", "dtype", "saturation_level", "bayer"),
    [("Mono16", np.uint16, 65535, None), ("BayerGB8", np.uint8, 255, "GBRG")],
)
def test_format_tells_depth_and_mosaic(process, name, dtype, saturation_level, bayer):
    opened = settings(pixel_format=name).open()
    capabilities = opened.capabilities
    assert (capabilities.saturation_level, capabilities.bayer) == (saturation_level, bayer)
    assert opened.capture(0.01).image.dtype == dtype
    opened.close()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"pixel_format": "RGB8"}, "not one raw sample per pixel; usable: BayerBG8"),
        ({"pixel_format": "Mono12"}, "no pixel format 'Mono12'"),
        ({"gain": 11.0}, "GainRaw = 11 is outside the camera's 0 to 10"),
        ({"black_level": 3.0}, "no BlackLevel or BlackLevelRaw to set"),
    ],
)
def test_what_the_camera_cannot_do_is_refused_by_name(process, keys, message):
    with pytest.raises(DeviceError, match=message):
        settings(**keys).open()
    # It was let go, and can be opened by others.
    assert [camera.problem for camera in find()] == [None]


def test_acquisition_is_started_for_each_frame_without_a_trigger(process):
    opened = settings(trigger=Trigger.SINGLE_FRAME).open()
    for number in range(1, 4):
        asked_s = time.monotonic()
        frame = opened.capture(0.005)
        assert frame.sequence == number
        assert frame.monotonic_s - frame.exposure_applied_s >= asked_s
    opened.close()


def test_automatic_functions_are_switched_off(description):
    text = fake.genicam_of_fake()
    # Memory that nothing else uses is zero at the start: both functions are on.
    nodes = fake.enumeration("ExposureAuto", 0x4000, off=2, on=0)
    nodes |= fake.enumeration("BalanceWhiteAuto", 0x4004, off=1, on=0)
    description.write_text(fake.with_features(text, "AcquisitionControl", nodes))
    with fake.fake_gv_camera("-g", str(description)):
        opened = settings().open()
        device = opened._camera.get_device()
        assert device.get_string_feature_value("ExposureAuto") == "Off"
        assert device.get_integer_feature_value("ExposureAutoRegister") == 2
        assert device.get_string_feature_value("BalanceWhiteAuto") == "Off"
        opened.close()


def test_an_automatic_function_that_stays_on_is_refused(description):
    text = fake.genicam_of_fake()
    nodes = {
        "ExposureAuto": fake.enumeration("ExposureAuto", 0x4000, off=0, on=1)["ExposureAuto"],
        "_register": fake.constant("ExposureAutoRegister", 1),
    }
    description.write_text(fake.with_features(text, "AcquisitionControl", nodes))
    with (
        fake.fake_gv_camera("-g", str(description)),
        pytest.raises(DeviceError, match=r"ExposureAuto stays Continuous.*choose its exposure"),
    ):
        settings().open()


def test_frames_with_gaps_are_taken_again(description):
    # One packet in thirty is lost, and a frame has some forty.
    with fake.fake_gv_camera("-g", str(description), "-r", "30"):
        opened = settings(attempts=60, timeout_s=60.0).open()
        ramp = np.add.outer(np.arange(fake.HEIGHT), np.arange(fake.WIDTH))
        numbers = []
        for sequence in range(1, 31):
            frame = opened.capture(0.01)
            assert frame.sequence == sequence
            # The camera's own count is drawn into the picture; no sample of it is missing.
            numbers.append(int(frame.image[0, 0]))
            np.testing.assert_array_equal(frame.image, (ramp + numbers[-1]) % 255)
            if len(numbers) > 1 and (numbers[-1] - numbers[-2]) % 255 > 1:
                break
        else:
            pytest.fail("no frame was lost, so none was taken again")
        opened.close()


def test_frames_that_always_have_gaps_are_refused(description):
    with fake.fake_gv_camera("-g", str(description), "-r", "400"):
        opened = settings(attempts=2).open()
        with pytest.raises(DeviceError, match=r"arrived with gaps .* taken 2 times|in time"):
            opened.capture(0.01)
        opened.close()


def test_a_frame_sooner_than_its_exposure_is_refused(process):
    # The simulated camera does not wait for its exposures.
    opened = settings(instant_exposures=False).open()
    with pytest.raises(FrameOrderError, match=r"before its exposure of 1 s can have ended"):
        opened.capture(1.0)
    opened.close()


def test_a_camera_killed_while_a_frame_is_awaited_is_lost(process, camera, monkeypatch):
    camera.capture(0.01)
    trigger = camera._trigger

    def trigger_and_kill():
        # It has acknowledged the trigger, and is gone before it sends the frame.
        trigger()
        process.kill()

    monkeypatch.setattr(camera, "_trigger", trigger_and_kill)
    deadline = Deadline.after(8)
    with pytest.raises(DeviceLostError, match="no frame arrives: the camera does not answer"):
        camera.capture(0.01, deadline=deadline)
    assert not deadline.passed
    began = time.monotonic()
    with pytest.raises(DeviceLostError, match="gone"):
        camera.capture(0.01)
    camera.close()
    assert time.monotonic() - began < 1


def test_a_frame_of_a_killed_camera_is_given_up_at_the_deadline(process, camera, monkeypatch):
    camera.capture(0.01)
    trigger = camera._trigger
    monkeypatch.setattr(camera, "_trigger", lambda: (trigger(), process.kill()))
    began = time.monotonic()
    with pytest.raises(DeviceTimeoutError, match="did not deliver its frame in time"):
        camera.capture(0.01, deadline=Deadline.after(0.4))
    assert 0.4 <= time.monotonic() - began < 1


def test_a_camera_killed_before_it_took_its_exposure_is_lost(process, camera):
    camera.capture(0.01)
    process.freeze()
    signal.signal(signal.SIGALRM, lambda *_: process.kill())
    signal.setitimer(signal.ITIMER_REAL, 0.1)
    deadline = Deadline.after(8)
    # What reached it just before it froze was answered: then it is the frame that does not come.
    with pytest.raises(DeviceLostError, match=r"the exposure cannot be set|no frame arrives"):
        camera.capture(0.01, deadline=deadline)
    assert not deadline.passed


def test_a_killed_camera_that_is_started_again_is_found_again(process, camera):
    assert camera.capture(0.01).sequence == 1
    process.kill()
    with pytest.raises((DeviceLostError, DeviceTimeoutError)):
        camera.capture(0.01, deadline=Deadline.after(4))
    camera.close()
    assert find() == []
    process.start()
    assert [found.model for found in find()] == [f"Aravis Fake at {fake.ADDRESS}"]
    again = settings().open()
    assert again.capture(0.01).image.mean() > 100
    again.close()


def test_a_silent_camera_is_given_up_at_the_deadline(process, camera):
    process.freeze()
    began = time.monotonic()
    with pytest.raises(DeviceTimeoutError, match="in time"):
        camera.capture(0.01, deadline=Deadline.after(0.3))
    assert 0.3 <= time.monotonic() - began < 1
    process.thaw()


def test_an_interrupt_gets_through_and_leaves_no_stale_frame(process, camera):
    def interrupt(*_):
        raise KeyboardInterrupt

    camera.capture(0.01)
    process.freeze()
    signal.signal(signal.SIGALRM, interrupt)
    began = time.monotonic()
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    with pytest.raises(KeyboardInterrupt):
        camera.capture(0.01)
    assert time.monotonic() - began < 1
    process.thaw()
    time.sleep(0.2)
    asked_s = time.monotonic()
    frame = camera.capture(0.02)
    assert frame.sequence == 2
    assert frame.image.mean() == pytest.approx(expected_level(0.02), abs=4)
    assert frame.monotonic_s - frame.exposure_applied_s >= asked_s


def test_a_camera_in_use_is_named_and_refused(process, camera):
    (found,) = find()
    assert "another program controls it" in found.problem
    with pytest.raises(DeviceError, match="another program controls it"):
        settings().open()
    # The one that has it is not disturbed.
    assert camera.capture(0.01).sequence == 1


@pytest.mark.parametrize("name", [fake.SERIAL, f"Aravis-Fake-{fake.SERIAL}", None])
def test_cameras_are_chosen_by_any_of_their_names(process, name):
    opened = AravisSettings(camera=name, instant_exposures=True).open()
    assert opened.capabilities.model == "Aravis Fake"
    # The deepest format is taken if none is asked for.
    assert opened.pixel_format.name == "Mono16"
    opened.close()


@pytest.mark.parametrize("name", ["0123456", "127.0.0.1"])
def test_a_camera_that_is_not_there_is_said_to_be_missing(name):
    fake.require_aravis()
    with fake.no_fake_camera(), pytest.raises(DeviceError, match=r"no .*answer"):
        AravisSettings(camera=name).open()


def test_a_closed_camera_says_so(camera):
    camera.close()
    camera.close()
    with pytest.raises(DeviceError, match="closed"):
        camera.capture(0.01)


def test_an_exposure_out_of_range_is_refused(camera):
    for exposure_s in (0.0, 11.0, float("nan")):
        with pytest.raises(DeviceError, match="outside what Aravis Fake can do"):
            camera.capture(exposure_s)
