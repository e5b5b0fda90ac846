from __future__ import annotations

import signal
import time

import cv2
import numpy as np
import pytest
from video_device_stand_in import HEIGHT, WIDTH, Device

from devices.deadline import Deadline
from devices.errors import DeviceError, DeviceLostError, DeviceTimeoutError
from devices.opencv.settings import Backend, Channel, ExposureUnit, OpencvSettings


@pytest.fixture
def open_device(tmp_path):
    """Opens a stand-in under the name of a device file that exists."""
    opened = []

    def open_it(device, **keys):
        keys = {"source": 0, "exposure_range_s": (1e-4, 0.5), **keys}
        camera = OpencvSettings(**keys).open(capture=device)
        opened.append(camera)
        return camera

    yield open_it
    for camera in opened:
        camera.close()


@pytest.fixture
def node(tmp_path, monkeypatch):
    """The device file of the source numbered 0."""
    file = tmp_path / "video0"
    file.touch()
    monkeypatch.setattr("devices.opencv.camera._device_file", lambda source: file)
    return file


@pytest.mark.parametrize("stamps", ["kernel", "none", "other"])
@pytest.mark.parametrize("depth", [1, 4])
def test_frames_that_waited_are_dropped(open_device, node, stamps, depth):
    device = Device(stamps=stamps, depth=depth)
    camera = open_device(device)
    for number, exposure_s in enumerate((0.004, 0.004, 0.02, 0.001), start=1):
        # The queue fills up with old frames.
        time.sleep(0.08)
        asked_s = time.monotonic()
        frame = camera.capture(exposure_s)
        truth = device.of(frame.image)
        assert truth.began_s >= asked_s
        assert truth.units * 1e-4 == pytest.approx(exposure_s)
        assert frame.exposure_applied_s == pytest.approx(exposure_s)
        assert frame.sequence == number
        assert frame.monotonic_s - frame.exposure_applied_s >= asked_s
        if stamps == "kernel":
            assert frame.monotonic_s == pytest.approx(truth.ended_s, abs=1e-6)
        else:
            assert truth.ended_s <= frame.monotonic_s <= time.monotonic()


def test_buffers_and_settling_are_what_keeps_old_frames_out(open_device, node):
    # Without them the stand-in's old frames get through, so the test above can fail.
    device = Device(stamps="none", depth=12, readout_s=0.05, latency=6)
    camera = open_device(device, buffers=0, settling_frames=0)
    time.sleep(0.3)
    frame = camera.capture(0.002)
    assert device.of(frame.image).units != 20


def test_capabilities_tell_what_comes_out(open_device, node):
    camera = open_device(Device())
    capabilities = camera.capabilities
    assert capabilities.size == (WIDTH, HEIGHT)
    assert capabilities.saturation_level == 65535
    assert capabilities.exposure_range_s == (1e-4, 0.5)
    assert capabilities.bayer is None
    assert camera.capture(0.005).image.dtype == np.uint16


@pytest.mark.parametrize(
    ("code", "dtype", "saturation_level", "bayer"),
    [
        ("GREY", np.uint8, 255, None),
        ("BA81", np.uint8, 255, "BGGR"),
        ("GRBG", np.uint8, 255, "GRBG"),
        ("RG10", np.uint16, 1023, "RGGB"),
        ("RG12", np.uint16, 4095, "RGGB"),
    ],
)
def test_raw_formats_that_opencv_does_not_know_are_put_into_rows(
    open_device, node, code, dtype, saturation_level, bayer
):
    device = Device(code=code, row_of_bytes=True)
    camera = open_device(device)
    assert camera.capabilities.saturation_level == saturation_level
    assert camera.capabilities.bayer == bayer
    image = camera.capture(0.005).image
    assert (image.shape, image.dtype) == ((HEIGHT, WIDTH), dtype)
    assert (image == image[0, 0]).all()


