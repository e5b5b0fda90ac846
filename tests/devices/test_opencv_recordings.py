from __future__ import annotations

import time

import cv2
import numpy as np
import pytest

from devices.errors import DeviceError, DeviceLostError
from devices.frame_order import FrameOrder, Light
from devices.opencv.settings import Channel, OpencvSettings

COUNT = 4


def pictures(dtype):
    random = np.random.default_rng(3)
    high = np.iinfo(dtype).max + 1
    return [random.integers(0, high, (48, 64)).astype(dtype) for _ in range(COUNT)]


def write_series(folder, suffix, images):
    for number, image in enumerate(images):
        assert cv2.imwrite(str(folder / f"img_{number:03d}{suffix}"), image)
    return str(folder / f"img_%03d{suffix}")


def write_video(path, codec, images, *, colour=False, deep=False):
    parameters = [cv2.VIDEOWRITER_PROP_IS_COLOR, int(colour)]
    if deep:
        parameters += [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U]
    size = images[0].shape[1::-1]
    code = cv2.VideoWriter.fourcc(*codec)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, 25, size, parameters)
    assert writer.isOpened()
    for image in images:
        writer.write(image)
    writer.release()
    return str(path)


def open_recording(source, **keys):
    return OpencvSettings(source=source, fixed_exposure_s=0.01, **keys).open()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("kind", ["png", "tiff", "ffv1"])
def test_recordings_come_out_as_they_were(tmp_path, dtype, kind):
    images = pictures(dtype)
    if kind == "ffv1":
        source = write_video(tmp_path / "a.mkv", "FFV1", images, deep=dtype == np.uint16)
    else:
        source = write_series(tmp_path, f".{kind}", images)
    camera = open_recording(source, bayer="GRBG")
    assert camera.capabilities.size == (64, 48)
    assert camera.capabilities.saturation_level == np.iinfo(dtype).max
    assert camera.capabilities.bayer == "GRBG"
    order = FrameOrder()
    for number, image in enumerate(images, start=1):
        since_s = time.monotonic()
        frame = camera.capture(0.01)
        np.testing.assert_array_equal(frame.image, image)
        assert frame.image.dtype == dtype
        assert frame.sequence == number
        order.check(frame, light=Light(), subject_since_s=since_s)
    with pytest.raises(DeviceLostError, match="has ended after 4 pictures"):
        camera.capture(0.01)
    camera.close()


def test_the_exposure_of_a_recording_has_to_be_told(tmp_path):
    source = write_series(tmp_path, ".png", pictures(np.uint8))
    with pytest.raises(DeviceError, match="say what it was with fixed_exposure_s"):
        OpencvSettings(source=source).open()


def test_series_of_jpegs_are_refused_by_name_unless_loss_is_allowed(tmp_path):
    source = write_series(tmp_path, ".jpg", pictures(np.uint8))
    with pytest.raises(DeviceError, match=r"delivers \.jpg, which is compressed with losses"):
        open_recording(source)
    camera = open_recording(source, allow_lossy=True)
    assert camera.capture(0.01).image.shape == (48, 64)
    camera.close()


def test_compressed_videos_are_refused_by_name(tmp_path):
    source = write_video(tmp_path / "a.avi", "MJPG", pictures(np.uint8))
    with pytest.raises(DeviceError, match="delivers MJPG, which is compressed with losses"):
        open_recording(source)
    # Of a video in colours the brightness alone would come out.
    with pytest.raises(DeviceError, match="not grey of 8 or 16 bits"):
        open_recording(source, allow_lossy=True)
    camera = open_recording(source, allow_lossy=True, channel=Channel.GREEN)
    assert camera.capture(0.01).image.shape == (48, 64)
    camera.close()


@pytest.mark.parametrize(("channel", "index"), [("blue", 0), ("green", 1), ("red", 2)])
def test_one_channel_of_pictures_in_colours_is_taken_if_it_is_asked_for(tmp_path, channel, index):
    colours = [np.dstack(pictures(np.uint8)[:3])]
    source = write_series(tmp_path, ".png", colours)
    with pytest.raises(DeviceError, match="come converted to 3 colours"):
        open_recording(source)
    camera = open_recording(source, channel=channel)
    np.testing.assert_array_equal(camera.capture(0.01).image, colours[0][..., index])
    camera.close()


def test_a_picture_of_another_size_is_refused(tmp_path):
    images = pictures(np.uint8)
    images[2] = images[2][:40]
    camera = open_recording(write_series(tmp_path, ".png", images))
    camera.capture(0.01)
    camera.capture(0.01)
    with pytest.raises(DeviceError, match=r"64×40"):
        camera.capture(0.01)
    camera.close()


@pytest.mark.parametrize("name", ["missing.mkv", "missing_%03d.png", "garbage.mkv"])
def test_what_cannot_be_opened_is_named(tmp_path, name):
    (tmp_path / "garbage.mkv").write_bytes(b"no video at all")
    with pytest.raises(DeviceError, match=rf"{name} cannot be opened"):
        open_recording(str(tmp_path / name))