def test_bits_are_those_that_the_settings_tell(open_device, node):
    device = Device(level=4095)
    camera = open_device(device, bits=12)
    assert camera.capabilities.saturation_level == 4095
    camera.capture(0.005)
    device.level = 4096
    with pytest.raises(DeviceError, match="a sample is 4096 where 4095 should be the largest"):
        camera.capture(0.005)


@pytest.mark.parametrize("code", ["MJPG", "H264", "????"])
def test_lossy_pictures_are_refused_by_name(open_device, node, code):
    with pytest.raises(DeviceError, match=r"delivers \S+, which is compressed with losses"):
        open_device(Device(code=code))


@pytest.mark.parametrize("code", ["YUYV", "BGR3"])
def test_converted_pictures_are_refused_unless_one_channel_is_asked_for(open_device, node, code):
    with pytest.raises(DeviceError, match=rf"{code} come converted to 3 colours"):
        open_device(Device(code=code, colours=True))
    camera = open_device(Device(code=code, colours=True), channel=Channel.GREEN)
    assert camera.capture(0.005).image.shape == (HEIGHT, WIDTH)


def test_lossy_pictures_will_do_if_they_are_allowed(open_device, node):
    camera = open_device(Device(code="MJPG"), allow_lossy=True, channel=Channel.RED)
    assert camera.capture(0.005).image.dtype == np.uint8


def test_a_compressed_row_of_bytes_is_refused_even_where_loss_is_allowed(open_device, node):
    with pytest.raises(DeviceError, match="compressed or cut off"):
        open_device(Device(code="MJPG", row_of_bytes=True), allow_lossy=True)


def test_a_quantised_exposure_is_told_as_it_is(open_device, node):
    device = Device(steps=(1, 2, 5, 10, 20, 39, 78, 156, 312))
    camera = open_device(device)
    frame = camera.capture(0.0042)
    assert frame.exposure_asked_s == 0.0042
    assert frame.exposure_applied_s == pytest.approx(0.0039)
    assert device.of(frame.image).units == 39


def test_an_exposure_that_is_accepted_and_not_taken_is_refused(open_device, node):
    device = Device(units=156.0)
    camera = open_device(device)
    device.keeps_exposure = True
    with pytest.raises(DeviceError, match=r"accepts an exposure of 0.004 s and says that it has"):
        camera.capture(0.004)


def test_an_exposure_that_cannot_be_set_needs_to_be_told(open_device, node):
    with pytest.raises(DeviceError, match=r"refuses an exposure.*fixed_exposure_s"):
        open_device(Device(accepts_exposure=False))
    camera = open_device(Device(accepts_exposure=False), fixed_exposure_s=0.005)
    assert camera.capabilities.exposure_range_s == (0.005, 0.005)
    frame = camera.capture(0.005)
    assert frame.exposure_applied_s == 0.005
    with pytest.raises(DeviceError, match="outside what"):
        camera.capture(0.006)


def test_exposures_of_an_unknown_unit_are_not_guessed(open_device):
    live = {"source": "rtsp://camera/1"}
    with pytest.raises(DeviceError, match="set exposure_unit"):
        open_device(Device(backend="GSTREAMER"), **live)
    device = Device(backend="GSTREAMER", units=5.0)
    camera = open_device(device, exposure_unit=ExposureUnit.MILLISECONDS, **live)
    assert camera.capture(0.007).exposure_applied_s == pytest.approx(0.007)
    assert device.units == 7


def test_powers_of_two_are_seconds(open_device):
    device = Device(backend="DSHOW", units=-5.0)
    # The stand-in's own time goes by its numbers, which are negative here: no exposure at all.
    camera = open_device(device, source="rtsp://camera/1", backend=Backend.DIRECT_SHOW)
    frame = camera.capture(0.03)
    assert device.units == -5
    assert frame.exposure_applied_s == 2**-5


@pytest.mark.parametrize(
    ("name", "value", "off"),
    [
        ("AUTO_EXPOSURE", 3.0, 1.0),
        ("AUTO_WB", 1.0, 0.0),
        ("AUTOFOCUS", 1.0, 0.0),
        ("BACKLIGHT", 2.0, 0.0),
        ("GAMMA", 220.0, 100.0),
    ],
)
def test_automatic_functions_are_switched_off_or_refused_by_name(
    open_device, node, name, value, off
):
    number = getattr(cv2, f"CAP_PROP_{name}")
    device = Device(properties={number: value})
    open_device(device)
    assert device.properties == {number: off}
    with pytest.raises(DeviceError, match=rf"{name} is {value:g} after it was set to {off:g}"):
        open_device(Device(properties={number: value}, stuck=(number,)))


def test_gain_and_other_properties_are_set_and_read_back(open_device, node):
    device = Device(properties={cv2.CAP_PROP_GAIN: 9.0, cv2.CAP_PROP_SHARPNESS: 3.0})
    open_device(device, gain=0.0, properties={"SHARPNESS": 0.0})
    assert set(device.properties.values()) == {0.0}
    with pytest.raises(DeviceError, match=r"GAIN is -1 after it was set to 4, which the device"):
        open_device(Device(), gain=4.0)
    with pytest.raises(DeviceError, match="knows no property SHARPENING"):
        open_device(Device(), properties={"SHARPENING": 0.0})


def test_a_format_or_size_that_is_not_taken_is_refused(open_device, node):
    with pytest.raises(DeviceError, match="stays with pixel format Y16 where BA81 was set"):
        open_device(Device(), pixel_format="BA81")
    open_device(Device(), pixel_format="Y16", width=WIDTH, height=HEIGHT)
    with pytest.raises(DeviceError, match="has a width of 40, not 640"):
        open_device(Device(), width=640, height=480)


def test_a_grab_that_fails_is_made_again(open_device, node):
    device = Device()
    camera = open_device(device)
    device.failing_grabs = 5
    asked_s = time.monotonic()
    assert device.of(camera.capture(0.004).image).began_s >= asked_s


def test_grabs_that_go_on_failing_are_given_up_at_the_deadline(open_device, node):
    device = Device()
    camera = open_device(device)
    device.failing_grabs = 10**9
    began = time.monotonic()
    with pytest.raises(DeviceTimeoutError, match=r"did not (arrive|answer) in time"):
        camera.capture(0.004, deadline=Deadline.after(0.3))
    assert time.monotonic() - began < 1


def test_a_device_that_is_unplugged_is_lost(open_device, node):
    device = Device()
    camera = open_device(device)
    device.failing_grabs = 10**9
    node.unlink()
    for _ in range(2):
        with pytest.raises(DeviceLostError, match="is gone; plug the camera in"):
            camera.capture(0.004)


def test_a_device_that_hangs_is_given_up_and_lets_interrupts_through(open_device, node):
    def interrupt(*_):
        raise KeyboardInterrupt

    device = Device()
    camera = open_device(device)
    device.hangs_s = 1.5
    began = time.monotonic()
    with pytest.raises(DeviceTimeoutError):
        camera.capture(0.004, deadline=Deadline.after(0.2))
    assert time.monotonic() - began < 1
    signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        camera.capture(0.004)
    assert time.monotonic() - began < 1
    device.hangs_s = 0.0
    asked_s = time.monotonic()
    assert device.of(camera.capture(0.004).image).began_s >= asked_s


def test_a_device_that_does_not_open_says_why(open_device, node):
    with pytest.raises(DeviceError, match="another program has it, or you have no permission"):
        open_device(Device(opens=False))
    node.unlink()
    device = Device(opens=False)
    with pytest.raises(DeviceError, match="does not exist; plug the camera in"):
        open_device(device)
    assert device.opened_with[1] == cv2.CAP_V4L2
    assert device.released


def test_a_closed_camera_says_so(open_device, node):
    device = Device()
    camera = open_device(device)
    camera.close()
    camera.close()
    assert device.released
    with pytest.raises(DeviceError, match="closed"):
        camera.capture(0.004)
